"""The flight core: the one source that flies in the emulator and is exported as C99.

Written in the subset of Python that `subset.py` describes: float32 scalars, int32, fixed-size arrays in state structs,
bounded loops, no allocation. The same source runs as plain Python (`--board python`) and as C,
with the same bits in all three.
"""
