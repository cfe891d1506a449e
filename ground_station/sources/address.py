"""What `--mocap` says: virtual[:PORT] or optitrack:HOST[:PORT][,multicast][,body=NAME][,z-up].

Motive streams with its y axis up unless it is told otherwise.
"""

from ground_station.errors import MocapError
from ground_station.mocap import MocapSource
from ground_station.mocap_udp import DEFAULT_PORT
from ground_station.natnet import COMMAND_PORT
from ground_station.natnet_stream import Axes
from ground_station.sources.optitrack import OptitrackSource
from ground_station.sources.virtual import VirtualSource

FORMS = "virtual, virtual:PORT or optitrack:HOST[:PORT][,multicast][,body=NAME][,z-up]"


def find_source(text: str) -> MocapSource:
    """The source of that name, not open yet; `MocapError` for what is none."""
    system, *options = text.split(",")
    name, _, place = system.partition(":")
    if name == "virtual" and not options and ":" not in place:
        return VirtualSource(_port(place) if system != name else DEFAULT_PORT)
    host, colon, port = place.partition(":")
    if name != "optitrack" or not host:
        raise MocapError(f"expected {FORMS}")
    body = ""
    for option in options:
        if option.startswith("body=") and len(option) > 5:
            body = option[5:]
        elif option not in ("multicast", "z-up"):
            raise MocapError(f"{option!r}: expected {FORMS}")
    axes: Axes = "z-up" if "z-up" in options else "y-up"
    return OptitrackSource(host, _port(port) if colon else COMMAND_PORT, body, "multicast" in options, axes)


def _port(text: str) -> int:
    if not (text.isascii() and text.isdigit() and 0 < int(text) < 65536):
        raise MocapError(f"expected {FORMS}")
    return int(text)
