"""A board over MAVLink, sans I/O: it sends poses and goals, receives telemetry and compares the two clocks.

The pose is sent as measured, absolute and with its own time stamp; the goal is sent separately, on changes
and every half second, and the board forms the error. For its true age the board needs the station's clock, so its
TIMESYNC requests are answered. Telemetry comes in one array, relative to the goal as the board knows it; the board's
standard messages are for other ground stations.

Telemetry that arrives at less than half of the requested rate is requested again: the request was lost, or the board has
forgotten it.
"""

from collections import Counter, deque
from collections.abc import Callable, Sequence

from firmware_py.wire import WireError, mavlink
from firmware_py.wire import mavlink_services as services
from firmware_py.wire.mavlink_dialect import NUMBERS, Message, sender_of
from firmware_py.wire.mavlink_frames import FrameReceiver, FrameSender, Signing
from firmware_py.wire.telemetry import Sample, state_in
from ground_station.config import LinkSettings
from ground_station.latency import LinkLatency
from ground_station.links.mavlink_budget import STANDING_GOAL_HZ, link_budget
from ground_station.links.mavlink_controls import MavlinkControls
from ground_station.mocap import MocapFrame
from ground_station.trajectory import Goal

SYSTEM, COMPONENT = 255, 190  # a ground station, as the standard numbers them
NO_AUTOPILOT = 8  # in a heartbeat: a ground station's, or a camera's
EVERYBODY = 0  # the addressee until the board is known
LOOK_PERIOD_US = 1_000_000
REPEAT_GOAL_US = round(1e6 / STANDING_GOAL_HZ)
TEXTS = 100  # waiting to be read
TEXT_PIECE = 50  # characters; a longer line is sent in pieces
SET_MESSAGE_INTERVAL, ACCEPTED = 511, 0  # a command and its best result


class MavlinkLink:
    """One board at the other end of `transmit(now_us, bytes)`; implements `ground_station.station.Link`.

    Raises `LinkError` when the line cannot carry a flight.
    """

    def __init__(self, transmit: Callable[[int, bytes], object], settings: LinkSettings) -> None:
        key = settings.signing_key
        signing = Signing(key, start=settings.signing_start) if key else None
        self.budget = link_budget(settings.baud, settings.corrections_hz, signing is not None)
        self.texts: deque[str] = deque(maxlen=TEXTS)  # the board's, and its refusals
        self._text = ""  # incomplete text
        self.supervisor_state: int | None = None  # as last received
        self._note_frame = settings.note_frame
        self.board: int | None = None  # its system id, None before the first heartbeat
        self.answered = False  # it has acknowledged a command
        self.received_us = 0  # arrival of its last frame
        self.latency = LinkLatency("serial", settings.latency_us, measured=False)
        self._carry = transmit
        self._sender = FrameSender(SYSTEM, COMPONENT, signing)
        self._receiver = FrameReceiver(signing)
        self.counters = self._receiver.counters  # of the downlink
        self.round_trip_us: int | None = None  # of the last time request
        self.senders: Counter[tuple[int, int]] = Counter()  # of the frames, by system and component
        self._goal: Goal | None = None  # as last sent
        self._goal_us = 0
        self._asked = False
        self._samples = 0  # of telemetry since the last check
        self._timestamp_ms: int | None = None  # of the last sample
        self._look_us = 0  # of the next check of the link
        self.controls = MavlinkControls(self._send, lambda: self._addressee)
        self._time_request_ns = 0  # own clock in the last request
        self._read_us = 0  # when the bytes now being decoded were read
        self._handlers: dict[str, Callable[[int, Message], Sequence[Sample] | None]] = {
            "HEARTBEAT": self._on_heartbeat,
            "TIMESYNC": self._on_timesync,
            "DEBUG_FLOAT_ARRAY": self._on_flight_array,
            "SYS_STATUS": self._on_status,
            "COMMAND_ACK": self._on_command_ack,
            "PARAM_VALUE": self._on_parameter,
            "STATUSTEXT": self._on_text,
        }

    # Uplink

    def start_telemetry(self, now_us: int) -> None:
        self._asked = True
        self._samples = 0
        self._look_after(now_us)

    def send(self, now_us: int, frame: MocapFrame, goal: Goal) -> None:
        """Send the pose, after a changed goal; less urgent messages follow."""
        pose = mavlink.pose(frame.t_us, frame.p_WB, frame.q_WB)
        since_us = now_us - self._goal_us
        if self._goal is None or (goal != self._goal and since_us >= self.budget.goal_period_us):
            self._send_goal(now_us, frame, goal)
        self._send(now_us, pose)
        if goal == self._goal and now_us - self._goal_us >= REPEAT_GOAL_US:
            self._send_goal(now_us, frame, goal)
        if now_us >= self._look_us:
            self._look_after(now_us)

    def _send_goal(self, now_us: int, frame: MocapFrame, goal: Goal) -> None:
        self._send(now_us, mavlink.target(frame.t_us // 1000, goal.p_WG, goal.yaw, self._addressee))
        self._goal, self._goal_us = goal, now_us

    @property
    def _addressee(self) -> int:
        return EVERYBODY if self.board is None else self.board

    def _send(self, now_us: int, message: Message) -> None:
        frame = self._sender.encode(now_us, message)
        self._carry(now_us, frame)
        if self._note_frame is not None:
            self._note_frame(now_us, frame)

    def forget(self) -> None:
        """Forget the board's state until the next heartbeat."""
        self.supervisor_state = None

    def _look_after(self, now_us: int) -> None:
        """Send a time request and a heartbeat, and request telemetry again that is too slow."""
        self._look_us = now_us + LOOK_PERIOD_US
        self._time_request_ns = now_us * 1000
        self._send(now_us, services.timesync(0, self._time_request_ns))
        self._send(now_us, services.station_heartbeat())
        rate_hz = self.budget.telemetry_hz
        if self._asked and self._samples < rate_hz / 2:
            wanted = (SET_MESSAGE_INTERVAL, NUMBERS["DEBUG_FLOAT_ARRAY"], 1_000_000 // rate_hz)
            self._send(now_us, services.command(self._addressee, *wanted))
        self._samples = 0

    # Downlink

    def receive(self, now_us: int, data: bytes, read_us: int | None = None) -> Sequence[Sample]:
        """Return the telemetry in a piece of the byte stream that arrived at `now_us`, perhaps empty; never raises.

        `read_us` is the present instant where that is later.
        """
        self._read_us = now_us if read_us is None else read_us
        samples: list[Sample] = []
        for message in self._receiver.feed(now_us, data):
            if self._note_frame is not None:
                self._note_frame(now_us, bytes(message.get_msgbuf()))
            self.senders[sender_of(message)] += 1
            handler = self._handlers.get(message.get_type())
            if handler is None or not self._is_of_board(message):
                continue
            self.received_us = now_us
            samples += handler(now_us, message) or ()
        if self._read_us >= self._look_us:
            self._look_after(self._read_us)
        return samples

    def _is_of_board(self, message: Message) -> bool:
        system = message.get_srcSystem()
        return message.get_srcComponent() == services.BOARD_COMPONENT and self.board in (None, system)

    def _on_heartbeat(self, now_us: int, message: Message) -> None:
        if message.autopilot != NO_AUTOPILOT:
            self.board = message.get_srcSystem()
            self.supervisor_state = services.read_heartbeat(message)

    def _on_timesync(self, now_us: int, message: Message) -> None:
        if message.tc1 == 0:
            # The board takes our answer's time for the middle between its request and its receipt. So it gets the middle
            # between arrival and answer, as in NTP: a late answer is less precise, but not wrong.
            middle_us = (now_us + self._read_us) // 2
            self._send(self._read_us, services.timesync_answer(middle_us * 1000, message))
        elif message.ts1 == self._time_request_ns:
            self.round_trip_us = now_us - message.ts1 // 1000
            self.latency = LinkLatency("serial", self.round_trip_us // 2, measured=True)

    def _on_command_ack(self, now_us: int, message: Message) -> None:
        self.answered = True
        if not self.controls.receive(self._read_us, message) and message.result != ACCEPTED:
            self.texts.append(services.refusal(message))

    def _on_parameter(self, now_us: int, message: Message) -> None:
        self.controls.receive(self._read_us, message)

    def _on_text(self, now_us: int, message: Message) -> None:
        self._text = self._text + message.text if message.chunk_seq else message.text
        continued = message.id and len(message.text) == TEXT_PIECE
        if not self.controls.receive(self._read_us, message) and not continued:
            self.texts.append(f"board: {self._text}")

    def _on_flight_array(self, now_us: int, message: Message) -> Sequence[Sample]:
        try:
            samples = mavlink.read_flight_array(message)
        except WireError:
            return ()  # an array of another name
        self._samples += 1
        self._timestamp_ms = samples[0].timestamp_ms
        self.supervisor_state = state_in(samples)
        return samples

    def _on_status(self, now_us: int, message: Message) -> Sequence[Sample]:
        """Join it with the newest telemetry, once there is some."""
        return () if self._timestamp_ms is None else mavlink.read_sys_status(message, self._timestamp_ms)
