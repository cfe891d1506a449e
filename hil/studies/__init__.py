"""Studies of many flights."""
