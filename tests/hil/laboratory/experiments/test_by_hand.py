"""The experiments' scripts on a bare time line, and their measures on logs small enough to compute by hand."""

from collections.abc import Callable
from math import isnan, radians, sqrt
from types import SimpleNamespace
from typing import Any

import numpy as np
import pyarrow as pa
import pytest

from firmware_py.config import SIGNALS
from firmware_py.wire.crtp import PORT_PLATFORM, Packet, encode
from firmware_py.wire.parameters import SetByName, encode_set_by_name
from firmware_py.wire.scalars import Scalar
from firmware_py.wire.supervisor import Cause
from hil.emulator.events import EventQueue
from hil.laboratory.experiments import EXPERIMENTS, measures
from hil.laboratory.experiments.airspeed import holding
from hil.laboratory.experiments.disturbances import fan
from hil.laboratory.experiments.overload import loads_that_hurt
from hil.laboratory.experiments.power import VEHICLES
from hil.laboratory.experiments.take_off import measure as take_off

RELEASE_US = 2_000_000


class TimeLine:
    """A flight reduced to its events; `done` has what its script does, with the time after the release [s]."""

    def __init__(self, name: str, **config: Any) -> None:
        self.events, self.done = EventQueue(), list[tuple[float, Any]]()
        self.release_us, self.now_us = RELEASE_US, 100_000
        tunnel = SimpleNamespace(set_fan_factor=self._note)
        self.robot: Any = SimpleNamespace(
            body=SimpleNamespace(tunnel=tunnel), thief=self, battery=SimpleNamespace(charge=0.0625)
        )
        self.supervisor = SimpleNamespace(cause=Cause.NONE)
        self.robot.firmware = SimpleNamespace(signals=SimpleNamespace(supervisor=self.supervisor))
        self.line = SimpleNamespace(command=lambda now_us, packet: self._note(packet))
        self.lab = SimpleNamespace(end_at=lambda us: self._note(f"ends at {us}"))
        self.config = SimpleNamespace(excitation=SimpleNamespace(**config))
        EXPERIMENTS[name].script(self)  # type: ignore[arg-type]

    def _note(self, what: Any) -> None:
        self.done.append(((self.events.now_us - RELEASE_US) / 1e6, what))

    def note(self, source: str, text: str) -> None:
        self._note(text)

    def __setattr__(self, name: str, value: Any) -> None:
        if name == "share":
            self._note(value)
        object.__setattr__(self, name, value)

    def run(self) -> list[tuple[float, Any]]:
        self.events.run(RELEASE_US + 60_000_000)
        return self.done


def test_the_operator_ramps_the_fans_and_switches_the_controller() -> None:
    flight = TimeLine("take-off-landing")
    done = flight.run()
    on, off = (encode(Packet(PORT_PLATFORM, 0, bytes((1, one)))) for one in (1, 0))
    assert [(round(at, 3), what) for at, what in done if isinstance(what, bytes)] == [
        (-1.5, off),
        (2.2, on),
        (26.2, off),
    ]
    fans = [(round(at, 3), what) for at, what in done if isinstance(what, float)]
    assert fans[0] == (-2.0, 0.0)
    expected = []
    for start, before, after in ((1.0, 0.0, 0.93), (8.2, 0.93, 1.0), (18.2, 1.0, 0.88), (26.2, 0.88, 0.0)):
        expected += [(start + 0.05 * step, before + (after - before) * step / 18) for step in range(1, 19)]
    assert np.array(fans[1:]) == pytest.approx(np.array(expected), abs=1e-9)
    texts = [(round(at, 3), what) for at, what in done if isinstance(what, str) and what.startswith("fans")]
    assert texts[1] == (8.2, "fans from 93% to 100% of the flight speed")
    assert [at for at, _ in texts] == [1.0, 8.2, 18.2, 26.2]


def test_the_excitation_is_switched_on_two_seconds_after_the_release() -> None:
    for signal in SIGNALS[1:]:
        packet = encode_set_by_name(SetByName("excite.signal", Scalar.U8, SIGNALS.index(signal)))
        assert TimeLine("identify", signal=signal).run() == [(2.0, packet), (2.0, f"excitation on: {signal}")]


def test_the_thief_takes_a_twentieth_more_every_second_and_a_half() -> None:
    taken = [one for one in TimeLine("overload").run() if isinstance(one[1], float)]
    assert np.array(taken) == pytest.approx(np.array([(1.5 * step, 0.05 * step) for step in range(21)]))


def test_a_flight_ends_at_the_first_look_after_the_battery_is_found_empty() -> None:
    flight = TimeLine("endurance")
    flight.events.at(RELEASE_US + 100_000, lambda _: setattr(flight.supervisor, "cause", Cause.DISARMED))
    flight.events.at(RELEASE_US + 300_001, lambda _: setattr(flight.supervisor, "cause", Cause.LOW_BATTERY))
    assert flight.run() == [
        (0.4, "the battery is empty: 6.2% left"),
        (0.4, f"ends at {RELEASE_US + 400_000}"),
    ]


def log(times: np.ndarray, **columns: Any) -> pa.Table:
    """Rows of a flight at the goal (0, 0, 1), but for these columns: arrays, or functions of time [s]."""
    zero = np.zeros(len(times))
    found = {f"{group}.{axis}": zero + (axis == "z") for group in ("truth", "goal") for axis in "xyz"}
    found |= {"t": 1e6 * times + RELEASE_US, "goal.yaw": zero, "truth.vz": zero}
    for name, values in columns.items():
        found[name.replace("_", ".")] = zero + (values(times) if isinstance(values, Callable) else values)  # type: ignore[arg-type]
    return pa.table(found)


TIMES = np.round(np.arange(0.0, 29.2, 0.1), 1)


def test_a_take_off_and_its_landing_are_measured_between_their_switches() -> None:
    """On the net until 3 s, in the box from 9 s on but for a second, down at 22 s."""
    height = np.select(
        [TIMES < 2.8, TIMES < 3.0, TIMES < 8.0, TIMES < 8.2, TIMES < 9.0, TIMES < 20.0, TIMES < 22.0],
        [0.049, 0.069, 0.5, 1.0, 0.5, 1.09, 0.3], 0.049,
    )  # fmt: skip
    climb = np.zeros(len(TIMES))
    climb[[209, 210, 220, 221]] = -3.0, -0.7, -0.5, -2.0  # the feet touch in row 220
    away = {"truth_x": 0.2 * ((TIMES >= 12.0) & (TIMES < 13.0)), "truth_y": 0.11 * (TIMES >= 18.2)}
    away["truth_x"][-1], away["truth_y"][-1] = 0.03, 0.04
    values = take_off(log(TIMES, truth_z=height, truth_vz=climb, **away))
    assert values == pytest.approx(
        {
            "lift_off": 0.8,
            "reached_box": 0.8,
            "touch_down_speed": 0.7,
            "landed_off_axis": 0.05,
            "hover_in_box": 82 / 92,
        }
    )
    climb[220] = -0.9
    assert take_off(log(TIMES, truth_z=height, truth_vz=climb))["touch_down_speed"] == pytest.approx(0.9)
    assert all(map(isnan, take_off(log(TIMES, truth_z=0.069)).values())), (
        "2 cm above the net are not in the air"
    )
    flown = take_off(log(TIMES, truth_z=0.5))
    assert flown["lift_off"] == pytest.approx(-2.2)
    assert [name for name, value in flown.items() if isnan(value)] == [
        "reached_box", "touch_down_speed", "landed_off_axis", "hover_in_box",
    ]  # fmt: skip


@pytest.mark.parametrize("axis", [0, 1])
def test_the_offset_in_a_wind_is_that_of_its_last_five_seconds(axis: int) -> None:
    times = np.round(np.arange(0.0, 14.0, 0.01), 2)
    blown = np.select([times < 7.0, times < 8.0, times < 12.0], [0.9, -0.6, 0.025], 0.7)  # -0.1 in the mean
    flight = log(times, **{f"truth_{'xy'[axis]}": blown, f"truth_{'yx'[axis]}": 0.5})
    assert measures.leaning(axis, 12.0, flight) == {"wind_offset": pytest.approx(0.1)}
    assert measures.leaning(axis, 12.0, flight.slice(0, 1200)) == {"wind_offset": pytest.approx(0.1)}
    assert measures.leaning(axis, 12.0, flight.slice(0, 1199)) == {}, "lost before the wind ended"


def test_a_load_hurts_from_its_first_late_row_on_and_is_held_up_to_the_step_before_the_box_is_left() -> None:
    share = np.array([0.0, 0.0, 0.05, 0.05, 0.1, 0.1, 0.15, 0.15, 0.2])
    times = 0.01 * np.arange(len(share))
    own = {"cpu_THIEF": np.cumsum(share * 1e4), "late_KALMAN": np.cumsum(share >= 0.1), "late_STABILIZER": 0}
    for away, held in ((share >= 0.15, 0.1), (share > 9.0, 0.2), (share >= 0.0, np.nan)):
        assert loads_that_hurt(log(times, truth_y=0.11 * away, **own)) == pytest.approx(
            {"estimator_late_from": 0.1, "controller_late_from": np.inf, "held_up_to": held}, nan_ok=True
        )


def test_a_height_sine_is_measured_in_z() -> None:
    times = np.arange(0.0, 21.0, 0.01)
    sine = np.sin(0.2 * np.pi * (times - 1.0))
    late = 1.0 + 0.8 * np.sin(0.2 * np.pi * (times - 1.0) - 0.3)
    flight = log(times, goal_z=1.0 + sine * (times >= 1.0), truth_z=late, truth_y=sine, goal_y=sine)
    assert measures.height_sine(0.1, flight) == pytest.approx({"gain": 0.8, "lag": 0.3}, abs=0.005)


def test_a_flight_without_a_jump_has_no_steps() -> None:
    assert measures.y_steps(log(TIMES)) == {}


@pytest.mark.parametrize(("speed", "off", "agrees"), [
    (10.0, 0.1, 1.0), (10.0, 0.1001, 0.0), (9.5, 0.0, 1.0), (9.4, 0.0, 0.0), (9.4, 0.2, 1.0),
    (10.4, 0.0, 1.0), (10.5, 0.0, 0.0),
])  # fmt: skip
def test_a_height_is_held_in_the_second_half_where_the_flaps_can_carry(
    speed: float, off: float, agrees: float
) -> None:
    flight = log(np.arange(10.0), truth_z=lambda times: 1.0 - np.where(times >= 4.5, off, 0.4))
    assert holding(speed, flight) == {"height_off": pytest.approx(off), "as_computed": agrees}


def test_an_airspeed_limits_what_the_flaps_can_carry() -> None:
    openings_deg = {
        8: 0.0,
        8.5: 0.0,
        9: 0.0,
        9.5: 0.0,
        9.75: 12.3,
        10: 25.0,
        10.25: 36.8,
        10.5: 47.7,
        11: 51.6,
    }
    assert [name for name in EXPERIMENTS if "airspeed" in name] == [
        f"airspeed-{one:g}" for one in openings_deg
    ]
    for speed, opening_deg in openings_deg.items():
        experiment = EXPERIMENTS[f"airspeed-{speed:g}"]
        carried = 9.5 <= speed <= 10.4
        held = {"lost": 0.0, "height_off": 0.06, "in_box": 0.85} if carried else {"lost": 1.0}
        assert experiment.limits == {"as_computed": 1.0} | held
        (wind, angle, least) = (float(one.partition("=")[2]) for one in experiment.settings)
        assert (wind, least) == (speed, -0.192)
        assert angle == pytest.approx(radians(opening_deg), abs=2e-3)
        assert ("carried" if carried else "beyond the flaps") in experiment.summary


def test_a_fan_spins_up_in_equal_steps_and_stops_at_once() -> None:
    assert [(one.start_s, one.duration_s, one.size) for one in fan("wind.side_y", 3.0, 3)] == [
        (2.0, 10.0, 1.0), (2.5, 9.5, 1.0), (3.0, 9.0, 1.0),
    ]  # fmt: skip


@pytest.mark.parametrize(("hertz", "periods"), [(0.02, 1), (0.05, 1), (0.10, 2), (0.15, 3)])
def test_a_yaw_sine_may_lag_by_the_time_that_was_measured(hertz: float, periods: int) -> None:
    """Of a sine of amplitude A, one that lags by a small angle differs by A times the angle over the root of 2, rms."""
    experiment = EXPERIMENTS[f"yaw-sine-{hertz:.2f}"]
    lag = 2 * np.pi * hertz * 0.22
    assert experiment.duration_s == pytest.approx(1.0 + periods / hertz)
    assert experiment.limits["lag"] == pytest.approx(lag)
    assert experiment.limits["rms_yaw"] == pytest.approx(np.pi / 2 / sqrt(2.0) * lag + radians(1.0))


def test_the_specific_powers_are_those_of_the_papers_method() -> None:
    """Energy over flight time and mass; helicopters, share of the rated power: 0.825 with pistons, 0.675 with turbines."""
    expected = {
        "Crazyflie 2.1": 8.0 / 0.027, "custom quadcopter": 145.0, "DJI Mini 4 Pro": 134.4, "DJI Air 3": 113.4,
        "DJI Mavic 3 Pro": 112.2, "DJI Avata": 290.3, "Robinson R22": 122.6, "Bell 206B": 110.0, "Airbus H125": 189.5,
        "Sikorsky UH-60M": 201.8,
    }  # fmt: skip
    assert {one.name: one.specific_power for one in VEHICLES if not one.updraft} == pytest.approx(
        expected, abs=0.06
    )
    assert [one.specific_power for one in VEHICLES if one.updraft] == pytest.approx([6.6 / 0.027, 68.0])
    assert {
        one.name for one in VEHICLES if one.power_range[1] / one.power_range[0] == pytest.approx(1.2)
    } == {"Robinson R22"}
    assert {one.kind for one in VEHICLES} == {"quadcopter", "drone", "helicopter"}
