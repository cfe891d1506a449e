"""The options from which the flights of a test start."""

from hil.laboratory.request import Options


def choice(seed: int = 1, board: str = "c", profile: str = "floaty", link: str = "radio") -> Options:
    return {"seed": seed, "board": board, "profile": profile, "link": link}
