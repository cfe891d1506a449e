"""Hardware at the board's pins, in the air and on the ceiling."""
