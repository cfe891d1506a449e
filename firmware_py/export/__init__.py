"""From the flight core to the board: C99 from its source, the app around it, and runners of the compiled code."""
