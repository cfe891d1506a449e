"""Records a real flight, as seen by its ground station, in a run folder like that of a simulated one.

`log.parquet` has no truth; it has the cameras' poses (`cameras.*`, W and B), telemetry of estimate, controller and flaps,
link, tracker and ages. `flight.free` is 1 from the trajectory's start to the end of its experiment, or until the robot
leaves the flow: metrics and limits cover this time.
"""

import shutil
from collections.abc import Callable
from math import nan
from pathlib import Path

from firmware_py.elementary import cos
from firmware_py.wire.supervisor import State
from ground_station.clock import clock_us
from ground_station.mocap import MocapFrame
from ground_station.program import StationSession
from ground_station.records import Records
from ground_station.telemetry_log import TELEMETRY
from hil.config import LabConfig
from hil.errors import LabError, made_folder, require_empty
from hil.laboratory.bodies import make_body
from hil.laboratory.files.ages import STATION_START
from hil.laboratory.files.recorder import STREAM, Observer, Recorder, load_log
from hil.laboratory.files.result import (
    Outcome,
    Program,
    Result,
    judged,
    metadata_of,
    with_resets,
    write_result,
)
from hil.laboratory.files.station_channels import station_channels
from hil.laboratory.flight import RECORD_PERIOD_US
from hil.laboratory.metrics import check_limits, measure
from hil.laboratory.request import Request, why_left
from hil.laboratory.robot import Streams


class RealFlight:
    """Records one flight of `floaty station` into a new `folder`; the station's program calls `turn` in its loop.

    Without a folder nothing is stored, but observers get the rows. A write that fails ends its file by the rule of
    `records`. Raises `LabError` when the folder exists: a real flight cannot be repeated.
    """

    def __init__(
        self,
        folder: Path | None,
        request: Request,
        records: Records,
        say: Callable[[str], None],
        clock: Callable[[], int] = clock_us,
        observer: Observer | None = None,
    ) -> None:
        self._folder = folder
        self._observer = observer
        self._request = request
        self._experiment = request.experiment
        self._config = request.config
        check_limits(request.limits, request.experiment.metrics)
        self._program = Program.of(request.config)
        self._records = records
        self._say = say
        self._clock = clock
        self._start_us = clock()
        self._early: list[tuple[int, str, str]] = []  # notes from before the recorder started
        self._recorder: Recorder | None = None
        self._now_us = self._next_us = 0
        self._is_free = False  # metrics and limits cover the current row
        self._whole = False  # it was flown to its end
        body = make_body(request.config, Streams.of_seed(0).gusts, request.config.flight.home)
        self._look_of_robot = body.look
        self._lost: str | None = None
        self._stored: Result | None = None  # in the folder
        self._state: int | None = None  # the supervisor's
        if folder is not None:
            require_empty("--out", folder)
            made_folder("--out", folder)

    @property
    def telemetry(self) -> Path | None:
        """The path of the station's own record."""
        return None if self._folder is None else self._folder / TELEMETRY

    def note(self, source: str, text: str) -> None:
        """Add a line to the event log."""
        self._note(self._clock(), source, text)

    def _note(self, now_us: int, source: str, text: str) -> None:
        if self._recorder is None:
            self._early.append((now_us, source, text))
            return
        self._recorder.note(now_us - self._start_us, source, text)

    @property
    def log_us(self) -> int:
        """The current time by the log's clock."""
        return self._now_us - self._start_us

    def on_loop(self, session: StationSession, now_us: int) -> None:
        """Record a row when it is due."""
        if now_us < self._next_us:
            return
        if self._recorder is None:
            self._recorder = self._begin(session)
            for early in self._early:
                self._note(*early)
        self._now_us = now_us
        self._next_us = now_us - now_us % RECORD_PERIOD_US + RECORD_PERIOD_US
        self._look(session, now_us)
        self._recorder.row(now_us - self._start_us)

    def _begin(self, session: StationSession) -> Recorder:
        metadata = {
            **metadata_of(self._request, self._program, self._look_of_robot),
            STATION_START.decode(): str(self._start_us),
        }
        channels = station_channels(
            session, lambda: self._is_free, lambda: session.plan.at(self._now_us), self._start_us
        )
        return Recorder(self._folder, channels, metadata, self._observer, self._records)

    def _look(self, session: StationSession, now_us: int) -> None:
        """Note the board's state, the trajectory's begin and end, and a loss."""
        state = session.link.supervisor_state
        if state != self._state and state is not None:
            self._state = state
            self._note(now_us, "board", f"supervisor: {State(state).name.lower()}")
        recorder, frame, start_us = self._recorder, session.ground.frame, session.plan.start_us
        if recorder is None or start_us is None or now_us < start_us:
            return
        if recorder.release_us is None:
            recorder.released(start_us - self._start_us)
            self._note(now_us, "lab", f"{self._experiment.name} begins")
        if not self._whole and now_us - start_us >= 1e6 * self._experiment.duration_s:
            self._whole = True
            self._note(now_us, "lab", f"{self._experiment.name} is over; what follows is not judged")
        self._is_free = not self._whole and self._lost is None
        if self._is_free and frame is not None:
            self._lost = why_lost(frame, self._config)
            if self._lost is not None:
                self._note(now_us, "lab", f"lost: {self._lost}; what follows is not judged")

    def close(self, failure: str = "", interrupted: bool = False) -> Result | None:
        """Finish the log and write `result.json`; None for a flight that never began or is not stored.

        A flight that never began leaves no folder. `failure` is why the station gave up.
        """
        if self._recorder is not None:
            self.note("lab", failure or ("interrupted by the user" if interrupted else "the station ends"))
            try:
                self._records.attempt(self._folder, self._finish, failure, interrupted)
            except LabError:
                if not self._ends_early:
                    raise  # else not even the log's head was stored
        elif self._folder is not None:
            shutil.rmtree(self._folder)
        return self._stored

    @property
    def _ends_early(self) -> bool:
        """Whether rows are missing at the log's end."""
        return self._folder is not None and self._records.failed(self._folder / STREAM)

    def _finish(self, failure: str, interrupted: bool) -> None:
        """Finish the files; raises `OSError`, with the log as it is on disk."""
        assert self._recorder is not None
        digest = self._recorder.close()
        if self._folder is not None:
            result = self._result(self._folder, digest, failure, interrupted)
            write_result(result)
            self._stored = result

    def _result(self, folder: Path, digest: str, failure: str, interrupted: bool) -> Result:
        """Return the result, from the log."""
        log = load_log(folder)
        lost = self._lost is not None
        try:
            metrics = self._experiment.metrics_of(log, lost)
        except LabError as error:  # only a laboratory measures it
            metrics = measure(log, lost) | dict.fromkeys(self._experiment.metrics, nan)
            self._say(f"{self._experiment.name}: its own metrics need {error}, which a real flight lacks")
        cut_short: Outcome = "error" if failure else "interrupted" if interrupted else "completed"
        outcome: Outcome = "lost" if self._lost else "completed" if self._whole else cut_short
        if self._ends_early:
            outcome, failure = "error", "; ".join(filter(None, (failure, "the log ends before the flight")))
        ended = with_resets(outcome, self._lost or failure or None, metrics["resets"])
        return judged(self._request, self._program, ended, metrics, log, digest, folder)


def why_lost(frame: MocapFrame, config: LabConfig) -> str | None:
    """Return why a flight is over at a pose, by the laboratory's limits; None while it is not."""
    if why := why_left(config, frame.p_WB):
        return f"left the flow: {why}"
    _, qx, qy, _ = frame.q_WB
    tilt = config.plant.limits.tilt
    upright = 1.0 - 2.0 * (qx * qx + qy * qy)  # cosine of the tilt
    return f"tumbled: tilted beyond {tilt:.2f} rad" if upright < cos(tilt) else None
