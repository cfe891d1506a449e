"""A real flight's record: what the cameras saw is judged as the truth would be, whatever ends the flight."""

import json
import math
import shutil
from contextlib import closing
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from mcap.reader import make_reader
from pymavlink import mavutil
from scipy.spatial.transform import Rotation

import hil.pictures.figures
from firmware_py.wire.supervisor import State
from firmware_py.wire.telemetry import state_in
from ground_station.config import StationConfig
from ground_station.latency import LinkLatency
from ground_station.links.loopback import LoopbackLink
from ground_station.mocap import MocapFrame
from ground_station.program import StationSession
from ground_station.records import Records
from ground_station.station import GroundStation
from ground_station.trajectory import FlightPlan, Goal
from hil.config import load_config
from hil.errors import LabError
from hil.laboratory.experiments import EXPERIMENTS
from hil.laboratory.files.ages import ages_in_time_of, reported_ages
from hil.laboratory.files.recorder import Observer, Recorder, load_events, load_log, release_of
from hil.laboratory.files.result import Result, read_result
from hil.laboratory.files.station_channels import Unwrapped
from hil.laboratory.lockstep import lockstep_flight
from hil.laboratory.metrics import ALWAYS, body, free_flight, known, measure
from hil.laboratory.real_flight import RealFlight, why_lost
from hil.laboratory.request import REAL, Bench, Request
from hil.laboratory.run import fly
from hil.pictures import figures
from hil.pictures.compare import _judged, compare, load_flown
from hil.pictures.curves import with_marks
from hil.pictures.drawing import figure_of
from hil.pictures.exports.mcap import write_mcap
from hil.pictures.exports.tlog import write_tlog
from hil.pictures.exports.wide_csv import write_csv
from hil.pictures.figures import PICTURES
from hil.pictures.gallery import GALLERY
from hil.pictures.panels import marks_of_flight
from hil.pictures.report import write_report
from hil.research.identify.record import _flown_with
from support.full_disk import small_files
from support.html_page import Page
from support.watching import Watcher

CONFIG = load_config()
HOME = Goal(CONFIG.flight.home, 0.0)
TURN_US = 5_000
AGE_US = 40_000


def recorder_of(
    folder: Path,
    experiment: str,
    clock: Any,
    said: list[str],
    records: Records | None = None,
    observer: Observer | None = None,
) -> RealFlight:
    chosen = EXPERIMENTS[experiment]
    bench = Bench("udp://127.0.0.1:19850", REAL)
    request = Request(chosen, "floaty", (), 0, chosen.duration_s, (), bench)
    return RealFlight(folder, request, records or Records(), said.append, clock, observer)


class Link:
    """What the recorder reads of a link."""

    def __init__(self, ground: GroundStation) -> None:
        self.latency, self.late, self._ground = LinkLatency("air", 1_400, measured=True), 0, ground
        self.quality = self.rssi = math.nan

    @property
    def sent(self) -> int:
        return self._ground.counters.sent

    @property
    def supervisor_state(self) -> int | None:
        return state_in(tuple(self._ground.telemetry.values()))


@pytest.fixture(scope="module")
def both(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """Run folders of one flight: as the laboratory sees it, and as its ground station does."""
    folder = tmp_path_factory.mktemp("both")
    real, simulated = folder / "real", folder / "simulated"
    simulated.mkdir()
    experiment = EXPERIMENTS["yaw-step-0"]
    flight = lockstep_flight(Request.of(experiment, duration_s=4.0), simulated / "telemetry.csv")
    metadata = {"experiment": experiment.name, "config": CONFIG.model_dump_json()}
    recorder = Recorder(simulated, flight.channels(), metadata)
    record = recorder_of(real, experiment.name, lambda: flight.now_us, [])
    plan = FlightPlan(HOME, experiment.trajectory)
    plan.start(CONFIG.flight.release_us)
    session = StationSession(Link(flight.line.station), flight.line.station, plan)  # type: ignore[arg-type, attr-defined]
    flight.events.every(TURN_US, TURN_US, lambda now_us: record.on_loop(session, now_us))
    flight.run(recorder=recorder)
    recorder.close()
    flight.close()
    shutil.copy(simulated / "telemetry.csv", real)
    assert record.close() is not None
    return real, simulated


@pytest.mark.long
def test_the_cameras_judge_a_flight_as_the_truth_does(both: tuple[Path, Path]) -> None:
    """The turn by 110 degrees: poses that stood 40 ms late in the log would settle 40 ms later."""
    real, truth = (load_log(folder) for folder in both)
    measured = [
        measure(log, lost=False) | dict(EXPERIMENTS["yaw-step-0"].measure(free_flight(log)))
        for log in (real, truth)
    ]
    for name in ("rms_x", "rms_y", "rms_z", "max_x", "max_y", "max_z"):
        assert measured[0][name] == pytest.approx(measured[1][name], abs=0.002), name
    assert measured[0]["settle"] == pytest.approx(measured[1]["settle"], abs=0.015)
    assert measured[0]["attitude_max"] == pytest.approx(measured[1]["attitude_max"], abs=0.02)
    assert measured[0]["peak_rate"] == pytest.approx(measured[1]["peak_rate"], rel=0.05)
    assert measured[0]["age_mean"] == pytest.approx(measured[1]["age_mean"], abs=0.002)
    assert measured[0]["poses_refused"] == measured[1]["poses_refused"]
    assert measured[0]["unseen"] == 0.0


@pytest.fixture(scope="module")
def simulated(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The run folder of the same flight, simulated."""
    folder = tmp_path_factory.mktemp("simulated") / "run"
    fly(Request.of(EXPERIMENTS["yaw-step-0"], seed=1, duration_s=4.0), folder)
    return folder


@pytest.mark.long
def test_a_real_flight_lies_over_the_simulated_one(both: tuple[Path, Path], simulated: Path) -> None:
    comparison = compare(load_flown(both[0]), load_flown(simulated))
    apart = {one.name: one for one in comparison.apart}
    assert apart["z"].rms < 0.3  # [cm] the same flight
    assert apart["pitch"].rms < 1.0  # [deg]
    assert apart["flap 1"].rms < 5.0
    assert comparison.one_is_real
    assert "truth.x" in comparison.missing[0]
    assert "cameras.x" in comparison.missing[1]


@pytest.mark.long
def test_the_report_of_a_real_flight_names_the_cameras(both: tuple[Path, Path], tmp_path: Path) -> None:
    folder = Path(shutil.copytree(both[0], tmp_path / "run"))
    page = Page(write_report(folder).read_text(encoding="utf-8"))
    text = (folder / "report.html").read_text(encoding="utf-8")
    assert "what the cameras saw" in text
    assert "yaw-step-0, real flight" in text
    assert "seed" not in {row[0] for row in page.tables["run"]}
    drawn = [picture.title for picture in PICTURES if picture.fits(load_log(folder).column_names)]
    assert drawn == ["Errors", "Flaps", "States", "Estimate", "Age", "Station"]
    shown = [name for name, plot in page.plots.items() if not plot["alone"]]
    assert (
        len(page.pictures) + len(shown) == 1 + len(drawn) + 3
    )  # its own, path, path against goal, latency budget


@pytest.mark.long
def test_the_operator_s_actions_are_marked_in_the_figures(both: tuple[Path, Path]) -> None:
    events = [
        {
            "t_us": 3_000_000,
            "source": "operator",
            "text": "set controller.gain_y -2, was -1.6 (extCtrl.y_P 2)",
        },
        {"t_us": 2_000_000, "source": "station", "text": "poses 963"},
    ]
    log = with_marks(load_log(both[0]), events)
    for draw in (figures.errors, figures.flaps, GALLERY["yaw-step"].draw):
        drawn = figure_of(draw(log), marks_of_flight(log)).axes
        named = [text.get_text() for axes in drawn for text in axes.texts]
        assert any(text.startswith("set controller.gain_y -2") for text in named)
        assert not any("poses" in text for text in named)
        for axes in drawn:
            assert any(
                list(line.get_xdata()) == pytest.approx([2.0, 2.0], abs=0.02)  # from the release
                for line in axes.lines
                if len(line.get_xdata()) == 2
            )


@pytest.mark.long
def test_a_real_flight_is_exported_as_what_the_cameras_saw(both: tuple[Path, Path], tmp_path: Path) -> None:
    folder = Path(shutil.copytree(both[0], tmp_path / "run"))
    with write_mcap(folder).open("rb") as file:
        summary = make_reader(file).get_summary()
    assert summary is not None
    topics = {channel.topic for channel in summary.channels.values()}
    assert "/cameras/pose" in topics
    assert "/truth/pose" not in topics
    poses = []
    with closing(mavutil.mavlink_connection(str(write_tlog(folder)))) as log:
        while (message := log.recv_match(type="ATT_POS_MOCAP")) is not None:
            poses.append((message.x, -message.y, -message.z))
    seen = body(known(load_log(folder)), "x", "y", "z")[::2]
    assert np.abs(np.array(poses) - seen).max() < 1e-6
    assert "cameras.x [m]" in write_csv(folder).read_text().splitlines()[0]


class StationBench:
    """A station that sees what the test says; nothing flies."""

    def __init__(self, folder: Path, experiment: str = "hover") -> None:
        self.now_us = 7_000_000
        self.said: list[str] = []
        self.records = Records()
        self.observer = Watcher()
        self.record = recorder_of(
            folder, experiment, lambda: self.now_us, self.said, self.records, self.observer
        )
        self.plan = FlightPlan(HOME, EXPERIMENTS[experiment].trajectory)
        link = LoopbackLink(lambda now_us, data: None, 1_400, dict)
        self.ground = GroundStation(link, self.plan, None, StationConfig())
        self._link = SimpleNamespace(
            latency=link.latency, late=0, sent=0, quality=99.0, rssi=40.0, supervisor_state=State.FLYING
        )  # fmt: skip
        self.session = StationSession(self._link, self.ground, self.plan)  # type: ignore[arg-type]

    def fly(self, duration_s: float, p: tuple[float, float, float] = HOME.p_WG) -> None:
        """Turn after turn with the robot at a place."""
        end_us = self.now_us + round(1e6 * duration_s)
        while self.now_us < end_us:
            self.now_us += TURN_US
            self.ground.on_frame(MocapFrame(self.now_us - AGE_US, p, (1.0, 0.0, 0.0, 0.0), True), self.now_us)
            self.record.on_loop(self.session, self.now_us)

    def result(self, **how: Any) -> Result:
        result = self.record.close(**how)
        assert result is not None
        return result


def test_the_judged_part_lasts_from_trajectory_to_experiment_end(tmp_path: Path) -> None:
    bench = StationBench(tmp_path / "run", "yaw-step")
    bench.fly(1.0, (0.2, 0.0, 1.15))
    bench.plan.start(bench.now_us + 3_000)
    bench.fly(2.0)
    killed = load_log(tmp_path / "run")
    begun = np.argmax(killed.column("flight.free").to_numpy())
    assert release_of(killed.schema.metadata) == killed.column("t")[int(begun)].as_py()
    bench.fly(EXPERIMENTS["yaw-step"].duration_s - 2.0 + 0.05)  # the cameras see the past
    bench.fly(2.0, (0.3, 0.0, 1.15))
    result = bench.result(interrupted=True)
    assert result.outcome == "completed"
    assert result.metrics["flown"] == pytest.approx(EXPERIMENTS["yaw-step"].duration_s, abs=0.03)
    assert result.metrics["max_x"] == pytest.approx(0.0, abs=1e-9)
    log = load_log(tmp_path / "run")
    assert release_of(log.schema.metadata) == 1_003_000
    assert _flown_with(tmp_path / "run")[1:] == (False, 0.0), "the board's own clock is another"
    assert log.num_rows == pytest.approx(805, abs=2)
    (held,) = marks_of_flight(log).intervals
    assert (held.kind, held.begin_s, held.end_s) == (
        "held",
        pytest.approx(-1.0, abs=0.05),
        pytest.approx(0.0, abs=0.05),
    )
    bars = [bar.name for bar in figures.lanes_of_states(log).bars if bar.lane == "flight"]
    assert bars == ["not judged", "judged", "not judged"]


@pytest.mark.long
@pytest.mark.parametrize("comes_back", [True, False])
def test_time_without_poses_is_not_flown_and_fails_its_limit(tmp_path: Path, comes_back: bool) -> None:
    """A server that was killed in flight: turns go on, frames do not."""
    bench = StationBench(tmp_path / "run")
    bench.plan.start(bench.now_us)
    bench.fly(2.0)
    end_us = bench.now_us + 3_500_000
    while bench.now_us < end_us:
        bench.now_us += TURN_US
        bench.record.on_loop(bench.session, bench.now_us)
    if comes_back:
        bench.fly(1.0)
    result = bench.result()
    assert result.metrics["unseen"] == pytest.approx(3.5 + (0.04 if comes_back else 0.0), abs=0.06)
    assert result.metrics["flown"] == pytest.approx(3.0 if comes_back else 2.0, abs=0.1)
    assert "unseen" in {verdict.metric for verdict in result.failed}
    assert not result.passed


@pytest.mark.long
def test_a_comparison_shows_what_was_judged_and_a_second_around_it(tmp_path: Path) -> None:
    bench = StationBench(tmp_path / "run", "yaw-step")
    bench.fly(5.0)
    bench.plan.start(bench.now_us)
    bench.fly(20.0)
    bench.result()
    times = _judged(load_log(tmp_path / "run")).column("t").to_numpy()
    assert (times[0], times[-1]) == pytest.approx((4e6, 11e6), abs=60_000)


@pytest.mark.parametrize("axis", [(1.0, 0.0, 0.0), (0.0, -1.0, 0.0), (0.6, 0.8, 0.0)])
def test_a_robot_is_lost_by_its_tilt_about_any_axis_wherever_it_faces(axis: tuple[float, ...]) -> None:
    for beyond in (-0.01, 0.01):
        tilted = Rotation.from_rotvec((CONFIG.plant.limits.tilt + beyond) * np.array(axis))
        w, x, y, z = (Rotation.from_euler("z", 2.0) * tilted).as_quat(scalar_first=True).tolist()
        why = why_lost(MocapFrame(0, HOME.p_WG, (w, x, y, z), True), CONFIG)
        assert (why is not None) == (beyond > 0.0)


@pytest.mark.long
def test_a_robot_that_leaves_the_flow_is_lost_and_what_follows_is_not_judged(tmp_path: Path) -> None:
    bench = StationBench(tmp_path / "run")
    bench.plan.start(bench.now_us)
    bench.fly(1.0)
    bench.fly(0.2, (0.0, 0.46, 1.15))
    bench.fly(EXPERIMENTS["hover"].duration_s)
    result = bench.result()
    assert (result.outcome, result.cause) == ("lost", "left the flow: 0.46 m from the axis; up to 0.45 m")
    assert result.metrics["lost"] == 1.0
    assert result.metrics["flown"] == pytest.approx(1.0, abs=0.05)
    texts = [event["text"] for event in load_events(tmp_path / "run")]
    assert [text.partition(":")[0] for text in texts[-3:]] == [
        "lost", "hover is over; what follows is not judged", "the station ends",
    ]  # fmt: skip


def test_rows_keep_their_period_when_turns_are_late(tmp_path: Path) -> None:
    bench = StationBench(tmp_path / "run")
    for _ in range(100):
        bench.now_us += 7_000
        bench.record.on_loop(bench.session, bench.now_us)
    bench.record.close()
    times_us = load_log(tmp_path / "run").column("t").to_numpy()
    assert len(times_us) == 71
    assert set(np.diff(times_us // 10_000).tolist()) == {1}


@pytest.mark.parametrize(
    ("how", "outcome", "cause"),
    [
        ({"interrupted": True}, "interrupted", None),
        ({"failure": "udp://…: lost: silent for 2 s"}, "error", "udp://…: lost: silent for 2 s"),
        ({}, "completed", None),
    ],
)
def test_each_end_has_a_result(tmp_path: Path, how: dict[str, Any], outcome: str, cause: str | None) -> None:
    bench = StationBench(tmp_path / "run")
    bench.record.note("station", "connected")
    bench.plan.start(bench.now_us)
    bench.fly(2.0)
    bench.result(**how)
    read = read_result(tmp_path / "run")
    assert (read.outcome, read.cause, read.request.is_real) == (outcome, cause, True)
    assert read.metrics["flown"] == pytest.approx(2.0, abs=0.06)
    assert {verdict.metric for verdict in read.verdicts} == {*EXPERIMENTS["hover"].limits, *ALWAYS}
    texts = [(event["source"], event["text"]) for event in load_events(tmp_path / "run")]
    assert texts[:3] == [("station", "connected"), ("board", "supervisor: flying"), ("lab", "hover begins")]


def test_a_killed_station_loses_only_the_last_second(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(hil.pictures.figures, "PICTURES", PICTURES[:1])
    bench = StationBench(tmp_path / "run")
    bench.plan.start(bench.now_us)
    bench.fly(4.5)
    left = Path(shutil.copytree(tmp_path / "run", tmp_path / "left"))
    bench.result()
    log = load_log(left)
    assert log.column("t")[-1].as_py() >= 3_500_000
    assert read_result(left).metrics["flown"] == pytest.approx(4.0, abs=0.1)
    assert read_result(left).metrics["rms_x"] == pytest.approx(0.0, abs=1e-9)
    assert "ended before the flight did" in write_report(left).read_text(encoding="utf-8")


def test_a_flight_that_never_began_leaves_no_folder(tmp_path: Path) -> None:
    bench = StationBench(tmp_path / "run")
    bench.record.note("station", "no board")
    assert bench.record.close("no answer") is None
    assert not (tmp_path / "run").exists()


def test_a_real_flight_overwrites_nothing(tmp_path: Path) -> None:
    (tmp_path / "run").mkdir()
    StationBench(tmp_path / "run").record.close()
    (tmp_path / "other").mkdir()
    (tmp_path / "other" / "events.jsonl").write_text("{}")
    with pytest.raises(LabError, match="it exists and is not empty"):
        StationBench(tmp_path / "other")
    with pytest.raises(LabError, match="cannot be written"):
        StationBench(Path("/proc/floaty/run"))


def test_a_full_disk_ends_the_record_and_not_the_flight(tmp_path: Path) -> None:
    bench = StationBench(tmp_path / "run")
    bench.plan.start(bench.now_us)
    with small_files(150_000):
        bench.fly(5.0)
        assert 100 <= load_log(tmp_path / "run").num_rows < 500
    assert bench.records.notices() == [
        f"{tmp_path / 'run' / 'log.arrows'}: File too large; no more is written to it"
    ]
    result = bench.result()  # there is space again
    assert (result.outcome, result.cause) == ("error", "the log ends before the flight")
    assert not result.passed
    assert read_result(tmp_path / "run").metrics["lost"] == 0.0


def test_a_disk_that_stays_full_keeps_what_is_on_it_and_the_picture_goes_on(tmp_path: Path) -> None:
    bench = StationBench(tmp_path / "run")
    bench.plan.start(bench.now_us)
    with small_files(0):
        bench.fly(1.5)
        assert bench.record.close() is None
    assert {path.name for path in (tmp_path / "run").iterdir()} == {"events.jsonl", "log.arrows"}
    notices = bench.records.notices()
    assert sorted(line.split(": ")[0] for line in notices) == [
        str(tmp_path / "run" / name) for name in ("events.jsonl", "log.arrows")
    ]
    assert sum(batch.num_rows for batch in bench.observer.batches) > 140
    assert "hover begins" in [text for *_, text in bench.observer.notes]
    assert bench.records.incomplete


def test_the_station_s_records_have_the_time_of_the_log(both: tuple[Path, Path], tmp_path: Path) -> None:
    """A computer's clock has run for days when a flight begins, here for 7 s."""
    bench = StationBench(tmp_path / "run")
    shutil.copy(both[0] / "telemetry.csv", tmp_path / "run")
    bench.fly(1.0)
    assert bench.record.log_us == bench.now_us - 7_000_000
    bench.result()
    log = load_log(tmp_path / "run")
    ages, by_the_station = ages_in_time_of(iter([log]), tmp_path / "run"), reported_ages(tmp_path / "run")
    assert ages.num_rows > 100
    assert ages.column("t").to_pylist() == [
        t_us - 7_000_000 for t_us in by_the_station.column("t").to_pylist()
    ]
    old = log.replace_schema_metadata({})
    assert ages_in_time_of(iter([old]), tmp_path / "run").num_rows == 0


def test_a_counter_goes_on_where_it_wraps_and_after_a_reset_of_the_board() -> None:
    def counted(*samples: tuple[float, int]) -> list[float]:
        count = Unwrapped()
        return [count(*sample) for sample in samples]

    assert counted((65_530, 20), (65_535, 40), (4, 60), (4, 60), (10, 80)) == [0, 5, 10, 10, 16]
    assert counted((4, 2**24 - 10), (7, 10)) == [0, 3], "the clock wraps"
    assert counted((0, 5000), (6, 5020), (0, 20), (2, 40)) == [0, 6, 6, 8]
    assert counted((60_000, 600_000), (7, 9_000)) == [0, 7], "a reset while the link was cut"


def test_an_experiment_that_needs_the_laboratory_is_refused(tmp_path: Path) -> None:
    bench = StationBench(tmp_path / "run", "power")
    bench.plan.start(bench.now_us)
    bench.fly(1.0)
    result = bench.result()
    assert math.isnan(result.metrics["power"])
    assert not result.passed
    assert any("battery.power" in line for line in bench.said)
    assert json.loads((tmp_path / "run" / "result.json").read_text())["seed"] is None
