"""The link inside one process: the CRTP bytes of a real flight, handed to whatever carries them."""

from collections.abc import Callable, Sequence

from firmware_py.wire.crtp import CHANNEL_LOG_DATA, PORT_LOG, decode, encode_ext_pose
from firmware_py.wire.telemetry import Sample, decode_sample, encode_stream_request
from ground_station.corrections import correct
from ground_station.latency import LinkLatency
from ground_station.mocap import MocapFrame
from ground_station.trajectory import Goal


class LoopbackLink:
    """CRTP to a carrier in the same process. `latency_us` is the latency expected of the carrier."""

    def __init__(self, transmit: Callable[[int, bytes], object], latency_us: int) -> None:
        self.latency = LinkLatency("radio", latency_us, measured=False)
        self._transmit = transmit

    def start_telemetry(self, now_us: int) -> None:
        """Ask the board for its telemetry."""
        self._transmit(now_us, encode_stream_request(True))

    def send(self, now_us: int, frame: MocapFrame, goal: Goal) -> None:
        """Hand the correction to the carrier."""
        correction = correct(frame, goal, now_us + self.latency.us)
        self._transmit(now_us, encode_ext_pose(correction.p_GB, correction.q_GB, correction.age_us))

    def receive(self, now_us: int, data: bytes) -> Sequence[Sample]:
        """The telemetry in a packet from the board, empty for a packet of another service."""
        packet = decode(data)
        if packet.port != PORT_LOG or packet.channel != CHANNEL_LOG_DATA:
            return ()
        return (decode_sample(packet.data),)
