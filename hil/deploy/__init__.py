"""The check that all targets are equal, and the tools that it needs."""
