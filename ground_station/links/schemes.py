"""The back end for each link's URI, as one table; each is imported on demand, because its package is an extra."""

from collections.abc import Callable
from importlib import import_module

from ground_station.config import LinkSettings
from ground_station.errors import LinkError
from ground_station.links.live_link import LiveLink

# Scheme: the file in this folder with the back end, its class, the extra that installs what it needs, and the URI's form
SCHEMES = {
    "radio": ("crazyradio", "CrazyradioLink", "radio", "radio://0/80/2M/E7E7E7E7E7"),
    "udp": ("crazyradio", "CrazyradioLink", "radio", "udp://127.0.0.1:19850"),
    "mavlink": ("mavlink_serial", "MavlinkSerialLink", "mavlink", "mavlink:DEVICE[,BAUD]"),
}


def find_link(uri: str, settings: LinkSettings) -> LiveLink:
    """Return the link of a URI, not open yet. Raises `LinkError`; `ImportError` when the scheme's package is missing."""
    scheme = uri.partition(":")[0]
    if scheme not in SCHEMES:
        raise LinkError(f"{uri}: expected {' or '.join(form for *_, form in SCHEMES.values())}")
    file, name, *_ = SCHEMES[scheme]
    back_end: Callable[[str, LinkSettings], LiveLink]
    back_end = getattr(import_module(f"ground_station.links.{file}"), name)
    return back_end(uri, settings)
