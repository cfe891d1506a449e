"""The serial line of a flight in lockstep, with MAVLink on it: the station's end, the board's UART, logged counters."""

from collections.abc import Callable

from ground_station.errors import LinkError
from ground_station.links.mavlink import MavlinkLink, MavlinkLinkConfig
from hil.config import LabConfig
from hil.devices.board_firmware import BoardFirmware
from hil.devices.uart import VirtualSerial
from hil.errors import LabError
from hil.laboratory.channels import quantity
from hil.laboratory.recorder import Channel


def link_of(
    config: LabConfig, line: VirtualSerial, note_frame: Callable[[int, bytes], object] | None
) -> MavlinkLink:
    """Return the station's end of a line; `note_frame` gets its frames. Raises `LabError` when no flight fits on it."""
    poses_hz = min(config.station.corrections_hz, 1e6 / config.mocap.period_us)
    key = bytes.fromhex(config.mavlink.signing_key)
    latency_us = config.station.link_latency_us
    settings = MavlinkLinkConfig(config.serial.baud, poses_hz, key, latency_us=latency_us)
    try:
        return MavlinkLink(line.uplink, settings, note_frame)
    except LinkError as error:
        raise LabError(f"--link mavlink: {error}") from None


def serial_channel(uart: VirtualSerial, firmware: BoardFirmware, link: MavlinkLink | None) -> Channel:
    """Return the counters of a serial line; without a `link` the station's frames are unknown and stay 0.

    `link.*` counts pieces of the stream, `serial.*` bytes, bits and frames.
    """
    up, down, board = uart.up, uart.down, firmware.mavlink
    assert board is not None

    def counts() -> tuple[int, ...]:
        at_station = link.counters if link else None
        return (
            up.deliveries, down.deliveries, up.latency_sum_us, down.latency_sum_us,
            up.busy_us, down.busy_us, up.sent_bytes, down.sent_bytes, up.overrun_bytes,
            up.dropped_bytes + down.dropped_bytes, up.cut_bytes + down.cut_bytes, up.wrong_bits + down.wrong_bits,
            board.bad, board.lost, at_station.bad if at_station else 0, at_station.lost if at_station else 0,
        )  # fmt: skip

    return Channel(
        "int64",
        counts,
        (
            quantity("link", "up_delivered down_delivered"),
            quantity("link", "up_latency_sum down_latency_sum", "us"),
            quantity("serial", "up_busy down_busy", "us"),
            quantity("serial", "up_bytes down_bytes overrun no_room cut", "bytes"),
            quantity("serial", "wrong_bits up_bad up_lost down_bad down_lost"),
        ),
    )
