"""Pictures of a flight while it happens, in a process of their own."""
