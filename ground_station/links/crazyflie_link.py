"""The link to a Crazyflie with its own firmware, inside one process: poses, a whole flight, and its log.

The flight: parameters are written, the estimator restarts on poses, the robot is armed, takes off with the high-level
commander, follows the goal, lands and stops. A goal that stays at home needs no packets; a moving one is sent as a
position set-point with every pose, as cflib's position commander does. Facts: crazyflie-firmware 2a18fc29, cflib 0.1.34.
"""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from math import dist

from firmware_py.wire.crtp import PORT_LOG, decode, encode_ext_pose
from firmware_py.wire.high_level import PathCommand, encode
from firmware_py.wire.setpoints import encode_end, encode_place
from firmware_py.wire.telemetry import CRAZYFLIE_BLOCKS, Sample
from ground_station.config import PilotConfig
from ground_station.controls import ControlAction, ControlRequest
from ground_station.latency import LinkLatency
from ground_station.links.crtp_controls import PORTS, CrtpControls, TocEntry
from ground_station.links.log_blocks import LogBlocks
from ground_station.mocap import MocapFrame
from ground_station.trajectory import Goal, Trajectory

ARM_US = 500_000  # before the take-off
STOP_US = 1_000_000  # after the landing, which a robot may finish late
END_US = 300_000  # of the flight, after that
AWAY = 1e-3  # [m] a goal at this distance from home is sent
NO_GROUPS = 0  # all robots are addressed
ESTIMATOR = "kalman.resetEstimation"


def smooth(share: float) -> float:
    """Return the share of the distance after a share of the time, from rest to rest, by the firmware's polynomial."""
    s = min(max(share, 0.0), 1.0)
    return s * s * s * s * (35.0 - s * (84.0 - s * (70.0 - s * 20.0)))


@dataclass(frozen=True, slots=True)
class FlightTimes:
    """Instants of a flight [us]: take-off, start of the trajectory, landing, and its end."""

    take_off_us: int
    begin_us: int
    land_us: int
    landed_us: int

    @staticmethod
    def of(config: PilotConfig, take_off_us: int, duration_us: int) -> "FlightTimes":
        """Return the instants of a flight with this take-off and duration."""
        begin_us = take_off_us + round((config.take_off_s + config.settle_s) * 1e6)
        landed_us = take_off_us + duration_us - STOP_US - END_US
        return FlightTimes(take_off_us, begin_us, landed_us - round(config.land_s * 1e6), landed_us)


@dataclass(frozen=True, slots=True)
class FromFloor:
    """Take-off, a trajectory and landing as goals, as the board computes them."""

    flown: Trajectory
    floor: float  # z of the robot on the floor [m], W
    home: Goal
    config: PilotConfig
    times: FlightTimes

    def at(self, t_us: int) -> Goal:
        times = self.times
        if t_us < times.begin_us:
            share = (t_us - times.take_off_us) * 1e-6 / self.config.take_off_s
            return self._above(self.home, smooth(share))
        if t_us < times.land_us:
            return self.flown.at(t_us)
        return self._above(
            self.flown.at(times.land_us), 1.0 - smooth((t_us - times.land_us) * 1e-6 / self.config.land_s)
        )

    def _above(self, goal: Goal, share: float) -> Goal:
        x, y, z = goal.p_WG
        return Goal((x, y, self.floor + share * (z - self.floor)), goal.yaw)


class CrazyflieLink:
    """`transmit` takes the instant and a packet; `log_table` and `parameters` are the board's tables of contents."""

    def __init__(
        self,
        transmit: Callable[[int, bytes], object],
        latency_us: int,
        log_table: Callable[[], Mapping[str, int]],
        parameters: Mapping[str, TocEntry],
        config: PilotConfig,
        home: Goal,
        times: FlightTimes,
    ) -> None:
        self.latency = LinkLatency("radio", latency_us, measured=False)
        self.notices: list[str] = []  # lines for the user
        self._transmit = transmit
        self._logs = LogBlocks(transmit, log_table, CRAZYFLIE_BLOCKS)
        self._now_us = 0
        self._controls = CrtpControls(lambda data: transmit(self._now_us, data), lambda: parameters)
        self._config, self._home, self._times = config, home, times
        self._steps: Iterator[int] = self._fly()
        self._next_us = next(self._steps)
        self._asked = False
        self._goal = home
        self._streams = False

    def start_telemetry(self, now_us: int) -> None:
        self._logs.request(now_us)

    def send(self, now_us: int, frame: MocapFrame, goal: Goal) -> None:
        """Send the unchanged pose, and the packets of the flight that are due."""
        self._now_us, self._goal = now_us, goal
        if self._config.poses:
            self._transmit(now_us, encode_ext_pose(frame.p_WB, frame.q_WB, None))
        self._logs.repeat(now_us)
        self._take_answer(now_us)
        while not self._asked and now_us >= self._next_us:
            self._next_us = next(self._steps)

    def receive(self, now_us: int, data: bytes) -> Sequence[Sample]:
        """Return the telemetry in a packet from the board, empty for a packet of another service."""
        packet = decode(data)
        if packet.port in PORTS:
            self._controls.receive(now_us, packet)
        return self._logs.receive(now_us, packet) if packet.port == PORT_LOG else ()

    def _fly(self) -> Iterator[int]:
        """Do what is due, and yield the next due instant [us]; the board's answers are awaited in between."""
        times, config = self._times, self._config
        yield 0
        for name, value in config.values.items():
            self._ask(ControlRequest(ControlAction.WRITE, name, value))
            yield 0
        for value in (1.0, 0.0):
            self._ask(ControlRequest(ControlAction.WRITE, ESTIMATOR, value))
            yield 0
        yield times.take_off_us - ARM_US
        self._ask(ControlRequest(ControlAction.ARM))
        yield times.take_off_us
        height, yaw = self._home.p_WG[2], self._home.yaw
        self._command(PathCommand.TAKE_OFF, NO_GROUPS, height, yaw, False, config.take_off_s)
        yield times.begin_us
        while self._now_us < times.land_us:
            self._follow()
            yield self._now_us + 1
        if self._streams:  # the high-level commander takes over again
            self._transmit(self._now_us, encode_end())
        self._command(PathCommand.LAND, NO_GROUPS, 0.0, self._goal.yaw, False, config.land_s)
        yield times.landed_us + STOP_US
        self._command(PathCommand.STOP, NO_GROUPS)
        yield 1 << 62

    def _follow(self) -> None:
        """Send the goal, once it is away from home."""
        goal, home = self._goal, self._home
        self._streams = self._streams or dist(goal.p_WG, home.p_WG) > AWAY or goal.yaw != home.yaw
        if self._streams:
            self._transmit(self._now_us, encode_place(goal.p_WG, goal.yaw))

    def _command(self, command: PathCommand, *fields: float) -> None:
        self._transmit(self._now_us, encode(command, *fields))

    def _ask(self, request: ControlRequest) -> None:
        self._asked = True
        self._controls.ask(self._now_us, request)

    def _take_answer(self, now_us: int) -> None:
        answer = self._controls.answer(now_us) if self._asked else None
        if answer is not None:
            self._asked = False
            self.notices.append(
                answer.error or ", ".join(f"{name} {value:g}" for name, value in answer.values) or "armed"
            )
