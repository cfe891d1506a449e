"""Rows of a station's `telemetry.csv`."""

RARE = ("excite.", "pm.", "system.")  # nothing is excited; battery and load come once or twice a second


def is_whole(row: dict[str, str]) -> bool:
    """Whether everything is there that every sample has."""
    return all(value != "nan" or name.startswith(RARE) for name, value in row.items())
