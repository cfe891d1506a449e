"""One rigid body from a NatNet stream: packets and the time in, poses in the world and notices out. Sans I/O.

A server with a newer NatNet than this can read is asked for the newest readable version.

Messages bound the offset of the server's clock. One sent by the server at s that arrived at t shows that the offset to
ours is at most t - s; a request sent at a and answered at s shows that it is at least a - s. The limits widen with
time because clocks drift; the middle is the estimate.
"""

import math
from dataclasses import dataclass

from firmware_py.geometry import Quaternion, Vector
from ground_station.errors import MocapError
from ground_station.mocap import FROZEN_FRAMES, MocapFrame
from ground_station.sources import natnet
from ground_station.sources.alignment import Alignment, choose_body
from ground_station.sources.natnet_reader import Version
from ground_station.sources.silence import Silence
from ground_station.throttle import Throttle
from ground_station.unused import Reason, Unused

DRIFT = 50e-6  # between two computers, at most; quartz


class ServerClock:
    """Maps ticks of the server to our microseconds."""

    def __init__(self, hz: int) -> None:
        self._hz = hz
        self._lower = -math.inf  # of our clock minus the server's [us]
        self._upper = math.inf
        self._at_us = 0

    def sent(self, ticks: int, now_us: int) -> None:
        """Note a message that the server sent at `ticks`."""
        self._limit(-math.inf, now_us - self._us(ticks), now_us)

    def answered(self, asked_us: int, ticks: int, now_us: int) -> None:
        """Note that the request of `asked_us` was answered at `ticks`."""
        self._limit(asked_us - self._us(ticks), now_us - self._us(ticks), now_us)

    def to_station_us(self, ticks: int) -> int:
        """Return the instant on our clock; without answers, late by a message's least latency; call `sent` before."""
        offset = self._upper if self._lower == -math.inf else 0.5 * (self._lower + self._upper)
        return round(self._us(ticks) + offset)

    def _us(self, ticks: int) -> float:
        return ticks * 1e6 / self._hz

    def _limit(self, lower: float, upper: float, now_us: int) -> None:
        wider = DRIFT * (now_us - self._at_us)
        self._at_us = now_us
        self._lower = max(self._lower - wider, lower)
        self._upper = min(self._upper + wider, upper)
        if self._lower > self._upper:  # the server's clock was set
            self._lower, self._upper = lower, upper


LATE_FRAMES = 100  # an older number is from a server that has restarted
# So many in sequence mean that the server's clock was set; a socket's backlog is shorter.
MISTIMED_FRAMES = 1000
OLDEST_US = 1_000_000  # an older exposure is useless, or its time stamp is wrong
CALL_PERIOD_US = 500_000
MODELS_CHANGED = 2  # bit of a frame's parameters
# The command that changes the protocol version of the stream.
BITSTREAM = f"Bitstream,{natnet.VERSIONS[-1][0]}.{natnet.VERSIONS[-1][1]}"
NOWHERE: tuple[Vector, Quaternion] = ((0.0, 0.0, 0.0), (1.0, 0.0, 0.0, 0.0))


@dataclass(slots=True)
class StreamCounters:
    frames: int = 0  # passed on
    lost: int = 0  # of these, without a pose
    dropped: int = 0  # repeated, or after a newer one
    malformed: int = 0  # packets that cannot be read
    mistimed: int = 0  # lost for their time stamp


class NatnetStream:
    """Follows body `name`, or the only one when empty; `outgoing` are packets for the server's command port."""

    def __init__(self, name: str, alignment: Alignment) -> None:
        self.counters = StreamCounters()
        self.server: natnet.ServerInfo | None = None
        self.version = natnet.VERSIONS[0]  # of the server's packets
        self.models: natnet.ModelDefinition | None = None
        self.outgoing: list[bytes] = []
        self.notices: list[str] = []
        self._name = name
        self._alignment = alignment
        self._newer: natnet.ServerInfo | None = None  # it was asked for an older version
        self._clock = ServerClock(1)
        self._id: int | None = None
        self._number: int | None = None
        self._pose: natnet.BodyPose | None = None
        self._repeated = 0
        self._mistimed = 0  # frames in sequence
        self._silence = Silence(self.notices)
        self._call_us = 0
        self._throttle = Throttle()

    def on_packet(self, data: bytes, now_us: int) -> MocapFrame | None:
        """Take a packet; return the pose if it is a new frame.

        `MocapError` when the server or its bodies are not the wanted ones; later changes become notices.
        """
        try:
            message = natnet.decode(data, self.version)
        except MocapError as error:
            self.counters.malformed += 1
            self._report_unreadable(error, now_us)
            return None
        if isinstance(message, natnet.Frame):
            return self._on_frame(message, now_us) if self.models is not None else None
        if isinstance(message, natnet.Echo):
            if 0 <= now_us - message.asked <= OLDEST_US:
                self._clock.answered(message.asked, message.server, now_us)
        elif isinstance(message, natnet.ServerInfo | natnet.ModelDefinition | natnet.Response):
            try:
                self._on_answer(message)
            except MocapError as error:
                self._id = None
                if self.models is None:
                    raise
                self.notices.append(f"motion capture: {error}")
        return None

    def _report_unreadable(self, error: MocapError, now_us: int) -> None:
        """Report the reason now and then, so that no packets look like silence."""
        if self._throttle.admits("unreadable", now_us):
            count = self.counters.malformed
            packets = "1 packet" if count == 1 else f"{count} packets"
            self.notices.append(f"motion capture: {packets} cannot be read: {error}")

    def call(self, now_us: int, packets_wait: bool) -> None:
        """Keep the connection alive; call it often. A silent server is asked to identify itself.

        Not while packets wait: then this program did not read.
        """
        if now_us < self._call_us:
            return
        self._call_us = now_us + CALL_PERIOD_US
        silent = not packets_wait and self._silence.lasts(now_us)
        if self.server is None or silent:
            self.outgoing.append(natnet.packet(natnet.MessageId.CONNECT, b"Ping\0"))
        elif self.models is None:
            self.outgoing.append(natnet.packet(natnet.MessageId.REQUEST_MODELDEF, b"\0"))
        self.outgoing.append(natnet.packet(natnet.MessageId.KEEPALIVE, b"\0"))
        self.outgoing.append(natnet.packet(natnet.MessageId.ECHO_REQUEST, now_us.to_bytes(8, "little")))

    def missing(self) -> str:
        """Return what the server has not answered yet, before there are models."""
        if self._newer is not None:
            return str(_unreadable(self._newer))
        return "no NatNet server answers" if self.server is None else "the server names no bodies"

    def _on_answer(self, answer: natnet.ServerInfo | natnet.ModelDefinition | natnet.Response) -> None:
        if isinstance(answer, natnet.ServerInfo):
            self._on_server(answer)
        elif isinstance(answer, natnet.Response):
            self._on_response(answer)
        elif self.server is not None:
            names = [body.name for body in answer.bodies]
            self._id = answer.bodies[names.index(choose_body(self._name, names))].id
            self.models = answer

    def _on_server(self, server: natnet.ServerInfo) -> None:
        version = server.natnet_version[:2]
        if version in natnet.VERSIONS:
            self._accept(server, version)
        elif version > natnet.VERSIONS[-1] and not server.multicast:  # else all clients get the same
            self._newer = server
            self.outgoing.append(natnet.packet(natnet.MessageId.REQUEST, BITSTREAM.encode() + b"\0"))
        else:
            raise _unreadable(server)

    def _on_response(self, response: natnet.Response) -> None:
        """Take the answer to `BITSTREAM`, the only request."""
        server, self._newer = self._newer, None
        if server is None:
            return
        if response.code != 0 and not response.text.startswith(BITSTREAM):
            raise _unreadable(server)
        self._accept(server, natnet.VERSIONS[-1])

    def _accept(self, server: natnet.ServerInfo, version: Version) -> None:
        if self.server != server:
            self.version = version
            self._clock = ServerClock(server.clock_hz)
        self.server = server
        self.outgoing.append(natnet.packet(natnet.MessageId.REQUEST_MODELDEF, b"\0"))

    def _on_frame(self, frame: natnet.Frame, now_us: int) -> MocapFrame | None:
        counters = self.counters
        if self._number is not None and 0 <= self._number - frame.number < LATE_FRAMES:
            counters.dropped += 1
            return None
        self._number = frame.number
        self._silence.on_frame(now_us)
        if frame.parameters & MODELS_CHANGED:
            self.outgoing.append(natnet.packet(natnet.MessageId.REQUEST_MODELDEF, b"\0"))
        counters.frames += 1
        t_us, unused = self._exposed_us(frame, now_us)
        if unused is not None:
            counters.lost += 1
            return MocapFrame(now_us, *NOWHERE, valid=False, unused=unused)
        pose = next((body for body in frame.bodies if body.id == self._id), None)
        (p, q), unused = self._placed(pose)
        counters.lost += unused is not None
        received_us, sent_us = map(self._clock.to_station_us, (frame.received, frame.transmitted))
        received_us = max(t_us, min(received_us, now_us))  # the clocks' offset is less certain
        sent_us = max(received_us, min(sent_us, now_us))
        reason = unused or (Reason.NOT_TRACKED, ())
        return MocapFrame(t_us, p, q, unused is None, received_us, sent_us, now_us, reason)

    def _exposed_us(self, frame: natnet.Frame, now_us: int) -> tuple[int, Unused | None]:
        """Return the exposure on our clock; with a reason where the server's time stamps make no sense."""
        self._clock.sent(frame.transmitted, now_us)
        # Cameras without a clock have no exposure, only an arrival.
        t_us = min(now_us, self._clock.to_station_us(frame.mid_exposure or frame.received))
        if now_us - t_us <= OLDEST_US:
            self._mistimed = 0
            return t_us, None
        self.counters.mistimed += 1
        self._mistimed += 1
        if self._mistimed == MISTIMED_FRAMES and self.server is not None:
            self._mistimed = 0
            self._clock = ServerClock(self.server.clock_hz)
        return t_us, (Reason.MISTIMED, ((now_us - t_us) * 1e-6,))

    def _placed(self, pose: natnet.BodyPose | None) -> tuple[tuple[Vector, Quaternion], Unused | None]:
        """Return the pose in the world; with a reason where it is missing, not tracked or a repetition of the last."""
        if pose is None:
            return NOWHERE, (Reason.ABSENT, ())
        last, self._pose = self._pose, pose
        same = last is not None and (last.p, last.q) == (pose.p, pose.q)
        self._repeated = self._repeated + 1 if same else 0
        if not pose.valid:
            return NOWHERE, (Reason.NOT_TRACKED, ())
        if self._repeated >= FROZEN_FRAMES:
            return NOWHERE, (Reason.FROZEN, ())
        return self._alignment.to_world(pose.p, pose.q), None


def _unreadable(server: natnet.ServerInfo) -> MocapError:
    major, minor = server.natnet_version[:2]
    return MocapError(f"NatNet {major}.{minor} of {server.name}: 3.0, 3.1, 4.0 or 4.1 is needed")
