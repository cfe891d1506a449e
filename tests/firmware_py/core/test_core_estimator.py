"""The core's Kalman filter against filterpy on a recorded flight, and laws that it keeps whatever it is fed.

The reference is written from the paper's constants and the filter's definition: the model as a matrix, filterpy's filter in
float64, joint instead of scalar updates, the poses sorted by the instant at which they were true.
"""

import math
from collections.abc import Iterator
from dataclasses import dataclass, field

import numpy as np
import pytest
from filterpy.kalman import KalmanFilter
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.linalg import block_diag, expm
from scipy.spatial.transform import Rotation

from firmware_py.core import entry, estimator
from firmware_py.core.structs import POSE_INVALID, POSE_ON_TIME, Estimator, Parameters
from firmware_py.core_runner import CoreBlocks, NativeRunner
from ground_station.trajectory import Goal, Offsets, Sine, Square, Trajectory
from hil.board.board_firmware import PythonBoard
from hil.laboratory.experiments import Experiment
from hil.laboratory.lockstep import lockstep_flight
from hil.laboratory.request import Request
from support.core_bench import LEVEL, Core, Vector, counts, quaternion, turned
from support.paper_model import model

TICK_US = 10_000
BLOCKS = {"position": slice(0, 3), "velocity": slice(3, 6), "attitude": slice(6, 9), "rate": slice(9, 12),
          "flap": slice(12, 16)}  # fmt: skip


# The reference

Q = np.diag(np.repeat([1e-8, 4e-4, 2e-5, 4e-2, 1e-5], [3, 3, 3, 3, 4]))
R_GYRO = np.eye(3) * 4e-4
R_POSE = np.diag([1e-6] * 3 + [4e-5] * 3)
H_GYRO = np.eye(16)[9:12]
H_POSE = np.eye(16)[[0, 1, 2, 6, 7, 8]]


def series() -> tuple[Vector, Vector]:
    """Return state and input matrix of one tick, by the series to third order."""
    (A, B), dt = model(), 0.01
    integral = dt * (np.eye(16) + A * dt / 2 + A @ A * dt**2 / 6)
    return np.eye(16) + A @ integral, integral @ B


def exact() -> tuple[Vector, Vector]:
    """Return the same by scipy's matrix exponential."""
    A, B = model()
    both = expm(0.01 * np.block([[A, B], [np.zeros((4, 20))]]))
    return both[:16, :16], both[:16, 16:]


@dataclass
class Reference:
    """filterpy's filter from the core's state just after its first pose, or a jump."""

    x: Vector
    P: Vector
    level: tuple[Vector, Vector]  # state and input matrix of one tick at yaw 0
    kf: KalmanFilter = field(init=False)

    def __post_init__(self) -> None:
        self.kf = KalmanFilter(dim_x=16, dim_z=6, dim_u=4)
        self.kf.x, self.kf.P = self.x.copy(), self.P.copy()

    def matrices(self, yaw: float) -> tuple[Vector, Vector]:
        """Turn the horizontal positions and velocities of the model into G."""
        R_GH = Rotation.from_euler("z", yaw).as_matrix()
        T = block_diag(R_GH, R_GH, np.eye(10))
        F, B = self.level
        return T @ F @ T.T, T @ B

    def step(self, command: Vector, rates: Vector, pose: tuple[Vector, float] | None) -> None:
        """Advance by one tick, fuse the rates, and a pose (position and attitude, true `lag` seconds before)."""
        kf = self.kf
        F, B = self.matrices(kf.x[8])
        kf.predict(command, B=B, F=F, Q=Q)
        kf.x[8] = turned(kf.x[8])
        kf.update(rates, R=R_GYRO, H=H_GYRO)
        if pose is not None:
            z, lag = pose
            z = z + lag * kf.x[[3, 4, 5, 9, 10, 11]]
            z[3:] = kf.x[6:9] + turned(z[3:] - kf.x[6:9])
            kf.update(z, R=R_POSE, H=H_POSE)

    def ahead(self, commands: list[Vector], rates: list[Vector]) -> Vector:
        """Return the state after some more ticks, with the rates that the gyro then measured."""
        x = self.kf.x.copy()
        for command, rate in zip(commands, rates, strict=True):
            F, B = self.matrices(x[8])
            x = F @ x + B @ command
            x[9:12], x[8] = rate, turned(x[8])
        return x


# A recorded flight


@dataclass
class Record:
    """What one tick was fed: poses filed before it, then gyro and command."""

    poses: list[tuple[Vector, Vector, int]]
    gyro_sum: list[int]
    samples: int
    bias: Vector
    command: Vector

    @property
    def rates(self) -> Vector:
        """The mean body rates [rad/s]."""
        mean = np.array(self.gyro_sum) / self.samples - self.bias
        rates: Vector = Rotation.from_euler("z", -45, degrees=True).apply(mean * math.radians(2000) / 32768)
        return rates


def tour(home: Goal, release_us: int) -> Trajectory:
    """Return steps of yaw, and x, y, z along, so that every rotation in the filter matters."""
    return Offsets(
        home,
        release_us,
        x=Sine(0.05, 0.3),
        y=Square(0.05, 0.0, 0.2),
        z=Sine(0.1, 0.2),
        yaw=Square(2.2, -0.9, 0.23),
    )


@pytest.fixture(scope="module")
def flight() -> list[Record]:
    """Ten seconds of a flight with pushes, as the tasks on board fed the core."""
    records: list[Record] = []
    poses: list[tuple[Vector, Vector, int]] = []

    class Listening(NativeRunner):
        def __init__(self, blocks: CoreBlocks) -> None:
            super().__init__(blocks)
            self.data, self.control = blocks.data.memory[0], blocks.control.memory[0]

        def call(self, name: str) -> int:
            data = self.data
            if name == "estimate":
                command = self.control["command"].astype(float)
                records.append(
                    Record(poses.copy(), data["gyro_sum"].tolist(), int(data["gyro_samples"]),
                           data["gyro_bias"].astype(float), command)
                )  # fmt: skip
                poses.clear()
            answer = super().call(name)
            if name == "file_pose":
                poses.append((data["pose_position"].astype(float), data["pose_quaternion"].astype(float),
                              int(data["pose_age_us"])))  # fmt: skip
            return answer

    request = Request.of(Experiment("tour", "", 10.0, {}, tour), seed=3)
    flight = lockstep_flight(request, executor=PythonBoard(Listening))
    for at_us, force, torque in (
        (3_000_000, (0.3, 0.0, 0.0), (0.0, 0.0, 0.003)),
        (5_000_000, (0.0, -0.5, 0.3), (0.002, 0.0, 0.0)),
        (7_500_000, (0.0, 0.0, -0.5), (0.0, 0.001, -0.003)),
    ):
        flight.events.at(at_us, lambda _, f=force, t=torque: flight.robot.body.push(f, t))
        flight.events.at(at_us + 100_000, lambda _: flight.robot.body.push((0.0, 0.0, 0.0)))
    assert flight.run().lost is None
    return records


def replay(records: list[Record]) -> Iterator[tuple[int, Core]]:
    """Feed the records to a core again; yields tick and core after each."""
    core = Core()
    for tick, record in enumerate(records, start=1):
        core.data.fields.gyro_bias[:] = record.bias
        for p, q, age_us in record.poses:
            core.pose(p, q, age_us)
        core.tick(record.gyro_sum, record.samples, record.command)
        yield tick, core


def compare(records: list[Record], level: tuple[Vector, Vector]) -> dict[str, float]:
    """Return the largest differences of core and reference over the flight, by block, of x, now and P."""
    poses: dict[int, tuple[Vector, float]] = {}
    for tick, record in enumerate(records, start=1):
        for p, q, age_us in record.poses:
            back = math.floor(age_us / TICK_US + 0.5)
            yaw, pitch, roll = Rotation.from_quat(q, scalar_first=True).as_euler("ZYX")
            poses[tick - back] = (np.array([*p, roll, pitch, yaw]), (age_us - back * TICK_US) * 1e-6)
    worst = dict.fromkeys([*BLOCKS, *("now " + name for name in BLOCKS), "P"], 0.0)
    reference: Reference | None = None
    done = jumps = refused = 0
    for tick, core in replay(records):
        if core.fields.started and (reference is None or core.fields.jumps > jumps):
            reference = Reference(core.x, core.P, level)
            done, jumps = int(core.fields.filtered_tick), int(core.fields.jumps)
        if reference is None:
            continue
        while done < core.fields.filtered_tick:
            done += 1
            pose = poses.get(done) if core.fields.refused == refused else None
            reference.step(records[done - 1].command, records[done - 1].rates, pose)
        refused = int(core.fields.refused)
        ahead = reference.ahead(
            [record.command for record in records[done:tick]], [record.rates for record in records[done:tick]]
        )
        for prefix, got, expected in (("", core.x, reference.kf.x), ("now ", core.now, ahead)):
            e = got - expected
            e[8] = turned(e[8])
            for name, block in BLOCKS.items():
                worst[prefix + name] = max(worst[prefix + name], float(np.abs(e[block]).max()))
        P = reference.kf.P
        sigma = np.sqrt(np.diag(P))
        worst["P"] = max(worst["P"], float(np.abs((core.P - P) / np.outer(sigma, sigma)).max()))
    assert core.counters["fused"] > 450
    assert core.counters["refused"] == core.counters["jumps"] == 5  # the steps of yaw
    assert set(core.counters) == {"fused", "refused", "jumps"}
    return worst


TIGHT = {"position": 5e-7, "velocity": 1e-5, "attitude": 3e-6, "rate": 1e-5, "flap": 3e-6}  # float32
LOOSE = {"position": 5e-5, "velocity": 1.5e-3, "attitude": 1e-3, "rate": 2e-4, "flap": 3e-4}  # and the series


@pytest.mark.long
@pytest.mark.parametrize(
    ("level", "limits", "covariance"),
    [
        pytest.param(series(), TIGHT, 3e-4, id="series"),
        pytest.param(exact(), LOOSE, 6e-3, id="expm"),
    ],
)
def test_state_prediction_and_covariance_are_filterpys_in_every_tick_of_a_flight(
    flight: list[Record], level: tuple[Vector, Vector], limits: dict[str, float], covariance: float
) -> None:
    worst = compare(flight, level)
    for name, limit in limits.items():
        assert worst[name] < limit, name
        assert worst["now " + name] < limit, name
    assert worst["P"] < covariance  # in units of the two standard deviations


@pytest.mark.long
def test_recorded_flight_exercises_the_filter(flight: list[Record]) -> None:
    x = np.array([core.x for _, core in replay(flight)])
    span = x.max(axis=0) - x.min(axis=0)
    assert span[8] > 4.0
    assert all(span[[0, 1, 2]] > 0.05)
    assert all(span[[3, 4, 5]] > 0.4)
    assert all(span[[6, 7]] > 0.1)
    assert all(span[[9, 10, 11]] > 1.0)
    assert all(span[12:16] > 0.4)


# Laws for whatever comes in

REFERENCE_BOUNDS = np.repeat([1.5, 2.5, 1.2, math.pi, 35.0, 1.6], [3, 3, 2, 1, 3, 4])  # position .. flaps
any_number = st.floats(width=32)
any_pose = st.tuples(
    st.tuples(*3 * (any_number,)), st.tuples(*4 * (any_number,)), st.integers(-(2**31), 2**31 - 1)
)
likely_pose = st.tuples(
    st.tuples(*3 * (st.floats(-2, 2, width=32),)),
    st.tuples(*3 * (st.floats(-4, 4),)).map(lambda rpy: quaternion(*rpy)),
    st.sampled_from([-1, 0, 4_999, 5_000, 20_000, 40_000, 40_000, 41_000, 44_999, 45_000, 120_000, 125_000]),
)
gyro = st.one_of(st.just((0, 0, 0)), st.tuples(*3 * (st.integers(-327_680, 327_670),)))
any_tick = st.tuples(
    st.lists(st.one_of(likely_pose, any_pose), max_size=3),
    st.one_of(gyro, st.tuples(*3 * (st.integers(-(2**31), 2**31 - 1),))),
    st.sampled_from([10, 10, 10, 0, 1, 11, -3]),
    st.tuples(*4 * (st.floats(-1.5, 1.5, width=32),)),
)


def assert_sane(core: Core) -> None:
    x, now, P = core.x, core.now, core.P
    assert np.isfinite(now).all()
    assert (np.abs(x) <= REFERENCE_BOUNDS * (1 + 1e-6)).all()
    assert (P == P.T).all()
    variances = np.diag(P)
    assert variances.min() >= 0.99e-9
    assert variances.max() <= 100.0
    assert np.abs(P / np.sqrt(np.outer(variances, variances))).max() <= 1 + 1e-5


@settings(deadline=None, max_examples=150)
@given(st.lists(any_tick, min_size=1, max_size=40), st.booleans(), st.booleans())
@pytest.mark.long
def test_state_and_covariance_stay_sane_whatever_comes_in(ticks, predict, measured) -> None:
    core = Core(predict=predict, age_measured=measured)
    for poses, gyro_sum, samples, command in ticks:
        for p, q, age_us in poses:
            core.pose(p, q, age_us)
        core.tick(gyro_sum, samples, command)
        assert_sane(core)
        core.fly()
        opening = core.control.fields.flap * [1, -1, 1, -1]
        assert opening.min() >= 0.0
        assert opening.max() <= np.float32(0.9)
        assert 21_000 <= core.control.fields.count.min() <= core.control.fields.count.max() <= 42_000
    assert core.fields.resets == 0  # nothing that comes from outside breaks the state


BAD = (math.nan, math.inf, -math.inf)


@pytest.mark.long
@pytest.mark.parametrize(
    ("p", "q"),
    [
        *(((bad, 0, 0), LEVEL) for bad in BAD),
        *(((0, 0, bad), LEVEL) for bad in (*BAD, 101.0)),
        *((LEVEL[:3], (1.0, bad, 0, 0)) for bad in BAD),
        ((0, 0, 0), (0, 0, 0, 0)),
        ((0, 0, 0), (1.2, 0, 0, 0)),
        ((0, 0, 0), (0.5, 0.5, 0.5, 0.0)),
    ],
)
def test_invalid_pose_changes_nothing_but_its_counter(p: tuple[float, ...], q: tuple[float, ...]) -> None:
    one, other = settled(), settled()
    assert one.pose(p, q) == POSE_INVALID
    assert one.fields.invalid == 1
    one.fields.invalid = 0
    assert one.estimator.bytes() == other.estimator.bytes()


# Gate

PERIOD = 2  # ticks between poses


def feed(core: Core, ticks: int, p: object = (0, 0, 0), q: object = LEVEL) -> Core:
    """Feed 50 Hz of one pose, 40 ms old."""
    for tick in range(ticks):
        if tick % PERIOD == 0:
            core.pose(p, q)
        core.tick()
    return core


def settled(p: object = (0, 0, 0), q: object = LEVEL) -> Core:
    return feed(Core(), 200, p, q)


OUTLIERS = [((0.5, 0, 0), LEVEL), ((0, 0, -0.5), LEVEL), ((0, 0, 0), quaternion(yaw=math.pi)),
            ((0, 0, 0), quaternion(roll=math.pi)), ((0.1, 0.1, 0.1), quaternion(pitch=0.6))]  # fmt: skip


@pytest.mark.parametrize(("p", "q"), OUTLIERS)
def test_single_outlier_is_as_good_as_no_pose(p: tuple[float, ...], q: object) -> None:
    hit, spared = settled(), settled()
    hit.pose(p, q)
    for _ in range(40):
        for core in (hit, spared):
            core.tick()
            core.tick()
            core.pose((0.01, 0.02, 0.03))
        assert (hit.x == spared.x).all()
        assert (hit.now == spared.now).all()
        assert (hit.P == spared.P).all()
    assert hit.counters == spared.counters | {"refused": 1}


@pytest.mark.parametrize(("p", "q"), [*OUTLIERS[:3], OUTLIERS[4]])
def test_two_outliers_that_agree_are_a_jump_of_the_goal(p: tuple[float, ...], q: object) -> None:
    core = settled()
    for tick in range(8):
        if not core.fields.jumps:
            if tick % PERIOD == 0:
                core.pose(p, q)
            core.tick()
    assert core.counters["jumps"] == 1
    assert core.counters["refused"] == 1
    got = Rotation.from_euler("ZYX", core.x[[8, 7, 6]])
    assert core.x[:3] == pytest.approx(p, abs=1e-6)
    assert (got.inv() * Rotation.from_quat(q, scalar_first=True)).magnitude() < 1e-5
    expected = np.zeros((6, 16))
    expected[range(6), [0, 1, 2, 6, 7, 8]] = 4 * np.diag(R_POSE)  # and tied to nothing else
    assert np.allclose(core.P[[0, 1, 2, 6, 7, 8]], expected, rtol=1e-6, atol=0)
    feed(core, 2, p, q)
    assert core.counters["refused"] == 1


@pytest.mark.parametrize("axis", range(6))
def test_outliers_that_contradict_each_other_in_one_axis_alone_are_never_accepted(axis: int) -> None:
    core = settled()
    for k in range(10):
        off = np.array([0.5, 0.5, 0.5, 0.8, 0.8, 0.8])
        off[axis] *= (-1) ** k
        core.pose(off[:3], quaternion(*off[3:]))
        core.tick()
        core.tick()
    assert core.counters["refused"] == 10
    assert np.abs(core.now).max() < 1e-6
    feed(core, 2)
    assert "jumps" not in core.counters


@pytest.mark.parametrize("between", ["a good pose", "a jump to it"])
def test_an_outlier_is_refused_each_time_whatever_was_suspected_before(between: str) -> None:
    """A pose is suspected once: neither a good one nor a jump leaves a suspicion that the next outlier confirms."""
    core = settled()
    off = (0.5, -0.5, 0.5)
    core.pose(off)
    core.tick()
    assert core.counters["refused"] == 1
    core.pose((0, 0, 0) if between == "a good pose" else off)
    core.tick()
    jumps = core.counters.get("jumps", 0)
    assert jumps == (between == "a jump to it")
    core.fields.x[:3] = 0.0  # where it would be refused again
    core.pose(off)
    core.tick()
    assert core.counters == core.counters | {"refused": 2}
    assert core.counters.get("jumps", 0) == jumps


@pytest.mark.parametrize("ticks", range(1, 8))
def test_a_suspect_pose_is_confirmed_by_one_that_comes_1_to_4_ticks_later_and_no_later(ticks: int) -> None:
    core = settled()
    for _ in range(2):
        core.pose((0.5, 0, 0))
        for _ in range(ticks):
            core.tick()
    for _ in range(8):
        core.tick()
    assert core.counters["refused"] == (1 if ticks <= 4 else 2)
    assert core.counters.get("jumps", 0) == (1 if ticks <= 4 else 0)


def test_gate_opens_with_the_uncertainty_of_a_silence() -> None:
    refused = settled()
    refused.pose((0.15, 0, 0))
    accepted = settled()
    for _ in range(60):
        accepted.tick()
    accepted.pose((0.15, 0, 0))
    for core in (refused, accepted):
        for _ in range(5):
            core.tick()
    assert refused.counters.get("refused") == 1
    assert accepted.counters.get("refused") is None
    assert accepted.x[0] == pytest.approx(0.15, abs=0.02)


@pytest.mark.parametrize("degrees", [35, 110, 179, -110])
def test_jump_of_the_goals_yaw_turns_position_and_velocity(degrees: float) -> None:
    turn = Rotation.from_euler("z", -degrees, degrees=True)
    core, v = Core(), np.array([0.4, 0.2, 0.0])
    after: list[Vector] = []
    for tick in range(240):
        p = v * (tick + 1 - 4) * 0.01
        if tick < 200:
            q = LEVEL
            before = core.now[3:6]
        else:
            p, q = turn.apply(p), turn.as_quat(scalar_first=True)
        if tick % 2 == 0:
            core.pose(p, q)
        core.tick()
        if core.fields.jumps and len(after) < 1:
            after = [core.now[3:6], core.now[0:3], turn.apply(v * (tick + 1) * 0.01)]
    assert core.counters["jumps"] == 1
    assert abs(turned(core.now[8] + math.radians(degrees))) < 1e-3
    assert np.linalg.norm(after[0] - turn.apply(before)) < 0.12  # drag of four ticks in another direction
    assert np.linalg.norm(after[1] - after[2]) < 0.01


# Attitude of a pose


def test_sign_of_a_quaternion_means_nothing(flight: list[Record]) -> None:
    flipped = [
        Record(
            [(p, (-1) ** n * q, age) for n, (p, q, age) in enumerate(record.poses, start=tick)], *rest(record)
        )
        for tick, record in enumerate(flight[:400])
    ]
    for (_, one), (_, other) in zip(replay(flight[:400]), replay(flipped), strict=True):
        assert one.estimator.bytes() == other.estimator.bytes()


def rest(record: Record) -> tuple[list[int], int, Vector, Vector]:
    return record.gyro_sum, record.samples, record.bias, record.command


@pytest.mark.long
@settings(deadline=None, max_examples=60)
@given(st.floats(-1, 1), st.floats(-1, 1), st.floats(-math.pi, math.pi), st.floats(0.92, 1.08))
def test_first_pose_is_adopted_at_any_attitude(roll: float, pitch: float, yaw: float, length: float) -> None:
    core = Core()
    for _ in range(10):
        core.tick()
    assert core.pose((0.3, -0.2, 0.1), length * quaternion(roll, pitch, yaw), 44_999) == POSE_ON_TIME
    core.tick()
    expected = np.array([0.3, -0.2, 0.1, roll, pitch, yaw])
    e = core.x[[0, 1, 2, 6, 7, 8]] - expected
    e[5] = turned(e[5])
    assert np.abs(e).max() < 1e-6
    assert core.counters == {"fused": 1}


@pytest.mark.parametrize("omega", [(1, 0, 0), (0, 2, 0), (0, 0, 3), (1, 2, 3), (-30, 20, -10)])
def test_gyro_counts_become_body_rates(omega: tuple[float, ...]) -> None:
    core = settled()
    core.data.fields.gyro_bias[:] = np.array(counts((0.1, -0.2, 0.3), 100)) / 100
    core.tick(counts(np.add(omega, (0.1, -0.2, 0.3)), 7), 7)
    assert core.now[9:12] == pytest.approx(omega, abs=1e-3)


@pytest.mark.parametrize("axis", range(3))
@pytest.mark.parametrize("sign", [1, -1])
def test_rates_beyond_their_bound_are_held_there_in_every_axis(axis: int, sign: int) -> None:
    core = Core(bound_rate=2.0)
    omega = np.zeros(3)
    omega[axis] = 3.0 * sign
    core.tick(counts(omega))
    assert core.now[9 + axis] == 2.0 * sign


def test_silent_gyro_leaves_the_last_rates() -> None:
    core = settled()
    core.tick(counts((0.5, -0.4, 0.3)))
    core.tick((0, 0, 0), samples=0)
    assert core.now[9:12] == pytest.approx([0.5, -0.4, 0.3], abs=1e-3)


# Bounds and recovery


@pytest.mark.long
def test_fast_and_far_motion_does_not_reset() -> None:
    core = Core()
    for tick in range(400):
        t = (tick + 1 - 4) * 0.01
        if tick % 2 == 0:
            core.pose((1.4 * math.sin(t), 1.4 * math.cos(t), math.sin(2 * t)), quaternion(yaw=30 * t))
        core.tick(counts((0, 0, 30)))
    assert "resets" not in core.counters
    assert "bounded" not in core.counters
    assert core.counters["fused"] > 190
    assert core.now[0] == pytest.approx(1.4 * math.sin(4.0), abs=0.05)


def test_state_beyond_its_bounds_is_held_there_and_counted() -> None:
    core = feed(settled(), 8, (3.0, 0, 0))
    assert core.x[0] == pytest.approx(1.5)
    assert core.counters["bounded"] > 0
    assert "resets" not in core.counters
    feed(core, 8, (0.1, 0, 0))
    assert core.now[0] == pytest.approx(0.1, abs=1e-3)


BOUNDS = np.repeat(np.float32([1.1, 2.2, 0.7, 3.3, 1.6]), (3, 3, 3, 3, 4))


@pytest.mark.long
@pytest.mark.parametrize("state", [state for state in range(16) if state != 8])  # not the yaw
@pytest.mark.parametrize("sign", [1, -1])
def test_each_state_is_held_at_its_own_bound_and_counted(state: int, sign: int) -> None:
    core = Core(bound_position=1.1, bound_velocity=2.2, bound_tilt=0.7, bound_rate=3.3)
    for far in (9.0, 0.5):
        core.fields.x[:] = 0.1
        core.fields.x[state] = far * sign
        estimator.keep_sane(core.parameters.fields, core.fields)
        held = np.where(np.arange(16) == state, sign * min(far, BOUNDS[state]), np.float32(0.1))
        assert core.x.tolist() == held.astype(np.float32).tolist()
        assert core.counters["bounded"] == 1


def test_variances_do_not_grow_beyond_their_bound() -> None:
    core = Core(process_position=50.0, process_rate=100.0)
    for _ in range(10):
        core.tick()
        assert_sane(core)
    assert np.diag(core.P)[:3].tolist() == [100.0] * 3


@pytest.mark.parametrize(
    ("variance", "held"), [(1e-12, 1e-9), (0.9e-9, 1e-9), (1.1e-9, 1.1e-9), (99.0, 99.0), (101.0, 100.0)]
)
def test_a_variance_is_held_between_its_bounds_and_covariances_below_their_product(
    variance: float, held: float
) -> None:
    core = Core()
    core.fields.P[:] = 1e3
    np.fill_diagonal(core.fields.P, variance)
    estimator.keep_sane(core.parameters.fields, core.fields)
    assert np.diag(core.P).tolist() == [np.float32(held)] * 16
    assert core.P[5, 9] == core.P[9, 5] == pytest.approx(held)


@pytest.mark.long
@pytest.mark.parametrize("bad", BAD)
@pytest.mark.parametrize(
    "place", [*(("x", state) for state in range(16)), ("P", (4, 4)), ("P", (8, 8)), ("P", (4, 9))]
)
def test_a_broken_state_restarts_from_the_next_pose(place: tuple[str, object], bad: float) -> None:
    p, q = (0.3, -0.2, 0.1), quaternion(yaw=2.0)
    core = settled(p, q)
    name, index = place
    getattr(core.fields, name)[index] = bad
    core.tick()
    assert_sane(core)
    assert core.fields.resets == 1
    for _ in range(5):
        core.fly()
        opening = core.control.fields.flap * [1, -1, 1, -1]
        assert 0.0 <= opening.min() <= opening.max() <= np.float32(0.9)
        core.tick()
        assert_sane(core)
    feed(core, 1, p, q)
    assert core.x[[0, 1, 2, 8]] == pytest.approx([*p, 2.0], abs=1e-3)
    feed(core, 40, p, q)
    assert core.now[[0, 1, 2, 8]] == pytest.approx([*p, 2.0], abs=1e-3)
    assert core.fields.resets == 1
    assert core.fields.refused == core.fields.jumps == 0
    getattr(core.fields, name)[index] = bad
    core.tick()
    assert core.fields.resets == 2


def test_broken_state_does_not_reach_the_controller_while_the_filter_waits() -> None:
    core = Core()
    core.fields.x[3] = math.nan
    core.tick()
    assert core.fields.filtered_tick == 0
    assert_sane(core)


def test_the_report_has_attitude_poses_and_flaps() -> None:
    core = settled((0.1, 0.2, 0.3), quaternion(0.3, -0.2, 1.0))
    for p, age_us in (((0.6, 0.2, 0.3), 40_000), ((math.nan, 0, 0), 40_000), ((0, 0, 0), 200_000)):
        core.pose(p, LEVEL, age_us)
        core.tick()
    feed(core, 20, (0.6, 0.2, 0.3), quaternion(0.3, -0.2, 1.0))
    core.fly()
    core.tick(command=core.control.fields.command.copy())
    report, counters = core.report.fields, core.counters
    angles = Rotation.from_quat(report.quaternion, scalar_first=True).as_euler("ZYX")[::-1]
    assert angles == pytest.approx(report.attitude, abs=1e-5)
    assert min(counters[name] for name in ("fused", "refused", "jumps", "too_old", "invalid")) > 0
    assert report.poses == sum(counters.values())
    assert report.rejected == sum(counters[name] for name in ("refused", "too_old", "invalid"))
    hover = math.radians(25) * np.array([1, -1, 1, -1])
    assert report.flap == pytest.approx(core.now[12:] + hover, abs=1e-5)
    assert np.abs(core.now[12:]).max() > 0.01


COUNTERS = {"fused", "refused", "jumps", "bounded", "resets"}
COUNTERS |= {"too_old", "invalid", "no_corrections", "frozen"}
# Of the last pose; work space; and what counts only while a pose or a suspect waits.
LEFT = {"pose_age_us", "work_1", "work_2", "work_3", "work_P", "pose", "pose_lag", "suspect", "suspect_tick"}


def test_reset_forgets_everything_but_the_counters() -> None:
    rng = np.random.default_rng(1)
    used, fresh = Core(age_measured=1), Core(age_measured=1)
    for name, (kind, *_) in Estimator.dtype.fields.items():
        garbage = rng.uniform(-2, 2, kind.shape) if kind.base.kind == "f" else rng.integers(1, 9, kind.shape)
        used.estimator.memory[name] = garbage
    before = dict(used.counters)
    entry.reset(used.parameters.fields, used.estimator.fields)
    for tick in range(180):  # the goal jumps there and back; then poses are young for more than a second
        for core in (used, fresh):
            if tick in (10, 11) or 40 < tick < 170:
                core.pose((0.9 * (40 < tick < 60), 0.1, 0), LEVEL, 40_000 * (tick < 60))
            core.tick(samples=10 if tick > 5 else 0)  # at first the last rates are all that is known
        for name in set(Estimator.dtype.names) - COUNTERS - LEFT:
            assert np.array_equal(used.estimator.memory[name], fresh.estimator.memory[name]), (name, tick)
    assert fresh.fields.jumps > 0
    assert fresh.fields.horizon < 4
    assert {name: used.counters[name] - before[name] for name in fresh.counters} == fresh.counters


FLOATS = [name for name, kind in Parameters.dtype.fields.items() if kind[0].kind == "f"]


@settings(deadline=None, max_examples=150)
@given(st.sampled_from(FLOATS), any_number)
@pytest.mark.long
def test_a_senseless_parameter_keeps_servos_in_range_and_is_recoverable(name: str, value: float) -> None:
    core = settled((0.1, 0, 0))
    sane = float(core.parameters.memory[name][0])
    core.parameters.memory[name] = value
    for tick in range(30):
        feed(core, 2, (0.1, 0, 0), quaternion(yaw=0.1))
        core.fly()
        assert 21_000 <= core.control.fields.count.min() <= core.control.fields.count.max() <= 42_000, tick
        # A bound that is no number bounds nothing.
        assert np.isfinite(core.now).all() or name.startswith("bound_")
    core.parameters.memory[name] = sane
    feed(core, 60, (0.1, 0, 0))
    core.fly()
    assert_sane(core)
    assert core.now[:9] == pytest.approx([0.1, *8 * [0]], abs=2e-3)
