"""Live pictures of a flight, in a separate process."""
