"""`floaty station --out` and `floaty param` against served robots: what is typed, what is flown, what is left on disk."""

import json
import os
import pty
import subprocess
import time
from pathlib import Path

import pytest

from hil.laboratory.files.recorder import load_events, load_log
from support.serving import FLOATY, PATIENCE_S, Served, serve, station

ENDS: dict[str, tuple[str, ...]] = {
    "radio": ("--radio", "--radio-port", "0"),
    "udp": ("--udp", "0"),
    "mavlink": ("--mavlink", "pty"),
}
GAIN = {"radio": "extCtrl.z_P", "udp": "extCtrl.z_P", "mavlink": "EXT_Z_P"}


def link_of(lab: Served, end: str) -> str:
    """The URI for a program that is to reach the board."""
    return f"mavlink:{lab.line('mavlink ')[0]}" if end == "mavlink" else lab.line(f"{end} ")[0]


def wait_for_event(folder: Path, text: str) -> None:
    """Wait until the record of a flight has it."""
    deadline = time.monotonic() + PATIENCE_S
    while not any(event["text"] == text for event in load_events(folder)):
        assert time.monotonic() < deadline
        time.sleep(0.05)


@pytest.mark.parametrize("end", ENDS)
def test_a_dialogue_flies_and_every_change_is_an_event(end: str, tmp_path: Path) -> None:
    folder, gain = tmp_path / "run", GAIN[end]
    with serve(*ENDS[end], motive=True) as lab, station(lab, link_of(lab, end), "--out", folder) as typed:
        typed.wait_for("^connected", PATIENCE_S)
        wait_for_event(folder, "hover begins")
        for line, answer in (
            ("goal 0.02 0 1.17 10", "^goal 0.02 0 1.17 m, yaw 10 deg"),
            ("set controller.gain_z 2.5", rf"^set controller.gain_z 2.5, was .* \({gain} 2.5\)"),
            ("set controller.gain_z 1e9", "refused, it stays 2.5"),
            ("get controller.gain_z", "^controller.gain_z 2.5"),
            ("fly hover", "^fly hover"),
            ("gaol 1", "did you mean goal"),
            ("mark here it's calm", "^mark here it's calm"),
            ("reset", f"^reset {gain} "),
            ("stop", "^stopped"),
            ("arm", "^arm: the board refuses"),  # until it has rebooted
        ):
            typed.type(line)
            typed.wait_for(answer, PATIENCE_S)
            if line == "stop":
                wait_for_event(folder, "supervisor: failsafe")
        assert typed.interrupt() in (0, 1, 130)
    operated = [event["text"].split(",")[0] for event in load_events(folder) if event["source"] == "operator"]
    kinds = [text.split()[0] for text in operated]
    assert kinds == ["goal", "set", "fly", "mark", "reset", "stop", "stopped"]
    log = load_log(folder)
    assert max(log.column("goal.z").to_pylist()) == pytest.approx(1.17)
    assert {2, 3} <= set(log.column("supervisor.state").to_pylist())
    files = {path.name for path in folder.iterdir()}
    assert files == {
        "log.parquet", "events.jsonl", "telemetry.csv", "result.json", "report.html", "flight.rrd",
    }  # fmt: skip
    result = json.loads((folder / "result.json").read_text())
    assert (result["experiment"], result["seed"], result["board"]) == ("hover", None, "real")
    assert result["metrics"]["flown"] > 0.0


def test_parameters_are_set_and_saved_without_flying() -> None:
    for end in ("udp", "mavlink"):
        with serve(*ENDS[end]) as lab:
            uri, environment = link_of(lab, end), lab.environment

            def param(*arguments: str) -> subprocess.CompletedProcess[str]:
                command = [*FLOATY, "param", *arguments, "--link", uri]  # noqa: B023 - used at once
                return subprocess.run(command, capture_output=True, text=True, timeout=60, env=environment)  # noqa: B023

            assert param("set", "controller.gain_z=2.5").stdout == "controller.gain_z 2.5\n"
            assert (
                param("get", GAIN[end], "controller.gain_z").stdout
                == f"{GAIN[end]} 2.5\ncontroller.gain_z 2.5\n"
            )
            if end == "mavlink":
                continue
            assert param("save").stdout == "saved\n"
            listed = param("list", GAIN[end].partition("_")[0].partition(".")[0]).stdout.splitlines()
            assert f"{GAIN[end]} 2.5" in listed
            assert all(line.startswith("extCtrl.") for line in listed)
            refused = param("set", "controller.gain_z=1e9")
            assert refused.returncode == 2
            assert refused.stderr.startswith("floaty: ")
            assert refused.stderr.count("\n") == 1


def test_at_a_terminal_lines_are_edited_and_ctrl_c_ends_the_flight(tmp_path: Path) -> None:
    """Tab completes, the answer stands above the prompt, and the terminal is given back as it was."""
    with serve("--udp", "0", motive=True) as lab:
        uri, environment = lab.udp_uris[0], lab.environment
        master, slave = pty.openpty()
        before = subprocess.run(
            ["stty", "-a"], stdin=slave, capture_output=True, text=True, check=True
        ).stdout
        command = [*FLOATY, "station", "--link", uri, "--mocap", lab.motive]
        environment |= {"TERM": "xterm"}
        process = subprocess.Popen(
            command, stdin=slave, stdout=slave, stderr=slave, env=environment, start_new_session=True,
            preexec_fn=lambda: _own(slave),
        )  # fmt: skip
        shown = b""

        def until(text: bytes) -> None:
            nonlocal shown
            deadline = time.monotonic() + PATIENCE_S
            while text not in shown:
                assert time.monotonic() < deadline, shown
                shown += os.read(master, 65536)

        try:
            until(b"connected")
            until(b">")
            os.write(master, b"markk\x7f it\r")  # a backspace on the way
            until(b"mark it\r\n")
            os.write(master, b"get controller.gain_y\r")
            until(b"(extCtrl.y_P")
            os.write(master, b"\x03")
            assert process.wait(timeout=30) == 0
        finally:
            process.kill()
            process.wait()
            after = subprocess.run(
                ["stty", "-a"], stdin=slave, capture_output=True, text=True, check=True
            ).stdout
            os.close(master)
            os.close(slave)
    assert after == before


def _own(terminal: int) -> None:
    """Make a terminal the one of this process, as a shell does."""
    import fcntl
    import termios

    fcntl.ioctl(terminal, termios.TIOCSCTTY, 0)
