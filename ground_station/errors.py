"""The exceptions of the ground station."""


class LinkError(Exception):
    """The board cannot be reached, or not any more, or not like this; the text is one line."""


class MocapError(Exception):
    """Motion capture cannot be reached, or does not say what it should; the text is one line."""
