"""Several robots on one clock: their requests and places, their flight in turn, and its result."""
