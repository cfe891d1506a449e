"""`python -m ground_station`: without the laboratory, and one line for what cannot be flown."""

import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from ground_station import __main__ as alone
from ground_station.program import Session

pytestmark = pytest.mark.usefixtures("own_signal_handlers")


@pytest.mark.long
def test_it_loads_nothing_of_the_laboratory() -> None:
    code = "import sys, ground_station.__main__; sys.exit(any(name.split('.')[0] == 'hil' for name in sys.modules))"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0


@pytest.mark.parametrize(
    ("settings", "arguments", "line"),
    [
        ("", ["--link", "nonsense"], "--link nonsense: expected radio://0/80/2M"),
        (
            "",
            ["--link", "udp://127.0.0.1:1", "--mocap", "replay:/nosuch"],
            "--mocap replay:/nosuch: /nosuch: No such file",
        ),
        ("[station]\ncorrections_hz = -1", ["--link", "udp://127.0.0.1:1"], "station.corrections_hz = -1: "),
        ("home = ", ["--link", "udp://127.0.0.1:1"], "Invalid value"),
    ],
)
def test_bad_input_is_one_line(
    settings: str, arguments: list[str], line: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "ground.toml"
    path.write_text(settings)
    assert alone.main([*arguments, "--settings", str(path)]) == 2
    shown = capsys.readouterr().err
    assert line in shown
    assert shown.count("\n") == 1


def test_settings_may_begin_with_the_mark_of_utf8_and_every_record_is_passed_on(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    flown: list[tuple[Any, ...]] = []
    monkeypatch.setattr(alone, "fly_with", lambda *asked: flown.append(asked) or ("", False))
    path = tmp_path / "ground.toml"
    path.write_text("home = [1, 2, 3]", encoding="utf-8-sig")
    options = [
        "--mocap",
        "vrpn:here",
        "--log",
        "telemetry.csv",
        "--record",
        "frames.csv",
        "--duration",
        "2.5",
    ]
    assert alone.main(["--link", "udp://127.0.0.1:1", "--settings", str(path), *options]) == 0
    ((_, settings, session, _, duration_s),) = flown
    assert (settings.home, duration_s, session.uri) == ((1.0, 2.0, 3.0), 2.5, "udp://127.0.0.1:1")
    assert (session.mocap, session.log, session.record) == (
        "vrpn:here", Path("telemetry.csv"), Path("frames.csv"),
    )  # fmt: skip


@pytest.mark.parametrize(
    ("failure", "incomplete", "code"), [("", False, 0), ("", True, 3), ("lost", True, 2)]
)
def test_the_exit_code_tells_of_failures_and_of_records_with_gaps(
    monkeypatch: pytest.MonkeyPatch, failure: str, incomplete: bool, code: int
) -> None:
    def flown(operator: object, settings: object, session: Session, *_: object) -> tuple[str, None]:
        if incomplete:
            session.records.write("log.csv", _fail)
        return failure, None

    monkeypatch.setattr(alone, "fly_with", flown)
    assert alone.main(["--link", "udp://127.0.0.1:1"]) == code


def _fail() -> None:
    raise OSError(28, "No space left on device")


def test_a_missing_file_of_settings_is_one_line(capsys: pytest.CaptureFixture[str]) -> None:
    assert alone.main(["--link", "udp://127.0.0.1:1", "--settings", "/nosuch.toml"]) == 2
    assert "/nosuch.toml" in capsys.readouterr().err
