"""The drill takes the supervisor through its states as planned, and two boards are compared over it."""

import struct
from pathlib import Path
from types import SimpleNamespace as Made
from typing import Any

import pytest
from cflib.crazyflie.high_level_commander import HighLevelCommander
from cflib.crazyflie.localization import Localization

from firmware_py.table import OF_PROFILE, value_in
from firmware_py.wire.crtp import decode
from firmware_py.wire.scalars import PARAMETER_SCALARS
from hil.config import load_config
from hil.deploy import beside
from hil.deploy.drill import DRILL, FEED, GO_TO, STOP, THRUST, drill, fail
from hil.laboratory.files.recorder import load_events
from hil.laboratory.request import Request
from hil.laboratory.run import fly

PLANNED = (  # [s] of the record; released at 11 s
    (0.52, "waiting"), (1.57, "flying"), (2.01, "failsafe, disarmed"), (2.21, "flying"),
    (2.41, "failsafe, emergency stop"), (2.61, "flying"), (3.01, "failsafe, out of bounds"),
    (3.41, "not followed: poses are corrections"), (3.46, "not followed: it leaves the box"), (3.5, "path refused"),
    (3.7, "flying"), (9.8, "failsafe, low battery"), (10.21, "failsafe, emergency stop"), (10.41, "flying"),
    (11.99, "failsafe, silence"), (12.21, "flying"), (13.02, "failsafe, imu stale"), (13.15, "flying"),
    (15.08, "failsafe, emergency stop"),
)  # fmt: skip


def test_the_drill_s_states_and_refusals_come_when_they_are_planned(tmp_path: Path) -> None:
    assert fly(Request.of(DRILL), tmp_path / "run").outcome == "completed"
    told = [one for one in load_events(tmp_path / "run") if one["source"] == "board"]
    told = [one for one in told if one["text"].startswith(("supervisor: ", "commander: "))]
    for one, (t_s, text) in zip(told, PLANNED, strict=True):
        assert text in one["text"]
        assert 1e-6 * one["t_us"] == pytest.approx(t_s, abs=0.003), one
    states = [text for _, text in PLANNED if text.split(",")[0] in ("waiting", "flying", "failsafe")]
    assert beside.states_of(tmp_path / "run") == states


def test_its_packets_are_those_that_cflib_sends() -> None:
    sent: list[tuple[int, int, bytes]] = []
    link = Made(platform=Made(get_protocol_version=lambda: 11),
        add_port_callback=lambda *_: None,
        send_packet=lambda packet: sent.append((packet.port, packet.channel, bytes(packet.data))))  # fmt: skip
    HighLevelCommander(link).go_to(0.0, 0.0, 0.0, 0.0, 1.0, relative=True)
    HighLevelCommander(link).stop()
    with pytest.warns(DeprecationWarning, match="emergency_stop_watchdog"):
        Localization(link).send_emergency_stop_watchdog()
    assert [(one.port, one.channel, one.data) for one in map(decode, (GO_TO, STOP, FEED))] == sent
    thrust = decode(THRUST)
    assert (thrust.port, thrust.channel, struct.unpack("<3fH", thrust.data)) == (3, 0, (0.0, 0.0, 0.0, 1))


@pytest.mark.parametrize(
    ("changes", "resets", "expected"),
    [
        ({}, (0, 0), []), ({"outcome": "lost", "cause": "fell"}, (0, 0),
        ["the flight ends otherwise: python completed, image lost (fell)"]),
        ({"cause": "odd"}, (0, 0), ["the flight ends otherwise: python completed, image completed (odd)"]),
        ({}, (2, 3), ["the board reset 5 times in flight"]),
    ],
)  # fmt: skip
def test_both_flights_of_an_image_and_their_ends_are_compared(
    changes: dict[str, str], resets: tuple[int, int], expected: list[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    flown: list[Any] = []

    def fly_one(request: Request, folder: Path, progress: Any) -> Any:
        progress(7, "flight")
        image = Made(watchdog_resets=resets[0], software_resets=resets[1]) if folder.name == "image" else None
        ended = Made(outcome="completed", cause=None, image=image, folder=folder)
        flown.append(
            (request.experiment.name, request.bench.board, request.duration_s, request.faults, folder.name)
        )
        vars(ended).update(changes if image and request.experiment is not DRILL else {})
        return ended

    monkeypatch.setattr(beside, "fly", fly_one)
    monkeypatch.setattr(beside, "load_flown", lambda folder: f"{folder.parent.name}/{folder.name}")
    monkeypatch.setattr(beside, "compare_flights", lambda *flights: flights)
    monkeypatch.setattr(
        beside, "compare_states", lambda *folders: [f"{one.parent.name}/{one.name}" for one in folders]
    )
    shown: list[Any] = []
    compared, ends, states = beside.fly_beside_python(
        Path("a.elf"), "floaty", (), lambda *what: shown.append(what)
    )
    assert (compared, states) == (["hover/python", "hover/image"], ["supervisor/python", "supervisor/image"])
    assert ends == (2 if resets[0] else 1) * expected, "resets in each of both flights"
    hover, drilled = (
        ("hover", "c", 4.0, beside.FAULTS),
        ("supervisor", "c", 4.4, ("radio.cut@0.5:0.7", "imu.freeze@2:0.05")),
    )
    assert [one[:2] + one[4:] for one in flown] == [
        (name, board, place)
        for name, *_ in (hover, drilled)
        for board, place in (("c", "python"), ("a.elf", "image"))
    ]
    assert {one[0]: one[2:4] for one in flown} == {one[0]: one[2:] for one in (hover, drilled)}
    assert shown == [
        (f"{name}, {board}", 7, "flight") for name, *_ in (hover, drilled) for board in ("python", "image")
    ]


def test_what_a_drill_changes_is_as_before_at_its_end_and_each_failure_is_recovered_from() -> None:
    """Each parameter is written twice and has the profile's value last; a flight recovers within the 0.6 s after a stop."""
    config, own = load_config(), {one.name: key for key, one in OF_PROFILE.items()}
    before = {"floaty.armed": 1.0, "floaty.stop": 0.0, "logic.law_fails": 0.0, "logic.filter_fails": 0.0,
        "extCtrl.manual": 0.0, "extPose.absolute": 0.0}  # fmt: skip
    for script in (drill, fail):
        writes: list[tuple[int, str, float]] = []
        cameras: list[float] = []
        robot = Made(mocap=Made(_dropout=0.0))
        planned: list[tuple[int, Any]] = []

        def command(now_us: int, packet: bytes, writes: Any = writes) -> None:
            got = decode(packet)
            if (got.port, got.channel) == (2, 3):
                _, group, name, rest = got.data.split(b"\0", 3) if got.data[0] == 0 else (b"", b"", b"", b"")
                kind, value = PARAMETER_SCALARS[rest[0]], rest[1:]
                writes.append((now_us, f"{group.decode()}.{name.decode()}", kind.unpack(value)))

        flight: Any = Made(config=config, robot=robot, release_us=11_000_000, line=Made(command=command),
            events=Made(at=lambda at_us, act, planned=planned: planned.append((at_us, act))))  # fmt: skip
        knob = Made(turn=lambda robot, value, cameras=cameras: cameras.append(value))
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr("hil.deploy.drill.KINDS", {"mocap.dropout": Made(knobs=[knob])})
            script(flight)
            for at_us, act in sorted(planned, key=lambda one: one[0]):
                act(at_us)
        assert cameras == ([1.0, 0.0] if script is drill else [])
        last = {name: value for _, name, value in writes}
        for name, value in last.items():
            profile = value_in(config, own[name]) if name in own else before[name]
            assert value == pytest.approx(profile), name
            assert len([one for one in writes if one[1] == name]) % 2 == (name == "extCtrl.manual")
        stops = [at_us for at_us, name, value in writes if name == "floaty.stop" and value]
        goes = [at_us for at_us, name, value in writes if name == "floaty.stop" and not value]
        assert [after - at for at, after in zip(stops, goes, strict=True)] == [200_000] * len(stops)
        if script is fail:
            failures = [at_us for at_us, name, value in writes if name.startswith("logic.") and value]
            assert [stop - at for at, stop in zip(failures, stops, strict=True)] == [400_000] * 2
