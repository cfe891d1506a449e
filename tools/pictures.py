"""Remake the documentation's pictures: python tools/pictures.py [NAME ...]; all of them without a name.

Each picture shows a new flight. Needs chromium for the report, rerun and Xvfb for the scenes, and a cfclient
(FLOATY_CFCLIENT names its Python) for its window; missing programs are reported, and their pictures stay unchanged. Exit
code 1: a picture could not be made.
"""

import os
import shutil
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory

from PIL import Image

ROOT = Path(__file__).parent.parent
DOCS = ROOT / "docs"
BIN = Path(sys.executable).parent
SERVED = "udp://127.0.0.1:19850"
CFCLIENT = os.environ.get("FLOATY_CFCLIENT", "")
# Opens cfclient's window off screen, connects it, and stores its picture.
WINDOW = """
import os, sys
sys.argv = ["cfclient"]
import cfclient.gui as gui
from PyQt6.QtCore import QTimer
from PyQt6.QtWidgets import QApplication
import cfclient.ui.main as main
show = main.MainUI.show
def shown(window):
    show(window)
    window.resize(1400, 900)
    QTimer.singleShot(2000, lambda: window.cf.open_link(os.environ["LINK"]))
    QTimer.singleShot(15000, lambda: (window.grab().save(os.environ["OUT"]), os._exit(0)))
main.MainUI.show = shown
gui.main()
"""


class MissingError(Exception):
    """A program needed for a picture is missing."""


def floaty(command: str) -> None:
    """Run a command of floaty; a failed limit is not an error here."""
    ran = subprocess.run([BIN / "floaty", *command.split()], stdout=subprocess.DEVNULL)
    if ran.returncode > 1:
        raise RuntimeError(f"floaty {command}: exit code {ran.returncode}")


def program(*names: str) -> str:
    """Return the first installed one of these programs."""
    for name in names:
        if found := shutil.which(name):
            return found
    raise MissingError(f"{' or '.join(names)} is not installed")


def scene(run: Path, at_s: float, out: Path) -> None:
    """Write the picture of rerun's viewer of a run at a time."""
    from hil.pictures.viewer.recording import ServedRecording

    recording = ServedRecording(run)
    # The mouse pointer is in the middle of the screen: below the window, where it highlights nothing.
    screen = [program("xvfb-run"), "-a", "-s", "-screen 0 3200x4400x24"]
    viewer = [str(BIN / "rerun"), recording.at(at_s), "--port", "0", "--screenshot-to", str(out)]
    command = [*screen, *viewer, "--window-size", "1600x1000"]
    subprocess.run(command, check=True, stderr=subprocess.DEVNULL, timeout=180)
    with Image.open(out) as picture:
        picture.convert("RGB").resize((1600, 1000), Image.Resampling.LANCZOS).save(out, optimize=True)


def hover(out: Path) -> None:
    floaty("fly hover --duration 6 --fault push.y@2=2 --out run")
    floaty("export run --gif")
    shutil.copy(Path("run") / "flight.gif", out)


def markers(out: Path) -> None:
    floaty("fly hover --duration 3 --set markers.enabled=true --fault marker.hidden@1=2 --out run")
    scene(Path("run"), 2.0, out)
    with Image.open(out) as picture:
        picture.crop((0, 64, 890, 736)).save(out, optimize=True)


def report(out: Path) -> None:
    floaty("fly hover --duration 6 --fault push.y@2=2 --fault mocap.dropout@4:0.6 --out run")
    page = (Path("run") / "report.html").resolve().as_uri()
    browser = program("chromium", "chromium-browser", "google-chrome")
    options = [
        "--headless",
        "--no-sandbox",
        "--hide-scrollbars",
        "--window-size=1000,2480",
        "--virtual-time-budget=8000",
    ]
    command = [browser, *options, f"--screenshot={out}", page]
    subprocess.run(command, check=True, stderr=subprocess.DEVNULL, timeout=120)


def latency(out: Path) -> None:
    floaty("study latency --out study")
    shutil.copy(next(Path("study").rglob("study-latency.png")), out)


def real_flight(out: Path) -> None:
    """Fly a served robot with the ground station of real flights, and show its recording."""
    with served():
        floaty(f"station --link {SERVED} --duration 10 --out run")
    scene(Path("run"), 4.0, out)


def cfclient(out: Path) -> None:
    if not CFCLIENT:
        raise MissingError("FLOATY_CFCLIENT does not name a Python with cfclient")
    with served("--station"):
        environment = {**os.environ, "QT_QPA_PLATFORM": "offscreen", "LINK": SERVED, "OUT": str(out)}
        subprocess.run(
            [CFCLIENT, "-c", WINDOW], env=environment, check=True, stderr=subprocess.DEVNULL, timeout=120
        )


@contextmanager
def served(*options: str) -> Iterator[None]:
    """Let `floaty serve` fly a robot while the block runs."""
    server = subprocess.Popen([BIN / "floaty", "serve", *options], stdout=subprocess.DEVNULL)
    try:
        time.sleep(5.0)  # until it listens
        yield
    finally:
        server.terminate()
        server.wait()


PICTURES: dict[str, Callable[[Path], None]] = {
    "hover.gif": hover,
    "markers.png": markers,
    "report.png": report,
    "latency-study.png": latency,
    "real-flight-rerun.png": real_flight,
    "cfclient.png": cfclient,
}


def main(names: list[str]) -> int:
    if unknown := set(names) - PICTURES.keys():
        print(
            f"pictures: {', '.join(sorted(unknown))}: unknown; there are {', '.join(PICTURES)}",
            file=sys.stderr,
        )
        return 2
    failed = False
    for name in names or PICTURES:
        with TemporaryDirectory() as folder:
            os.chdir(folder)
            new = Path(folder) / name
            try:
                PICTURES[name](new)
                shutil.copy(new, DOCS / name)
                print(f"{name}  made")
            except (MissingError, RuntimeError, OSError, subprocess.SubprocessError) as error:
                print(f"{name}  unchanged: {error}", file=sys.stderr)
                failed = True
            finally:
                os.chdir(ROOT)
    return int(failed)


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
