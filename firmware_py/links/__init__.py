"""The on-board ends of the links."""
