"""The check that all targets compute the same, and its tools."""
