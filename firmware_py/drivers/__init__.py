"""Drivers: they convert the board's raw counts for the core."""
