"""`python -m ground_station`: without the laboratory, and one line for what cannot be flown."""

import subprocess
import sys
from pathlib import Path

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
