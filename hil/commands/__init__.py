"""The command line, one file per command; nothing else knows click or rich."""
