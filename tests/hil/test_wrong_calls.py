"""Wrong calls of the public Python API: one clear `LabError`, and nothing flies."""

import math
import os
import re
from collections.abc import Callable
from dataclasses import dataclass
from operator import attrgetter
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pyarrow as pa
import pytest
from hypothesis import HealthCheck, example, given, settings
from hypothesis import strategies as st

import hil
from hil import (
    Along,
    Experiment,
    Fault,
    Goal,
    Kind,
    Knob,
    LabError,
    Metric,
    Request,
    RigidBody,
    Run,
    Swarm,
    column,
    declare,
    fault,
    fly,
    fly_swarm,
    knob,
    load_run,
    position_error,
)
from hil.api import command_of, request_of
from hil.errors import hint
from hil.laboratory.experiments import EXPERIMENTS
from hil.laboratory.fault_kinds import KINDS, add
from hil.laboratory.metrics import METRICS
from hil.laboratory.robot import attributes_of, probe
from hil.testing import Flights, Waypoints, faults, trajectories
from support.choices import choice

HOVER = EXPERIMENTS["hover"]
PUSH = KINDS["push.y"]
LATE = "more_latency_us"
TABLE = pa.table({"t": [0, 1], **{name: [0.0, 0.0] for name in ("goal.x", "truth.x")}})


def flights() -> Flights:
    """Return the pytest fixture for a test here."""
    found = Flights(Path(), Path("runs"))
    found.begin("test", Path("test.py"), choice())
    return found


@dataclass(frozen=True)
class Call:
    """A public function, and arguments that it accepts."""

    function: Callable[..., Any]
    right: dict[str, Any]

    def __str__(self) -> str:
        return self.function.__qualname__


OPTIONS: dict[str, Any] = {
    "profile": "floaty", "overrides": ["servo.trim[0]=0"], "seed": 1, "duration_s": 0.05, "link": "radio",
    "faults": ["push.y@0"], "board": "c", "trajectory": Along(lambda t: (0.0, 0.0, 0.0)),
}  # fmt: skip
CALLS = (
    Call(fly, {"flown": "hover", "folder": "here", "progress": False, "report": False, "replace": False, **OPTIONS}),
    Call(fly_swarm, {"flown": "hover", "robots": 2, "folder": "here", "report": False, "replace": False, **OPTIONS}),
    Call(request_of, {"experiment": "hover", **OPTIONS}),
    Call(Flights.fly, {"experiment": "hover", **OPTIONS}),
    Call(Flights.fly_swarm, {"experiment": "hover", "robots": 2, **OPTIONS}),
    Call(Flights.check, {"file": "controller.py"}),
    Call(Flights.board, {"link": "radio", "profile": "floaty", "overrides": ()}),
    Call(Flights.baseline, {"name": "mine", "rel": 0.1, "metrics": ["rms_y"]}),
    Call(Request.of, {"experiment": HOVER, **{k: v for k, v in OPTIONS.items() if k not in ("trajectory", "faults")},
                      "faults": [fault("push.y@0")], "elf": None}),
    Call(load_run, {"folder": "nowhere"}),
    Call(command_of, {"request": request_of("hover")}),
    Call(Experiment, {"name": "mine", "summary": "", "duration_s": 1.0, "limits": {"lost": 0.0}, "metrics": {},
                      "trajectory": Along(lambda t: (0.0, 0.0, 0.0)), "prepare": print, "script": print, "settings": (),
                      "faults": (), "measure": print, "pictures": (), "draw": None, "source": None}),
    Call(Metric, {"unit": "m", "bound": "max", "meaning": "a length"}),
    Call(Fault, {"kind": "push.y", "start_s": 1.0, "duration_s": 1.0, "size": 1.0}),
    Call(fault, {"text": "push.y@1"}),
    Call(Kind, {"meaning": "", "unit": "", "size": 1.0, "low": 0.0, "high": 2.0, "knobs": PUSH.knobs, "outcome": "",
                "scale": 1.0, "duration_s": 1.0, "link": "", "markers": False}),
    Call(Knob, {"read": lambda robot: 0.0, "turn": lambda robot, value: None, "blend": add}),
    Call(knob, {"owner": lambda robot: robot.mocap, "name": LATE, "blend": add}),
    Call(declare, {"name": "mocap.wrong_call", "kind": PUSH}),
    Call(Goal, {"p_WG": (0.0, 0.0, 0.0), "yaw": 0.0}),
    Call(Along, {"path": lambda t: (0.0, 0.0, 0.0)}),
    Call(position_error, {"table": None}),
    Call(faults, {"start_s": (0.0, 1.0), "duration_s": (0.0, 1.0), "size": (0.0, 1.0)}),
    Call(trajectories, {"reach_m": 0.1, "turn_rad": 0.1, "every_s": 1.0, "most": 2}),
    Call(Waypoints, {"every_s": 1.0, "goals": ((0.0, 0.0, 0.0, 0.0),)}),
)  # fmt: skip
FLYING = (fly, fly_swarm, request_of, Flights.fly, Flights.fly_swarm, Request.of)
OF_FIXTURE = (Flights.fly, Flights.fly_swarm, Flights.check, Flights.board, Flights.baseline)


@pytest.fixture(autouse=True)
def in_an_empty_folder(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setitem(KINDS, "mocap.wrong_call", PUSH)  # what a test declares ends with it


def called(call: Call, arguments: dict[str, Any]) -> object:
    """Call a public function; a method of the fixture with the fixture."""
    is_method = call.function in OF_FIXTURE
    return call.function(*([flights()] if is_method else []), **arguments)


@pytest.mark.long
@pytest.mark.parametrize("call", CALLS, ids=str)
def test_a_wrong_name_is_refused_with_the_nearest_one(call: Call) -> None:
    for name in call.right:
        wrong = f"{name[:-2]}{name[-1]}" if len(name) > 4 else f"{name}s"
        arguments = {other: value for other, value in call.right.items() if other != name} | {wrong: 1}
        with pytest.raises(LabError, match=rf"{wrong}.*did you mean {name}\?") as error:
            called(call, arguments)
        assert "\n" not in str(error.value)
    assert not os.listdir(), os.listdir()


WORDS = ("\0", "\ud800", "a" * 300, "hover.py:x")
JUNK = st.one_of(
    st.none(), st.booleans(), st.integers(), st.floats(), st.text(max_size=20), st.binary(max_size=5), st.complex_numbers(),
    st.lists(st.one_of(st.none(), st.text(max_size=3)), max_size=3),
    st.dictionaries(st.text(max_size=3), st.one_of(st.integers(), st.none()), max_size=2),
    st.sampled_from((print, int, object(), 10**400, Path("x"), np.zeros(2), np.int64(3), np.float32(math.nan), *WORDS)),
)  # fmt: skip


def is_right(name: str, value: object) -> bool:
    """Whether an argument of a flight accepts a value that the test may draw."""
    number = isinstance(value, int | float | np.integer | np.floating) and not isinstance(value, bool)
    return {
        "flown": False,
        "experiment": False,
        "robots": isinstance(value, int | np.integer) and number and 2 <= value <= 16,
        "folder": value is None or isinstance(value, str | Path),
        "progress": isinstance(value, bool) or callable(value),
        "report": isinstance(value, bool),
        "replace": isinstance(value, bool),
        "profile": False,
        "overrides": isinstance(value, list | dict) and not value,
        "seed": isinstance(value, int | np.integer) and number and 0 <= value <= 2**62,
        "duration_s": value is None or (number and 0.0 < value <= 86_400.0),
        "link": value in ("radio", "mavlink") if isinstance(value, str) else False,
        "faults": isinstance(value, list) and not value,
        "board": value in ("python", "c") if isinstance(value, str) else False,
        "trajectory": False,
        "elf": value is None,
    }[name]


@pytest.mark.long
@given(data=st.data())
@settings(max_examples=80, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
def test_a_flight_with_one_wrong_value_is_refused(data: st.DataObject) -> None:
    call = data.draw(st.sampled_from([call for call in CALLS if call.function in FLYING]))
    name = data.draw(st.sampled_from(sorted(call.right)))
    value = data.draw(JUNK.filter(lambda value: not is_right(name, value)))
    with pytest.raises(LabError) as error:
        called(call, {**call.right, name: value})
    assert "\n" not in str(error.value)
    assert not os.listdir(), os.listdir()


@pytest.mark.long
@given(data=st.data())
@settings(max_examples=200, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
def test_any_other_call_returns_or_is_refused(data: st.DataObject) -> None:
    call = data.draw(st.sampled_from([call for call in CALLS if call.function not in FLYING]))
    names = data.draw(st.sets(st.sampled_from(sorted(call.right)), min_size=1))
    wrong = {name: data.draw(JUNK) for name in sorted(names)}
    refused_in_one_line(lambda: called(call, {**call.right, **wrong}))
    assert not os.listdir(), os.listdir()


@given(positional=st.lists(JUNK, max_size=4), call=st.sampled_from(CALLS))
@settings(max_examples=100, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@example(positional=[], call=CALLS[0])
def test_any_positional_call_returns_or_is_refused(positional: list[object], call: Call) -> None:
    if call.function in OF_FIXTURE:
        positional = [flights(), *(positional or [None])]
    if call.function in (fly, fly_swarm):
        positional = positional[:1]
    refused_in_one_line(lambda: call.function(*positional))
    assert not os.listdir(), os.listdir()


def refused_in_one_line(call: Callable[[], object]) -> None:
    """Call; it may return, or raise one line."""
    text = ""
    try:
        call()
    except LabError as error:
        text = str(error)
    assert "\n" not in text


THERE = {*METRICS, *TABLE.column_names, "rms_x"}  # Hypothesis also draws words that it finds in the sources


def is_there(value: object) -> bool:
    return isinstance(value, str) and value in THERE


@pytest.mark.long
@given(
    name=st.text(max_size=8).filter(lambda name: not is_there(name)),
    value=JUNK.filter(lambda one: not is_there(one)),
)
@settings(max_examples=50, deadline=None)
def test_a_figure_that_a_run_lacks_is_refused(name: str, value: object) -> None:
    result: Any = SimpleNamespace(metrics={"rms_x": 1.0}, own_metrics={}, folder=Path())
    run = Run(result)
    for read in (
        lambda: run.metrics[name],
        lambda: run.unit_of(name),
        lambda: run.unit_of(value),  # type: ignore[arg-type]
        lambda: run.paths[name],
        lambda: column(TABLE, name),
        lambda: column(TABLE, value),  # type: ignore[arg-type]
        lambda: column(value, "t"),  # type: ignore[arg-type]
    ):
        with pytest.raises(LabError):
            read()


def test_the_wrong_calls_of_a_user_name_what_was_meant() -> None:
    for options, text in (
        ({"duration": 1.0}, "fly: unknown argument 'duration'; did you mean duration_s?"),
        ({"overides": ["controller.gain_z=3"]}, "fly: unknown argument 'overides'; did you mean overrides?"),
        ({"sed": 3}, "fly: unknown argument 'sed'; did you mean seed?"),
        ({"duration_s": "3"}, "fly: duration_s = '3': expected a number or None"),
        ({"seed": -3}, "--seed -3: expected a whole number, 0 to 4611686018427387904"),
        ({"seed": True}, "fly: seed = True: expected a whole number"),
    ):
        with pytest.raises(LabError) as error:
            fly("hover", **options)  # type: ignore[arg-type]
        assert str(error.value) == text


def test_a_dictionary_of_overrides_is_the_list_of_their_texts() -> None:
    values = {
        "controller.gain_z": 3,
        "tunnel.turbulence": "none",
        "servo.trim": (1, 2, 3, 4),
        "markers.enabled": True,
    }
    texts = (
        "controller.gain_z=3",
        "tunnel.turbulence=none",
        "servo.trim=[1, 2, 3, 4]",
        "markers.enabled=true",
    )
    request = request_of("hover", overrides=values)
    assert request.overrides == texts
    assert request.config == request_of("hover", overrides=list(texts)).config
    assert request.config.controller.gain_z == 3.0


def test_numbers_of_numpy_count_as_numbers() -> None:
    request = request_of("hover", seed=np.int64(3), duration_s=np.float32(0.5))  # type: ignore[typeddict-item]
    assert (request.seed, request.duration_s) == (3, 0.5)
    assert type(request.seed) is int


def test_every_public_name_is_called_here() -> None:
    called = {call.function for call in CALLS} | {LabError, Request, RigidBody, Run, Swarm, column}
    assert {getattr(hil, name) for name in hil.__all__} <= called


def test_a_metric_with_an_unknown_bound_is_refused_where_it_is_declared() -> None:
    with pytest.raises(LabError, match=r"Metric: bound = 'rms': expected 'max' or 'min'"):
        Metric("m", "rms", "distance")  # type: ignore[arg-type]


def test_a_knob_of_an_unknown_attribute_is_refused_with_those_that_exist() -> None:
    with pytest.raises(
        LabError, match="knob 'nope_us' of VirtualMocap: there are dropout, frozen, more_latency_us, outlier"
    ):
        knob(lambda robot: robot.mocap, "nope_us", add)
    with pytest.raises(LabError, match="knob 'more_latency' of VirtualMocap: did you mean more_latency_us"):
        knob(lambda robot: robot.mocap, "more_latency", add)
    with pytest.raises(LabError, match=r"knob 'share': test_wrong_calls.py:\d+: AttributeError: .*'thieves'"):
        knob(lambda robot: robot.thieves, "share", add)  # type: ignore[attr-defined]


def test_a_knob_that_cannot_be_turned_is_refused_where_its_kind_is_declared() -> None:
    def kind(blend: Callable[[float, float], float], link: str = "") -> Kind:
        owner = (lambda robot: robot.uart) if link != "radio" else (lambda robot: robot.mocap)
        name = "connected" if link != "radio" else LATE
        return Kind("", "", 1.0, 0.0, 2.0, (knob(owner, name, blend),), link=link)

    with pytest.raises(LabError, match=r"fault kind mocap.wrong_call: .*'NoneType' object has no attribute"):
        declare("mocap.wrong_call", kind(add))  # no robot on a radio has a serial line
    declare("mocap.wrong_call", kind(add, "mavlink"))
    with pytest.raises(
        LabError, match=r"fault kind mocap.wrong_call: .*test_wrong_calls.py:\d+: ZeroDivisionError"
    ):
        declare("mocap.wrong_call", kind(lambda value, size: 1 / 0, "radio"))
    with pytest.raises(LabError, match=r"fault kind mocap.wrong_call: .*expected a number"):
        declare("mocap.wrong_call", kind(lambda value, size: "x", "radio"))  # type: ignore[arg-type,return-value]
    with pytest.raises(LabError, match="Kind: link = 'wire': expected '', 'radio' or 'mavlink'"):
        kind(add, "wire")


def test_the_page_lists_the_attributes_that_a_knob_can_set() -> None:
    page = (Path(hil.__file__).parent.parent / "docs/howto/python.md").read_text()
    robot = probe("", markers=True)
    rows = re.findall(r"^\| `robot\.([\w.]+)`.*?\| (.*) \|$", page, re.MULTILINE)
    assert len(rows) == 6
    for part, names in rows:
        assert re.findall(r"`(\w+)`", names) == attributes_of(attrgetter(part)(robot)), part


def test_of_many_names_a_dozen_is_listed() -> None:
    many = [f"name{index}" for index in range(100)]
    assert hint("?", many[:12]) == f"there are {', '.join(many[:12])}"
    assert hint("?", many) == f"there are {', '.join(many[:12])} and 88 more"
    assert hint("name9", many[:9]).startswith("did you mean name")
