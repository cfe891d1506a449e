"""The exceptions of the ground station."""


class LinkError(Exception):
    """The board cannot be reached, the link is lost, or the address is wrong; the text is one line."""


class MocapError(Exception):
    """Motion capture cannot be reached, or its answer is unusable; the text is one line."""
