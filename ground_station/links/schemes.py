"""The back end for each link's URI, as one table; each is imported on demand, because its package is an extra."""

from collections.abc import Callable
from dataclasses import dataclass

from ground_station.errors import LinkError
from ground_station.links.live_link import LiveLink


@dataclass(frozen=True, slots=True)
class LinkSettings:
    """A profile's settings of links; each back end uses its own."""

    corrections_hz: float
    latency_us: int  # to the board, until it is measured
    baud: int  # for URIs without one
    signing_key: bytes  # 32 bytes; empty: nothing is signed
    # Receives every MAVLink frame, in both directions.
    note_frame: Callable[[int, bytes], object] | None = None


def _crazyradio(uri: str, settings: LinkSettings) -> LiveLink:
    from ground_station.links.crazyradio import CrazyradioLink

    return CrazyradioLink(uri, settings.latency_us)


def _mavlink(uri: str, settings: LinkSettings) -> LiveLink:
    from ground_station.links.mavlink import MavlinkLinkConfig
    from ground_station.links.mavlink_serial import MavlinkSerialLink

    config = MavlinkLinkConfig(
        settings.baud, settings.corrections_hz, settings.signing_key, latency_us=settings.latency_us
    )
    return MavlinkSerialLink(uri, config, settings.note_frame)


# Scheme: the back end, and the extra that installs what it needs
SCHEMES: dict[str, tuple[Callable[[str, LinkSettings], LiveLink], str]] = {
    "radio": (_crazyradio, "radio"),
    "udp": (_crazyradio, "radio"),
    "mavlink": (_mavlink, "mavlink"),
}


def find_link(uri: str, settings: LinkSettings) -> LiveLink:
    """Return the link of a URI, not open yet. Raises `LinkError`; `ImportError` when the scheme's package is missing."""
    scheme = uri.partition(":")[0]
    if scheme not in SCHEMES:
        raise LinkError(
            f"{uri}: expected radio://0/80/2M/E7E7E7E7E7, udp://127.0.0.1:19850 or mavlink:DEVICE[,BAUD]"
        )
    return SCHEMES[scheme][0](uri, settings)
