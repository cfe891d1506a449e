"""Programs that open the virtual Crazyradio by libusb, under umockdev: one in C++, and Bitcraze's cflib2, which is Rust."""

import importlib.util
import shutil
import subprocess
import sys
import time
from pathlib import Path

import pytest

from hil.servers import usb_dongle
from support.serving import FLOATY, PATIENCE_S, serve
from support.watcher import watched

SOURCE = Path(__file__).parent.parent / "support" / "usb_radio.cpp"
pytestmark = pytest.mark.skipif(
    bool(usb_dongle.why_not()), reason=f"no program saw a USB dongle: {usb_dongle.why_not()}"
)
FLY_BY_CFLIB2 = """
import asyncio, os
from cflib2 import Crazyflie, LinkContext

async def fly():
    context = LinkContext()
    (uri,) = await context.scan([0xE7] * 5)
    crazyflie = await Crazyflie.connect_from_uri(context, uri)
    parameters = crazyflie.param()
    await parameters.set("extPose.absolute", 1)
    assert await parameters.get("extPose.absolute") == 1
    block = await crazyflie.log().create_block()
    await block.add_variable("stateEstimate.z")
    stream = await block.start(100)
    await crazyflie.high_level_commander().take_off(1.2, None, 1.0, None)
    heights = [(await stream.next()).data["stateEstimate.z"] for _ in range(40)]
    assert abs(heights[-1] - 1.2) < 0.1, heights
    print("flew", uri, flush=True)
    os._exit(0)  # the package's threads outlive Python's

asyncio.run(fly())
"""


@pytest.fixture(scope="module")
def program(tmp_path_factory: pytest.TempPathFactory) -> Path:
    made = tmp_path_factory.mktemp("usb") / "radio"
    if shutil.which("g++") is None or not Path("/usr/include/libusb-1.0/libusb.h").exists():
        pytest.skip("g++ or libusb-1.0-0-dev is not installed: no C++ program saw a USB dongle")
    subprocess.run(["g++", "-o", made, SOURCE, "-lusb-1.0"], check=True)
    return made


def test_a_program_in_cpp_reaches_the_robot_that_its_address_names(program: Path) -> None:
    with serve("--boards", "2", "--usb", "--radio-port", "0") as served:
        command = served.line("usb ")[:-1]
        for address, answers in (("E7", 200), ("02", 200), ("99", 0)):
            done = subprocess.run(
                [*command, program, address], capture_output=True, text=True, timeout=PATIENCE_S
            )
            assert done.stdout == f"serial F10A7Y0001\n{answers} answers; then LIBUSB_ERROR_TIMEOUT\n", (
                done.stderr
            )
            assert done.returncode == 0


def test_a_program_in_cpp_flies_the_robot_that_its_address_names(program: Path) -> None:
    """A take-off to 1.5 m moves the second robot's goal, and not the first one's."""
    flying = ("--boards", "2", "--station", "poses", "--usb", "--radio-port", "0")
    with serve(*flying, motive=True) as served:
        command = served.line("usb ")[:-1]
        served.wait_for("board 2: released", PATIENCE_S)
        with watched(served, ("floaty", "floaty2")) as (first, second):
            subprocess.run([*command, program, "02", "1.5"], check=True, timeout=PATIENCE_S)
            deadline_s = time.monotonic() + PATIENCE_S
            while not (second.frames and second.frames[-1][1].p_WB[2] > 1.4):
                assert time.monotonic() < deadline_s
                time.sleep(0.1)
        assert first.frames[-1][1].p_WB[2] < 1.3


def test_a_server_ends_with_its_program_and_has_its_exit_code(program: Path) -> None:
    end = ["--no-motive", "--radio-port", "0", "--usb", "--"]
    done = subprocess.run(
        [*FLOATY, "serve", *end, program, "E7"], capture_output=True, text=True, timeout=PATIENCE_S
    )
    assert done.returncode == 0, done.stderr
    assert "200 answers" in done.stdout
    failing = [*end, sys.executable, "-c", "import os; os.kill(os.getpid(), 9)"]
    assert (
        subprocess.run([*FLOATY, "serve", *failing], capture_output=True, timeout=PATIENCE_S).returncode
        == 137
    )


@pytest.mark.skipif(
    importlib.util.find_spec("cflib2") is None, reason="cflib2 is not installed: it flew nothing"
)
def test_cflib2_scans_connects_logs_sets_and_flies() -> None:
    flying = ["--no-motive", "--station", "poses", "--radio-port", "0", "--usb", "--"]
    done = subprocess.run(
        [*FLOATY, "serve", *flying, sys.executable, "-c", FLY_BY_CFLIB2], capture_output=True, text=True,
        timeout=PATIENCE_S,
    )  # fmt: skip
    assert "flew radio://0/80/2M/E7E7E7E7E7" in done.stdout, done.stdout + done.stderr
    assert done.returncode == 0


def test_a_server_that_is_not_there_is_refused_in_one_line() -> None:
    done = subprocess.run(
        [sys.executable, "-m", "hil.servers.usb_dongle", "127.0.0.1:1", "true"], capture_output=True, text=True,
        timeout=PATIENCE_S,
    )  # fmt: skip
    assert (done.returncode, done.stderr.count("\n")) == (2, 1)
    assert "no `floaty serve --radio` there" in done.stderr
