"""Drivers: raw counts of the board to what the core takes."""
