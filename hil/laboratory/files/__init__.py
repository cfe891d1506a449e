"""The files of a run, written whole or not at all, and the files that users bring."""
