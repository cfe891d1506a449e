"""The exceptions of the laboratory; the command line turns them into one line and exit code 2."""


class LabError(Exception):
    """Something the user asked for cannot be done; the text says what, the value, and what is allowed."""
