"""The link inside one process: the CRTP bytes of a real flight, passed to any carrier."""

from collections.abc import Callable, Mapping, Sequence

from firmware_py.wire.crtp import PORT_LOG, decode, encode_ext_pose
from firmware_py.wire.telemetry import Sample
from ground_station.corrections import correct
from ground_station.latency import LinkLatency
from ground_station.links.log_blocks import LogBlocks
from ground_station.mocap import MocapFrame
from ground_station.trajectory import Goal


class LoopbackLink:
    """CRTP to a carrier in the same process. `latency_us` is the latency expected of the carrier.

    `log_table` returns the numbers of the board's log variables, as a station knows them from an earlier connection.
    """

    def __init__(
        self,
        transmit: Callable[[int, bytes], object],
        latency_us: int,
        log_table: Callable[[], Mapping[str, int]],
    ) -> None:
        self.latency = LinkLatency("radio", latency_us, measured=False)
        self._transmit = transmit
        self._logs = LogBlocks(transmit, log_table)

    def start_telemetry(self, now_us: int) -> None:
        self._logs.request(now_us)

    def send(self, now_us: int, frame: MocapFrame, goal: Goal) -> None:
        """Pass the correction to the carrier."""
        self._transmit(now_us, encode_ext_pose(*correct(frame, goal, now_us + self.latency.us)))
        self._logs.repeat(now_us)

    def receive(self, now_us: int, data: bytes) -> Sequence[Sample]:
        """Return the telemetry in a packet from the board, empty for a packet of another service."""
        packet = decode(data)
        return self._logs.receive(now_us, packet) if packet.port == PORT_LOG else ()
