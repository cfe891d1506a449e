"""The command line, one file per command; no other room imports click or rich."""
