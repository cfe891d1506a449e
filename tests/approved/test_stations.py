"""A ground station answers random cameras, boards and operators as it did, on a time of the test.

If a change is meant: make approve.
"""

import errno
import math
import struct
from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import replace
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from types import SimpleNamespace as Made
from typing import Any

import pytest

from firmware_py.elementary import cos, sin
from firmware_py.table import OF_PROFILE
from firmware_py.wire import WireError, core_port, crtp, log, mavlink, parameters, supervisor
from firmware_py.wire import mavlink_services as services
from firmware_py.wire.mavlink_frames import FrameSender, Signing
from firmware_py.wire.scalars import Scalar
from firmware_py.wire.supervisor import State
from firmware_py.wire.telemetry import ALL_BLOCKS, CRAZYFLIE_BLOCKS, Sample
from ground_station import program
from ground_station.config import (
    CaptureConfig,
    GroundConfig,
    LinkSettings,
    PilotConfig,
    StationConfig,
    TrackerConfig,
)
from ground_station.controls import Answer, ControlAction, ControlRequest, ControlsError
from ground_station.errors import LinkError, MocapError
from ground_station.frame_rate import FrameRate
from ground_station.latency import LinkLatency, budget_of, columns_of
from ground_station.links import core_client, live_link, mavlink_serial
from ground_station.links.crazyflie_link import CrazyflieLink, FlightTimes, FromFloor
from ground_station.links.crtp_controls import CrtpControls, TocEntry
from ground_station.links.live_link import LiveLink
from ground_station.links.log_blocks import LogBlocks
from ground_station.links.mavlink import MavlinkLink
from ground_station.mocap import MocapFrame
from ground_station.operator import COMMANDS, Operator
from ground_station.records import Records
from ground_station.sources import motioncapture_client, natnet, replay
from ground_station.sources.alignment import Alignment
from ground_station.sources.motioncapture_process import Arrival, encode_arrival
from ground_station.sources.natnet_stream import NatnetStream
from ground_station.station import GroundStation
from ground_station.telemetry_log import TelemetryLog
from ground_station.tracker import Tracker
from ground_station.trajectory import Course, FlightPlan, Goal, Hold, Offsets, Sine, Square, Step
from ground_station.unused import Reason
from support import natnet_packets
from support.approved import approve, judge, tiers
from support.random_use import Random, by_seed, hash_of

ANSWERS = Path(__file__).with_name("stations.json")
SEEDS = range(1, 4)
HOME = Goal((0.1, -0.2, 1.15), 0.3)
KEY = bytes(range(32))


class Cameras(Random):
    """Frames of a body that drifts, is lost, jumps between places and has wrong numbers; its clock may jump as well."""

    p, yaw, t_us, shift_us, away = (0.1, -0.2, 1.0), 0.0, 0, 0, False

    def frame(self, period_us: int) -> MocapFrame:
        """Return the next frame."""
        self.t_us += self.pick(period_us, period_us, period_us, period_us, 2 * period_us, 3 * period_us + 700)
        if self.below(150) == 0:
            self.t_us += self.pick(60_000, 450_000, 2_500_000)
            self.shift_us += self.pick(0, -600_000, 900_000)
        self.away = self.away ^ (self.below(40) == 0)
        steps = (1e-4 * self.rng.integers(-4, 5, 4)).tolist()
        x, y, z = self.p = tuple(a + b for a, b in zip(self.p, steps, strict=False))  # type: ignore[assignment]
        self.yaw += 10.0 * steps[3]
        jump = self.pick(0.02, 0.3, 0.3) if self.away and self.below(3) else 0.0
        turn = self.yaw + (2.0 if self.away and self.below(4) == 0 else 0.0)
        place = (x + jump, y - 0.5 * jump, z)
        wrong = {0: (math.nan, y, z), 1: (80.0, y, z), 2: (9e4, y, z)}.get(self.below(90), place)
        length = self.pick(*[1.0] * 60, 1.2, 1.005)
        t_us = self.t_us + self.shift_us - self.pick(*[0] * 60, period_us, 4 * period_us, 2 * period_us)
        stages = (t_us + 2_000, t_us + self.pick(3_000, 3_500), t_us + self.pick(4_000, 9_000))
        q = (length * cos(turn / 2), 0.0, 0.0, length * sin(turn / 2))
        unused = self.pick(Reason.NOT_TRACKED, Reason.NOT_TRACKED, Reason.FROZEN, Reason.ABSENT), ()
        arrived = self.pick(stages, stages, (None, None, t_us + 5_000))
        return MocapFrame(t_us, wrong, q, self.below(25) > 0, *arrived, unused=unused)


class Followed(Cameras):
    """A station with tracker, MAVLink and a record, against a board that forgets, lies and speaks with another key."""

    def message(self, link: MavlinkLink, asked: list[Any]) -> Any:
        """Return what the board, or another one, may say."""
        request = self.pick(*asked[-30:]) if asked else services.timesync(0, 5)
        values = (0.01 * self.rng.integers(-200, 200, 58)).tolist()
        texts = services.status_text(
            self.pick(3, 4, 6), self.pick("low battery", "long " * 24), 1 + self.below(3)
        )
        count = self.pick(3, 4)
        index = self.below(count + 1)
        name = services.mavlink_name(self.pick("floaty.stop", "extCtrl.y_P", "own.gain"))
        return self.pick(
            services.heartbeat(self.pick(True, False), self.pick(*State)), services.station_heartbeat(),
            services.timesync(0, 7 * self.below(10**9)),
            services.timesync_answer(self.now_us * 1000, services.timesync(0, link._time_request_ns)),
            *[mavlink.flight_array(self.now_us, values)] * 4,
            mavlink.sys_status(*(self.below(90) for _ in range(5))), *texts[: 1 + self.below(2)],
            services.command_ack(self.pick(511, 400, 245, 185), self.pick(0, 0, 2, 4), 255, 190),
            services.parameter(name, self.pick(0.0, 1.5, -2.0), index, count), request,
        )  # fmt: skip

    def told(self, seed: int) -> dict[str, str]:
        period_us, self.now_us = self.pick(5_000, 8_333, 10_000), 10_000
        sent: list[Any] = []
        signed = seed == 2
        settings = LinkSettings(
            self.pick(50.0, 40.0), 1_700, 115_200, KEY * signed, 900,
            lambda now_us, frame: self.log.note("noted", now_us, frame.hex()),
        )  # fmt: skip
        link = MavlinkLink(lambda now_us, frame: self.log.note("sent", now_us, frame.hex()), settings)
        encode = link._sender.encode
        link._sender = Made(encode=lambda now_us, message: (sent.append(message), encode(now_us, message))[1])  # type: ignore[assignment]
        boards = [
            FrameSender(system, component, Signing(key, start=901) if key else None)
            for system, component, key in (
                (1, 1, KEY * signed), (1, 1, KEY * signed), (7, 1, b""), (1, 100, b""), (1, 1, b"\1" * 32),
            )
        ]  # fmt: skip
        tracker = None if seed == 3 else Tracker(TrackerConfig(), period_us)
        rate = FrameRate(self.pick(period_us, 20_000), settings.corrections_hz, self.pick(400_000, 6_000))
        with TemporaryDirectory() as folder:
            written = TelemetryLog(Path(folder, "log.csv"))
            plan = FlightPlan(
                HOME, lambda home, start_us: Offsets(home, start_us, x=Step(0.1), yaw=Sine(1.0, 0.2))
            )
            station = GroundStation(
                link, plan, written.write, StationConfig(corrections_hz=settings.corrections_hz), tracker
            )
            for turn in range(1200):
                frame = self.frame(period_us)
                self.now_us = max(self.now_us + self.pick(0, 300), self.t_us + self.pick(5_000, 9_000))
                station.on_frame(frame, self.now_us)
                if self.below(400) == 0:
                    self.pick(
                        partial(plan.start, self.now_us),
                        partial(plan.steer, Hold(Goal((0.2, 0.0, 1.0), 1.0))),
                    )()
                if notice := rate.on_frame(frame.t_us):
                    self.log.note("rate", notice)
                if self.below(3) == 0:
                    self.answered(link, station, boards, sent)
                if turn % 40 == 0:
                    self.look(link, station)
                for line in station.notices():
                    self.log.note("notice", self.now_us, line)
                track = station.track
                self.log.note(
                    "track",
                    *([] if track is None else (track.v_WB, track.w_B, track.quality, track.frame.unused)),
                )
            self.log.note(
                "rows", hash_of(Path(folder, "log.csv").read_bytes()) if written.close() is None else 0
            )
        budget = station.budget
        self.log.note(
            "stages", budget.last(), budget_of(columns_of([budget.last()]), "air"), link.senders, link.budget
        )
        return self.log.told()

    def answered(
        self, link: MavlinkLink, station: GroundStation, boards: list[FrameSender], sent: list[Any]
    ) -> None:
        """Let some bytes arrive, or ask the board for something."""
        if self.below(25) == 0:
            action = self.pick(*ControlAction)
            name = self.pick("floaty.stop", "extCtrl.y_P", "EXT_Y_P", "own.gian")
            link.controls.ask(self.now_us, ControlRequest(action, name, self.pick(1.5, 0.0, 1e9)))
        if (answer := link.controls.answer(self.now_us)) is not None:
            self.log.note("answer", self.now_us, answer)
        data = b"".join(
            self.pick(*boards).encode(self.now_us, self.message(link, sent)) for _ in range(self.below(4))
        )
        data = data[self.pick(*[0] * 20, 1) :] + self.data(*[0] * 20, 3)
        if self.below(2):
            station.on_packet(self.now_us, data)
        else:
            samples = link.receive(self.now_us, data, self.now_us + self.pick(0, 4_000))
            self.log.note("samples", *((one.block.id, one.timestamp_ms, one.values) for one in samples))
        if self.below(200) == 0:
            link.forget()

    def look(self, link: MavlinkLink, station: GroundStation) -> None:
        """Note what the user sees."""
        self.log.note(
            "counters", station.counters, link.counters, link.board, link.answered, link.received_us
        )
        self.log.note("link", link.latency, link.round_trip_us, link.supervisor_state, list(link.texts))
        self.log.note(
            "summary", station.unused.summary(), station.budget, station.tracker and station.tracker.summary()
        )
        self.log.note(
            "newest", *((number, one.timestamp_ms) for number, one in sorted(station.telemetry.items()))
        )


NAMES = (
    "floaty.stop",
    "floaty.armed",
    "extCtrl.y_P",
    "extCtrl.yaw_P",
    "own.count",
    "own.fixed",
    "kalman.resetEstimation",
)
TABLE = {
    name: TocEntry(number, scalar, number != 5, number in (2, 4))
    for number, (name, scalar) in enumerate(zip(
        NAMES, (Scalar.U8, Scalar.U8, Scalar.F32, Scalar.F32, Scalar.I16, Scalar.U32, Scalar.U8), strict=True,
    ))
}  # fmt: skip


class Board(Random):
    """A Crazyflie that answers packets of the parameter, platform, supervisor and log ports, or refuses, or stays silent."""

    def __init__(self, seed: int) -> None:
        super().__init__(seed)
        self.back: list[bytes] = []  # on its way to the station

    def transmit(self, at_us: int, data: bytes) -> None:
        """Take a packet, and send what comes back."""
        self.log.note("sent", at_us, data.hex())
        self.back.extend(self.answer(data))

    def answer(self, raw: bytes) -> list[bytes]:
        """Return what comes back."""
        packet = crtp.decode(raw)
        if self.below(6) == 0:
            return []
        data, good = packet.data, self.below(12) > 0
        if packet.port == crtp.PORT_PARAMETERS:
            number = int.from_bytes(data[:2], "little")
            entry = list(TABLE.values())[number % len(TABLE)]
            value = entry.scalar.pack(self.pick(0, 1, 2))
            if packet.channel == parameters.CHANNEL_READ:
                data = data[:2] + (bytes(1) + value if good else b"\2")
            elif packet.channel == parameters.CHANNEL_WRITE:
                data = data if good else data[:2] + value
            else:
                data = data[:3] + bytes((0 if good else 2,))
        elif packet.port == crtp.PORT_LOG:
            data = data[:2] + bytes((0 if good else self.pick(17, 12),))
        elif packet.channel == supervisor.PLATFORM_VERSION and packet.port == crtp.PORT_PLATFORM:
            data = data[:1] + bytes((self.pick(5, 12, 13),))
        elif packet.port == crtp.PORT_SUPERVISOR and packet.channel == supervisor.SUPERVISOR_INFO:
            data = bytes((supervisor.REPLY | data[0], *self.data(2)))
        else:
            reply = supervisor.REPLY if packet.port == crtp.PORT_SUPERVISOR else 0
            data = bytes((data[0] | reply, 1 if good else 0, 0))
        answers = [crtp.encode(replace(packet, data=data))]
        if self.below(8) == 0:
            answers.insert(
                self.below(2), crtp.encode(crtp.Packet(self.pick(2, 13, 9), self.below(3), self.data(2, 5)))
            )
        return answers * self.pick(1, 1, 1, 2)


class Asked(Board):
    """Requests of an operator to a Crazyflie."""

    def told(self, seed: int) -> dict[str, str]:
        now_us = 0
        controls = CrtpControls(lambda data: self.transmit(now_us, data), lambda: TABLE)
        for _ in range(700):
            now_us += self.pick(5_000, 40_000, 150_000)
            if self.below(9) == 0:
                name = self.pick(*NAMES, *NAMES, "own.fixt", "own", "")
                controls.ask(
                    now_us, ControlRequest(self.pick(*ControlAction), name, self.pick(1.0, 2.5, 300.0, -1.0))
                )
            while self.back and self.below(3):
                controls.receive(now_us, crtp.decode(self.back.pop(0)))
            if (answer := controls.answer(now_us)) is not None:
                self.log.note("answer", now_us, answer.error, *answer.values)
            self.log.note("busy", controls.busy)
        return self.log.told()


class Stock(Board):
    """A flight of a Crazyflie with its own firmware, whose goal moves in one of two flights; telemetry by log blocks."""

    def told(self, seed: int) -> dict[str, str]:
        now_us = 0
        config = PilotConfig(
            enabled=True, parameters={"own": {"count": 3.0}, "extCtrl": {"y_P": 2.0, "no": 1.0}}, poses=seed != 2,
            take_off_s=1.5, settle_s=0.5, land_s=2.0,
        )  # fmt: skip
        times = FlightTimes.of(config, 3_000_000, 9_000_000)
        numbers = {
            variable.name: 3 * place for place, variable in
            enumerate(variable for block in CRAZYFLIE_BLOCKS for variable in block.variables)
        }  # fmt: skip
        if seed == 3:
            numbers.pop(CRAZYFLIE_BLOCKS[-1].variables[0].name)

        flown = (
            Offsets(HOME, times.begin_us, y=Square(0.2, -0.1, 0.7), z=Sine(0.1, 0.5))
            if seed != 1
            else Hold(HOME)
        )
        whole = FromFloor(flown, 0.02, HOME, config, times)
        link = CrazyflieLink(self.transmit, 1_900, lambda: numbers, TABLE, config, HOME, times)
        link.start_telemetry(0)
        self.log.note("times", times, link.latency)
        for turn in range(700):
            now_us += self.pick(20_000, 20_000, 25_000)
            goal = flown.at(now_us)
            self.log.note("goal", whole.at(now_us))
            link.send(
                now_us,
                MocapFrame(now_us - 9_000, (0.1, 0.01 * (turn % 9), 1.0), (1.0, 0.0, 0.0, 0.0), True),
                goal,
            )
            if self.below(40) == 0:
                link.start_telemetry(now_us)
            while self.back and self.below(4):
                link.receive(now_us, self.back.pop(0))
            block = self.pick(*CRAZYFLIE_BLOCKS)
            size = sum(variable.type.size for variable in block.variables)
            head = bytes((block.id if self.below(20) else 77, *(now_us // 1000).to_bytes(3, "little")))
            try:
                packet = crtp.Packet(
                    crtp.PORT_LOG, log.CHANNEL_DATA, head + bytes(turn % 50 for _ in range(size))
                )
                self.log.note(
                    "samples",
                    *(
                        (s.block.id, s.timestamp_ms, s.values)
                        for s in link.receive(now_us, crtp.encode(packet))
                    ),
                )
            except WireError as error:
                self.log.note("malformed", error)
        self.log.note("notices", *link.notices, *link._logs.notices, link._logs.requested)
        return self.log.told()


class Logged(Board):
    """Telemetry of Floaty's own blocks, of which a board may lack some variables, begins at any time."""

    def told(self, seed: int) -> dict[str, str]:
        numbers = {
            variable.name: place for place, variable in
            enumerate(variable for block in ALL_BLOCKS for variable in block.variables) if seed != 2 or place != 9
        }  # fmt: skip

        logs, now_us = LogBlocks(self.transmit, lambda: numbers if seed != 3 else {}), 16_777_000_000
        for _ in range(600):
            now_us += self.pick(3_000, 10_000, 120_000)
            if self.below(60) == 0:
                logs.request(now_us)
            logs.repeat(now_us)
            while self.back and self.below(4):
                packet = crtp.decode(self.back.pop(0))
                if packet.port == crtp.PORT_LOG:
                    logs.receive(now_us, packet)
            block = self.pick(*ALL_BLOCKS)
            stamp_ms = now_us // 1000 - self.pick(0, 3, 9) & 0xFFFFFF
            values = (
                self.data(sum(variable.type.size for variable in block.variables))
                .replace(b"\x7f", b"\1")
                .replace(b"\xff", b"\2")
            )
            head = bytes((block.id, *stamp_ms.to_bytes(3, "little")))
            try:
                samples = logs.receive(now_us, crtp.Packet(crtp.PORT_LOG, log.CHANNEL_DATA, head + values))
                self.log.note("samples", *((one.block.id, one.timestamp_ms, one.values) for one in samples))
            except WireError as error:
                self.log.note("malformed", error)
            self.log.note("requested", logs.requested)
        self.log.note("notices", *logs.notices)
        return self.log.told()


class Typed(Random):
    """Lines of an operator, at a link that answers, refuses or is slow."""

    def told(self, seed: int) -> dict[str, str]:
        now_us, asked = 0, []
        courses = {
            "circle": lambda home, start_us: Offsets(home, start_us, x=Sine(0.2, 0.1)),
            "hover": lambda home, start_us: Hold(home),
        }

        def find(name: str) -> Callable[[Goal, int], Any]:
            if name not in courses:
                raise ControlsError(f"no experiment {name}")
            return courses[name]

        def ask(at_us: int, request: ControlRequest) -> None:
            self.log.note("asked", at_us, request)
            asked[:] = [request]

        def answer(at_us: int) -> Answer | None:
            if not asked or self.below(3) == 0:
                return None
            request = asked.pop()
            if self.below(8) == 0:
                return Answer((), self.pick("no answer within 2 s", "refused"))
            if request.action is ControlAction.LIST:
                return Answer((("extCtrl.y_P", 1.5), ("own.count", 4.0), ("own.fixed", 7.0)))
            name = request.name.replace("EXT_Y_P", "extCtrl.y_P")
            return Answer(
                ((name, request.value if request.action is ControlAction.WRITE else self.pick(0.5, 2.0)),)
            )

        plan = FlightPlan(HOME, courses["hover"])
        link = Made(ask=ask, answer=answer, supervisor_state=None)
        session: Any = Made(link=link, ground=Made(frame=None), plan=plan)
        say, note, know = (partial(self.log.note, kind) for kind in ("said", "noted", "known"))
        operator = Operator(find, say, note, None if seed == 2 else know)
        profile = tuple(OF_PROFILE)
        for turn in range(900):
            now_us += self.pick(20_000, 200_000, 900_000)
            if turn == 9:
                link.supervisor_state = State.FLYING
            if self.below(4) == 0:
                name = self.pick(*profile[:6], "extCtrl.y_P", "own.count", "own.gone", "EXT_Y_P")
                value = self.pick("0.25", "-3", "nan", "x", "1e3")
                place = " ".join(
                    self.pick("0", "0.1", "-0.4", "1.2", "2", "y") for _ in range(self.pick(2, 3, 3, 3, 4))
                )
                line = self.pick(
                    f"goal {place}", f"fly {self.pick('circle', 'hover', 'ring')}", f"set {name} {value}",
                    f"set {name} {value}", f"set {name} 0.75", f"get {name}", f"params {self.pick('', 'own', 'EXT', 'no')}",
                    "save", "reset", "arm", "stop",
                    "mark  two  words ", "mark", "help", "stpo", "landing", "", 'set "half', "save now", " stop ",
                )  # fmt: skip
                for _ in range(self.pick(1, 1, 1, 3, 120 if turn > 800 else 2)):
                    operator.queue_line(line)
            link.supervisor_state = self.pick(
                *[link.supervisor_state] * 30, State.FLYING, State.FLYING, State.WAITING
            )
            if self.below(3) == 0:
                off = self.pick(0.0, 0.05, 0.0999, 0.101, 0.5) if self.below(9) == 0 else 0.02
                x, y, z = plan.at(now_us).p_WG
                session.ground.frame = MocapFrame(now_us, (x, y + off, z), (1.0, 0.0, 0.0, 0.0), True)
            operator.process_lines(session, now_us)
            self.log.note("goal", now_us, plan.at(now_us))
        self.log.note("names", *operator.known, *COMMANDS)
        return self.log.told()


class Live(Cameras):
    """A station as a program: links that fail to open, are lost and come back; cameras that stop; a clock of the test."""

    def told(self, seed: int) -> dict[str, str]:
        self.now_us, turns = 5_000_000, 0
        with ExitStack() as stack:
            patch = stack.enter_context(pytest.MonkeyPatch.context())
            patch.setattr(program, "clock_us", lambda: self.now_us)
            quiet_us = 0

            def receive(timeout_s: float) -> MocapFrame | None:
                nonlocal quiet_us
                self.now_us += self.pick(0, 1_000, 5_000, round(timeout_s * 1e6))
                if self.below(300) == 0:
                    quiet_us = self.now_us + self.pick(1_000_000, 6_000_000, 11_000_000)
                if timeout_s == 0.0 or self.now_us < quiet_us:
                    return None
                frame = self.frame(5_000)
                return replace(frame, t_us=self.now_us - 4_000)

            def failing(what: str, often: int, *of: object) -> None:
                self.log.note(what, self.now_us, *of)
                self.now_us += self.pick(0, 50_000, 2_000_000)
                if self.below(often) == 0:
                    raise LinkError(f"radio://0: {what} failed")

            def received(now_us: int, data: bytes) -> list[Sample]:
                link.supervisor_state = self.pick(State.WAITING, State.FLYING, State.FAILSAFE)
                blocks = [self.pick(*ALL_BLOCKS) for _ in range(self.below(3))]
                stamp_ms = self.now_us // 10_000 * 10
                return [Sample(one, stamp_ms, (float(one.id),) * len(one.variables)) for one in blocks]

            def mute() -> None:
                failing("mute", 9)
                link.supervisor_state = None

            link: Any = Made(
                uri="radio://0", supervisor_state=None, latency=LinkLatency("radio", 1_500, measured=True), mute=mute,
                start_telemetry=partial(self.log.note, "asks"), receive=received,
                open=lambda drop: failing("open", 3, drop()),
                check=lambda: failing("check", 250) if self.below(3) == 0 else None,
                close=partial(self.log.note, "close"), summary=lambda: f"radio {self.below(9)}",
                notices=lambda: ["link says"] if self.below(60) == 0 else [],
                received=lambda: [(self.now_us, b"")] * self.below(3),
                send=lambda now_us, frame, goal: self.log.note("sent", now_us, goal),
            )  # fmt: skip
            source: Any = Made(
                receive=receive, open=lambda: None, close=lambda: self.log.note("closed"),
                notices=lambda: ["cameras say"] if self.below(60) == 0 else [], summary=lambda: "cameras fine",
            )  # fmt: skip

            def found(what: Any, *of: object) -> Any:
                self.log.note("found", what is link, *of)
                return what

            patch.setattr(program, "find_link", lambda uri, settings: found(link, uri, settings.latency_us))
            patch.setattr(program, "find_source", lambda mocap, capture: found(source, mocap, capture.system))
            folder = Path(stack.enter_context(TemporaryDirectory()))
            patch.setattr(replay, "clock_us", lambda: self.now_us)
            stop = 1500

            def stopping() -> bool:
                nonlocal turns
                turns += 1
                return turns > stop

            for _ in range(4):
                turns, stop = 0, self.pick(400, 1500)
                session = program.Session(
                    self.pick("radio://0", "udp://"), None, lambda home, start_us: Offsets(home, start_us, z=Step(0.2)), 1.5,
                    folder / "log.csv", self.pick(None, folder / "frames.csv"), records=Records(),
                )  # fmt: skip
                hooks = [
                    lambda live, now_us: self.log.note(
                        "hook", now_us, live.plan.at(now_us), live.plan.start_us
                    )
                ]
                settings = GroundConfig(
                    frame_period_us=self.pick(5_000, 9_000),
                    tracker=TrackerConfig(enabled=self.pick(True, False)),
                )
                try:
                    program.fly(settings, session, partial(self.log.note, "said"), stopping, hooks)
                except (LinkError, MocapError) as error:
                    self.log.note("ended", program.why(error, session.uri))
                for path in sorted(folder.iterdir()):
                    self.log.note("file", path.name, hash_of(path.read_bytes()))
        return self.log.told()


class Replayed(Cameras):
    """Records of frames, some damaged, and what is replayed of them at the pace of a clock that the waits move."""

    def told(self, seed: int) -> dict[str, str]:
        now = Made(us=1_000_000)
        with TemporaryDirectory() as folder, pytest.MonkeyPatch.context() as patch:
            patch.setattr(replay, "clock_us", lambda: now.us)
            patch.setattr(replay, "wait", lambda s: setattr(now, "us", now.us + round(s * 1e6)))
            path = Path(folder, "frames.csv")
            for _ in range(60):
                seen = replay.MocapLog(path)
                for _ in range(self.pick(1, 8, 30)):
                    now.us += 5_000
                    seen.write(self.frame(5_000))
                seen.close()
                text = path.read_text(encoding="utf-8")
                if self.below(3) == 0:
                    at = self.below(len(text))
                    text = self.pick(
                        text[:at], text[:at] + self.pick("x", ",", '"', "\n", "nan") + text[at + 1 :]
                    )
                    path.write_text(text, encoding="utf-8")
                source = replay.ReplaySource(path)
                try:
                    source.open()
                except MocapError as error:
                    self.log.note("refused", str(error).replace(folder, ""))
                    continue
                while not source.over:
                    now.us += self.pick(0, 500)
                    self.log.note("frame", now.us, source.receive(self.pick(0.0, 0.002, 0.02, 0.5)))
                    self.log.note("summary", source.summary())
                self.log.note(
                    "notices", *(line.replace(folder, "") for line in source.notices()), source.receive(0.1)
                )
        return self.log.told()


class Batches(Random):
    """A program that calls the core on a board whose answers are lost, late, doubled, of other sessions or refusals."""

    def told(self, seed: int) -> dict[str, str]:
        waiting: list[tuple[int, int, int, bytes]] = []

        def send(data: bytes) -> None:
            self.log.note("sent", data.hex())
            kind, session, number = data[0], data[1], int.from_bytes(data[2:4], "little")
            if self.below(5) == 0:
                return
            waiting.append((kind, session, number, data[4:]))

        def receive(timeout_s: float) -> bytes | None:
            self.log.note("waits", timeout_s)
            if not waiting or self.below(6) == 0:
                return None
            kind, session, number, body = waiting.pop(self.pick(0, 0, -1))
            if self.below(9) == 0:
                waiting.append((kind, session, number, body))
            session = self.pick(*[session] * 20, session ^ 1)
            answer = self.data(
                {core_port.Message.CALL: 9, core_port.Message.READ: sum(body[2:])}.get(kind, 0)
            )
            if kind == core_port.Message.HELLO:
                about = (
                    self.pick(*[core_port.VERSION] * 9, 2),
                    1,
                    4000,
                    self.pick(0, 0, 3),
                    168,
                    b"a1b2c3d4",
                    b"ffee0011",
                )
                answer = struct.pack("<BBHHH8s8s", *about)
            if self.below(40) == 0:
                kind, answer = (
                    core_port.Message.REFUSED,
                    self.pick(*(bytes((reason,)) for reason in core_port.Refusal), b"\x63", b""),
                )
            return bytes((kind, session)) + number.to_bytes(2, "little") + answer + self.data(0, 0, 1)

        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(core_client, "clock_us", lambda: 1_000_000 + seed)
            packets: Any = Made(send=send, receive=receive, close=partial(self.log.note, "closed"))
            for _ in range(120):
                client = core_client.CoreClient(packets, "board")
                try:
                    self.log.note("about", client.begin())
                    self.log.note("memory", client.memory(self.pick(10, 200)).hex())
                    places = sorted(self.rng.choice(400, 1 + self.below(9), replace=False).tolist())
                    self.log.note("runs", *core_client.runs(places, self.pick(8, 24)))
                    requests = [
                        core_port.read(self.below(99), 1 + self.below(9)),
                        core_port.call(self.pick(*core_port.Call)),
                        core_port.write(8, self.data(4)),
                    ]
                    self.log.note(
                        "answers", *client.execute([self.pick(*requests) for _ in range(1 + self.below(7))])
                    )
                except LinkError as error:
                    self.log.note("refused", error)
                self.log.note("counts", client.sent, client.repeated)
                waiting.clear()
        return self.log.told()


class Streamed(Random):
    """A NatNet server of any version that answers, restarts, sets its clock, changes its bodies, damages packets."""

    def told(self, seed: int) -> dict[str, str]:
        now_us, number, version = 9_000_000, 10, self.pick(*natnet.VERSIONS)
        capture = CaptureConfig(
            body=self.pick("floaty", ""), origin=(0.1, 0.2, 0.3), yaw=0.5, body_offset=(0.01, 0.0, -0.02), body_yaw=-0.3,
            axes=self.pick("z-up", "y-up", None),
        )  # fmt: skip
        stream, ahead_us = NatnetStream(capture.body, Alignment(capture)), 7_000_000
        bodies, pose = {"floaty": 7}, ((0.1, 0.2, 0.3), (0.0, 0.0, 0.0, 1.0))
        hz = natnet_packets.CLOCK_HZ
        for _ in range(2500):
            now_us += self.pick(1_000, 5_000, 5_000, 10_000)
            if self.below(400) == 0:
                now_us += self.pick(600_000, 3_000_000)
                number = self.pick(number, 3)
                ahead_us += self.pick(0, 0, 5_000_000, -4_000_000)
                bodies = self.pick({"floaty": 7}, {"floaty": 7}, {"floaty": 8, "other": 7}, {"other": 7}, {})
            version = stream.version if stream.server and self.below(300) else version
            stream.call(now_us, self.pick(False, False, True))
            for data in stream.outgoing:
                self.log.note("asked", now_us, data.hex())
            asked, stream.outgoing = stream.outgoing, []
            ticks = [
                (now_us + ahead_us - us) * hz // 1_000_000
                for us in (self.pick(*[9_000] * 20, 2_000_000), 6_000, 4_000)
            ]
            if self.below(20) == 0:
                ticks[0] = 0
            number += self.pick(1, 1, 1, 1, 0, 2, -1)
            if self.below(4):
                pose = (
                    tuple(self.rng.integers(-9, 9, 3).tolist()),
                    self.pick((0.0, 0.6, 0.0, 0.8), (0.0, 0.0, 0.0, 1.0)),
                )
            came = natnet_packets.frame(
                number, version, (ticks[0], ticks[1], ticks[2]), self.pick(7, 7, 7, 8), self.below(9) > 0, pose,
                self.pick(0, 0, 0, 0, 0, 0, 2), self.pick(True, False),
            )  # fmt: skip
            if asked and self.below(4):
                spoken = self.pick(version, version, version, (2, 9), (5, 0))
                info, models = (
                    natnet_packets.server_info(spoken, self.below(9) == 0),
                    natnet_packets.model_definition(bodies, version),
                )
                echo = natnet_packets.echo(now_us - self.pick(800, 3_000, 2_000_000), ticks[2])
                response = natnet_packets.packet(
                    3, self.pick(b"\0\0\0\0", b"Bitstream,4.1\0", b"\1\0\0\0", b"no")
                )
                answers = {0: info, 2: response, 4: models, 10: echo, 12: echo}
                wanted = answers[self.pick(*asked)[0]]
                came = self.pick(
                    *[wanted] * 12, info, models, echo, response, natnet_packets.old_server_info((2, 9))
                )
            came = came[: self.pick(*[None] * 60, self.below(len(came)))]
            try:
                self.log.note("frame", now_us, stream.on_packet(came, now_us))
            except MocapError as error:
                self.log.note("refused", error)
            for line in stream.notices:
                self.log.note("notice", now_us, line)
            stream.notices.clear()
            self.log.note("state", stream.counters, stream.version, stream.server, stream.missing())
        return self.log.told()


class Captured(Random):
    """Lines of the process that talks to Vicon and others, in pieces, damaged, late; it ends and is started again."""

    def told(self, seed: int) -> dict[str, str]:
        now, pieces = Made(us=3_000_000), [b""]
        system = self.pick("vicon", "vrpn", "qualisys")

        def readable(files: list[Any], timeout_s: float) -> list[Any]:
            now.us += self.pick(0, 2_000, round(timeout_s * 1e6))
            return files if self.below(3) else []

        def started(command: list[str], **more: object) -> Any:
            self.log.note("started", now.us, *command[2:], sorted(more))
            return Made(
                stdout=Made(fileno=lambda: 9, close=partial(self.log.note, "closed")),
                kill=partial(self.log.note, "killed"),
                wait=lambda: None,
            )

        def read(number: int, most: int) -> bytes:
            pose = [*(0.5 * self.rng.integers(-9, 9, 3)).tolist(), 1.0, 0.0, 0.0, 0.0]
            bodies = self.pick(
                {"floaty": pose}, {"floaty": pose}, {"other": pose}, {"floaty": pose, "other": pose}, {}
            )
            late_us = self.pick(300, 300, 300, -500, 1_200_000)
            line = encode_arrival(Arrival(now.us - late_us, bodies)).encode() * self.pick(1, 1, 2)
            wrong = self.pick(b"[1, {}\n", b"{}\n", b'[1, {"floaty": [1.0]}]\n', b"x" * 70_000)
            pieces[0] += self.pick(*[line] * 60, wrong)
            if self.below(300) == 0:
                pieces[0] = b""
                return b""
            cut = self.pick(len(pieces[0]), self.below(len(pieces[0])) + 1)
            data, pieces[0] = pieces[0][:cut], pieces[0][cut:]
            return data

        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(motioncapture_client, "clock_us", lambda: now.us)
            patch.setattr(motioncapture_client, "readable", readable)
            patch.setattr(motioncapture_client, "os", Made(read=read))
            patch.setattr(motioncapture_client, "subprocess", Made(Popen=started, DEVNULL=-3, PIPE=-1))
            capture = CaptureConfig(
                system=system, body=self.pick("floaty", ""), yaw=0.4, port=self.pick(None, 99)
            )
            settings = motioncapture_client.settings_of(capture)
            source = motioncapture_client.MotioncaptureSource(system, settings, capture)
            for _ in range(3):
                try:
                    source.open()
                except MocapError as error:
                    self.log.note("refused", now.us, error)
                for _ in range(500):
                    now.us += self.pick(0, 1_000, 8_000)
                    self.log.note("frame", now.us, source.receive(self.pick(0.0, 0.02, 0.7)))
                    for line in source.notices():
                        self.log.note("notice", now.us, line)
                    self.log.note("summary", source.summary())
                source.close()
        return self.log.told()


class Kept(LiveLink):
    """A link that notes what its device is asked for."""

    def __init__(self, own: Random) -> None:
        super().__init__("test:0", LinkLatency("radio", 2_000, measured=False))
        self.own = own

    def _noted(self, what: str, *of: object) -> None:
        self.own.log.note(what, live_link.clock_us(), *of)

    def _open(self) -> None:
        self._noted("open")
        if self.own.below(6) == 0:
            raise LinkError("test:0: no such device")

    def _connect(self) -> bool:
        self._noted("connect")
        return self.own.below(9) == 0

    def _why_no_connection(self, now_us: int, within: str) -> str:
        return self.own.pick("", "", "", "", "", f"nothing {within}")

    def _send(self, now_us: int, frame: MocapFrame, goal: Goal) -> None:
        self._noted("sent", now_us, frame.t_us, goal)

    def _failure(self) -> str:
        return self.own.pick(*[""] * 60, "unplugged")

    def _close(self) -> None:
        self._noted("close")

    def start_telemetry(self, now_us: int) -> None:
        self._noted("asks")

    def receive(self, now_us: int, data: bytes) -> list[Sample]:
        return []

    def ask(self, now_us: int, request: ControlRequest) -> None:
        self._noted("ask", request)

    def answer(self, now_us: int) -> None:
        return None

    def summary(self) -> str:
        return ""


class Mailbox(Random):
    """Poses for a link whose sender does its jobs later, in any number of turns."""

    def told(self, seed: int) -> dict[str, str]:
        now, jobs = Made(us=9_000_000), []

        def clock_us() -> int:
            now.us += self.pick(0, 0, 100, 300_000 if self.below(40) == 0 else 0)
            return int(now.us)

        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(live_link, "clock_us", clock_us)
            patch.setattr(
                live_link,
                "Sender",
                lambda: Made(
                    put=jobs.append, close=lambda lost: self.log.note(f"sender closed{', lost' * lost}")
                ),
            )
            link = Kept(self)
            for turn in range(1500):
                now.us += self.pick(1_000, 10_000, 20_000)
                act = self.pick(
                    "send", "send", "send", "send", "job", "job", "job", "read", "look", "notices", "rare"
                )
                if act == "send":
                    goal = Goal((0.1 * self.below(3), 0.0, 1.0), 0.0)
                    old_us = self.pick(*[9_000] * 6, 117_999, 118_000, 118_001, 119_000, 400_000)
                    link.send(
                        now.us,
                        MocapFrame(now.us - old_us, (0.0, 0.0, turn), (1.0, 0.0, 0.0, 0.0), True),
                        goal,
                    )
                elif act == "job" and jobs:
                    jobs.pop(0)()
                elif act == "read":
                    link.received_us = now.us
                    for _ in range(self.pick(1, 2, 2100 if self.below(20) == 0 else 3)):
                        link._on_bytes(bytes((turn % 256,)))
                elif act == "look":
                    self.log.note("received", *link.received())
                    try:
                        link.check()
                    except LinkError as error:
                        self.log.note("lost", now.us, error)
                elif act == "notices":
                    self.log.note("notices", now.us, *link.notices())
                elif act == "rare" and self.below(4) == 0:
                    link.supervisor_state = 3
                    try:
                        self.pick(
                            link.mute, link.close, *[lambda: link.open(lambda: self.below(90) == 0)] * 4
                        )()
                    except LinkError as error:
                        self.log.note("refused", now.us, error)
                self.log.note(
                    "state", link.sent, link.late, link.supervisor_state, link.received_us, len(jobs)
                )
        return self.log.told()


class Serial(Random):
    """A serial port that is opened, fails, and brings a board's frames, another's, or only noise."""

    def told(self, seed: int) -> dict[str, str]:
        now = Made(us=4_000_000)
        key = KEY * (seed == 2)
        signing = Signing(key, start=500) if key else None
        ends = ((1, 1, signing), (9, 1, None), (3, 191, signing), (4, 25, signing), (5, 25, signing))
        boards = [FrameSender(*end) for end in ends]

        def clock_us() -> int:
            now.us += self.pick(0, 1_000, 60_000)
            return int(now.us)

        closed = partial(self.log.note, "closed")
        failures = (
            OSError(errno.ENOENT, "x"), ValueError("invalid URL"), OSError("could not open port: [Errno 13] denied: 'x'"),
            OSError("Could not configure port: (25, 'Inappropriate ioctl')"), OSError("(5, 'Input error')"),
        )  # fmt: skip

        def opened(device: str, baud: int, receive: Callable[[bytes], None]) -> Any:
            self.log.note("opened", now.us, device, baud)
            if self.below(5) == 0:
                raise self.pick(*failures)
            written = partial(self.log.note, "written")
            return Made(
                failure="",
                bytes=0,
                receive=receive,
                write=lambda data: written(now.us, data.hex()),
                close=closed,
            )

        with pytest.MonkeyPatch.context() as patch:
            for place in (mavlink_serial, live_link):
                patch.setattr(place, "clock_us", clock_us)
            patch.setattr(mavlink_serial, "signing_start", lambda: 77)
            patch.setattr(mavlink_serial, "POLL_S", 0.0)
            patch.setattr(mavlink_serial, "_Port", opened)
            patch.setattr(live_link, "Sender", lambda: Made(put=lambda job: job(), close=lambda lost: None))
            for uri in (
                "mavlink:/dev/ttyUSB0",
                "mavlink:COM3,57600",
                "mavlink:socket://h:99",
                "mavlink:x,99",
                "mavlink:",
                "udp:x",
            ):
                try:
                    mavlink_serial.MavlinkSerialLink(uri, LinkSettings(50.0, 2_000, 115_200, key))
                except LinkError as error:
                    self.log.note("refused", error)
            link = mavlink_serial.MavlinkSerialLink(
                "mavlink:/dev/ttyUSB0", LinkSettings(50.0, 2_000, 115_200, key)
            )
            talks = 5

            def heard() -> None:
                port: Any = link._port
                if port is None:
                    return
                port.failure = port.failure or self.pick(*[""] * 200, "No such device")
                whole = self.pick(
                    services.heartbeat(False, self.pick(*State)), services.command_ack(511, 0, 255, 190),
                    services.command_ack(511, 3, 255, 190), mavlink.flight_array(now.us, [0.5] * 58),
                    services.timesync_answer(now.us * 1000, services.timesync(0, link._link._time_request_ns)),
                    *services.status_text(4, "low battery", 1),
                )  # fmt: skip
                data = boards[self.below(talks)].encode(now.us, whole) if talks else self.data(0, 9)
                port.bytes += len(data)
                port.receive(data)

            for turn in range(700):
                now.us += self.pick(1_000, 20_000)
                if turn % 60 == 0:
                    talks = self.pick(0, 1, 2, 5, 5)
                    link.close()
                    try:
                        link.open(lambda: heard() or self.below(400) == 0)
                    except LinkError as error:
                        self.log.note("refused", now.us, error)
                if self.below(3):
                    heard()
                for at_us, data in link.received():
                    self.log.note("samples", at_us, len(link.receive(at_us, data)))
                if self.below(3) == 0:
                    link.send(
                        now.us, MocapFrame(now.us - 9_000, (0.0, 0.1, 1.0), (1.0, 0.0, 0.0, 0.0), True), HOME
                    )
                try:
                    link.check()
                except LinkError as error:
                    self.log.note("lost", now.us, error)
                if self.below(30) == 0:
                    self.pick(link.mute, lambda: link.ask(now.us, ControlRequest(ControlAction.ARM)))()
                self.log.note(
                    "state", link.supervisor_state, link.latency, link.received_us, link.answer(now.us)
                )
                self.log.note("notices", *link.notices(), link.summary())
        return self.log.told()


def courses(seed: int) -> dict[str, str]:
    """Return what goals users' paths give."""
    own = Random(seed)
    paths: dict[str, Any] = {
        "three": lambda t: (t, 2 * t, 3 * t), "four": lambda t: [t, 0, 1, 0.5], "two": lambda t: (t, t),
        "text": lambda t: "abc", "nan": lambda t: (t, math.nan, 0), "words": lambda t: ("a", 1, 2),
    }  # fmt: skip
    for name, path in paths.items():
        for t_us in (0, 999_999, 1_000_000, 1_000_001, 2_500_000):
            try:
                own.log.note(name, Course(HOME, 1_000_000, path).at(t_us))
            except ValueError as error:
                own.log.note(name, error)
    for signal in (Sine(0.5, 0.3), Square(1.0, -2.0, 0.5), Step(0.7)):
        own.log.note(
            "signals", *(signal(t_us) for t_us in (0, 999_999, 1_000_000, 1_999_999, 2_000_000, 3_100_000))
        )
    return own.log.told()


KINDS = (Followed, Asked, Stock, Logged, Typed, Live, Replayed, Batches, Streamed, Captured, Mailbox, Serial)
FOUND: dict[str, Callable[[], dict[str, str]]] = {
    **by_seed(KINDS, SEEDS, lambda kind, seed: kind(seed).told(seed)),
    "courses": lambda: courses(0),
}


# They reach no line that the others do not.
LONG = ["Captured 3", *(f"{kind} 2" for kind in ("Live", "Streamed", "Followed", "Mailbox"))]


@pytest.mark.parametrize("name", tiers(FOUND, LONG))
def test_a_station_answers_as_it_did(name: str) -> None:
    judge(ANSWERS, name, FOUND[name](), "numpy", "pymavlink")


if __name__ == "__main__":
    approve(ANSWERS, FOUND, "numpy", "pymavlink")
