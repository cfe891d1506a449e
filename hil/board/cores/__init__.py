"""What executes the flight core of a board of Python: C, plain Python, or the emulated chip."""
