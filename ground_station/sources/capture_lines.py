"""The output of the process around `motioncapture`, one line of JSON each: the bodies of a frame, or why it ends.

[123456789, {"floaty": [x, y, z, qw, qx, qy, qz]}]      arrival [us, `clock_us`]; [m], axes of the system
"no such computer"
"""

import json
from dataclasses import dataclass

from ground_station.errors import MocapError

Body = tuple[float, ...]  # p x y z, q w x y z


@dataclass(frozen=True, slots=True)
class Arrival:
    """What the system saw in one frame."""

    t_us: int  # when it arrived
    bodies: dict[str, Body]


def encode_arrival(arrival: Arrival) -> str:
    """The line of a frame."""
    return json.dumps([arrival.t_us, arrival.bodies]) + "\n"


def encode_error(text: str) -> str:
    """The line that says why the stream ends."""
    return json.dumps(text) + "\n"


def decode_line(line: bytes) -> Arrival | str:
    """The content of a line, a text if it is an error's; `MocapError` for a malformed one."""
    try:
        said = json.loads(line)
    except (ValueError, RecursionError):
        raise MocapError(f"not a line of the capture process: {line[:40]!r}") from None
    if isinstance(said, str):
        return said
    match said:
        case [int(t_us), dict(bodies)] if 0 <= t_us < 2**63 and all(map(_is_body, bodies.values())):
            return Arrival(t_us, {name: tuple(body) for name, body in bodies.items()})
    raise MocapError(f"not a line of the capture process: {line[:40]!r}")


def _is_body(body: object) -> bool:
    return isinstance(body, list) and len(body) == 7 and all(isinstance(value, float) for value in body)
