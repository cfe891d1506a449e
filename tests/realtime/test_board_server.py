"""`floaty serve` and unmodified cflib: by radio with and without losses, by UDP, in this and in other processes."""

import gc
import os
import signal
import subprocess
import sys
import threading
import time
import warnings
from collections.abc import Iterator
from contextlib import closing
from itertools import pairwise
from pathlib import Path
from statistics import median

import cflib.crtp
import pytest
from cflib.bootloader import Bootloader
from cflib.utils.power_switch import PowerSwitch

from hil.servers.dongle_plugin import VARIABLE, Backend, SimulatedClock
from support.cflib_client import CflibClient
from support.plugged_dongle import plug
from support.serving import PATIENCE_S, Served, serve


@pytest.fixture(scope="module")
def cache(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("toc")


@pytest.fixture(scope="module")
def served() -> Iterator[Served]:
    """A board whose radio loses every tenth packet in either direction; UDP loses none."""
    losses = ("--set=radio.uplink_loss=0.1", "--set=radio.downlink_loss=0.1")
    with serve("--radio", "--radio-port", "0", "--udp", "0", *losses) as served:
        plug(served)
        yield served


@pytest.fixture(params=["radio", "udp"])
def client(request: pytest.FixtureRequest, served: Served, cache: Path) -> Iterator[CflibClient]:
    with CflibClient(getattr(served, f"{request.param}_uris")[0], cache) as client:
        yield client


def test_scanning_finds_the_board(served: Served) -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", ResourceWarning)  # cflib leaves sockets of its UDP scan open
        found = cflib.crtp.scan_interfaces()
        gc.collect()
    assert ["radio://0/80/2M", ""] in found


def test_both_tables_are_complete_with_ranges_defaults_and_storage(client: CflibClient) -> None:
    assert client.cf.platform.get_protocol_version() == 12
    param = client.cf.param
    names = {f"{group}.{name}" for group, values in param.values.items() for name in values}
    assert names == {f"{group}.{name}" for group, values in param.toc.toc.items() for name in values}
    assert param.get_value("system.selftestPassed") == "1"
    assert client.cf.log.toc.get_element_by_complete_name("stateEstimate.x").ctype == "float"
    assert param.toc.get_element_by_complete_name("sound.effect").is_persistent()

    assert client.set("extCtrl.z_P", 2.5) == 2.5
    assert client.set("extCtrl.z_P", 99) == 2.5  # outside its range
    assert client.answer(param.get_default_value, "extCtrl.z_P") == ("extCtrl.z_P", 3.0)
    assert client.answer(param.get_default_value, "cpu.flash") == ("cpu.flash", None)
    assert client.set("extCtrl.z_P", 3.0) == 3.0
    name, state = client.answer(param.persistent_get_state, "extCtrl.z_P")
    assert (name, state.is_stored, state.default_value, state.stored_value) == (
        "extCtrl.z_P",
        False,
        3.0,
        None,
    )
    for order, done in (
        (param.persistent_store, True),
        (param.persistent_clear, True),
        (param.persistent_clear, False),
    ):
        assert client.answer(order, "sound.effect") == ("sound.effect", done)


def test_a_log_block_has_the_boards_values_at_its_rate(client: CflibClient) -> None:
    rows = client.rows(100, 10, "stateEstimate.x", "pm.vbat", "acc.z")
    assert [later[0] - earlier[0] for earlier, later in pairwise(rows)] == [10] * 99
    assert all(3.6 < values["pm.vbat"] < 4.2 for _, values in rows)
    assert median(values["acc.z"] for _, values in rows) == pytest.approx(1.0, abs=0.2)


def test_a_power_cycle_is_noticed_and_stored_parameters_come_back(served: Served, cache: Path) -> None:
    with CflibClient(served.udp_uris[0], cache) as client:
        client.set("extCtrl.vz_P", 0.75)
        client.set("extCtrl.yaw_P", 0.75)
        assert client.answer(client.cf.param.persistent_store, "extCtrl.vz_P") == ("extCtrl.vz_P", True)
        with closing(PowerSwitch(served.radio_uris[0])) as switch:
            switch.stm_power_down()
            try:
                assert client.gone.wait(PATIENCE_S)
            finally:
                switch.stm_power_up()
    with CflibClient(served.radio_uris[0], cache) as again:
        assert again.cf.param.get_value("extCtrl.vz_P") == "0.75"
        assert float(again.cf.param.get_value("extCtrl.yaw_P")) == pytest.approx(1.2)
        assert again.answer(again.cf.param.persistent_clear, "extCtrl.vz_P") == ("extCtrl.vz_P", True)


def test_a_board_off_or_in_its_bootloader_gets_its_button_pressed(served: Served, cache: Path) -> None:
    tool = Bootloader(served.radio_uris[0])
    with closing(PowerSwitch(served.radio_uris[0])) as switch:
        for leave in (lambda: tool.start_bootloader(warm_boot=True), switch.platform_power_down):
            served.forget()
            with closing(tool):
                leave()
            served.wait_for("board 1: power button pressed", PATIENCE_S)
            served.wait_for("gyro zero", PATIENCE_S)
    CflibClient(served.radio_uris[0], cache).ready().close()


def test_a_program_in_another_process_needs_only_the_printed_line(served: Served) -> None:
    program = "import cflib.crtp as c; c.init_drivers(); print(c.get_interfaces_status()['radio'])"
    shown = subprocess.run(
        [sys.executable, "-c", program],
        env=served.environment,
        capture_output=True,
        text=True,
        timeout=60,
        check=True,
    )
    assert shown.stdout == "Crazyradio version 5.4\n"


def test_the_pytest_plugin_does_the_same(served: Served, tmp_path: Path) -> None:
    (tmp_path / "test_it.py").write_text(
        "from cflib.drivers.crazyradio import get_serials\ndef test_it(): assert get_serials() == ('F10A7Y0001',)\n"
    )
    environment = {**served.environment, "PYTHONPATH": ""}
    command = [sys.executable, "-m", "pytest", "-q", "-p", "hil.servers.dongle_plugin", str(tmp_path)]
    shown = subprocess.run(command, env=environment, cwd=tmp_path, capture_output=True, text=True, timeout=60)
    assert shown.returncode == 0, shown.stdout


def test_without_a_server_there_is_no_dongle() -> None:
    assert list(Backend("127.0.0.1:9").enumerate_devices()) == []


def test_four_boards_on_one_dongle(cache: Path) -> None:
    with serve("--radio", "--radio-port", "0", "--boards", "4") as served:
        plug(served)
        CflibClient(served.radio_uris[0], cache).ready().close()  # fills the cache
        clients = [CflibClient(uri, cache) for uri in served.radio_uris]
        assert len(clients) == 4
        for client in clients:
            client.ready()
        for client in clients:
            assert len(client.rows(10, 20, "stateEstimate.z", "pm.vbat")) == 10
        closing = [threading.Thread(target=client.close) for client in clients]
        for thread in closing:
            thread.start()
        for thread in closing:
            thread.join(PATIENCE_S)
        assert all(client.gone.is_set() for client in clients)


def test_a_program_sleeps_as_much_longer_as_simulated_time_stands_still(served: Served) -> None:
    slept: list[float] = []

    def sleep(duration_s: float) -> None:
        slept.append(duration_s)
        if len(slept) == 1:
            os.kill(served.process.pid, signal.SIGSTOP)
            time.sleep(0.4)
            os.kill(served.process.pid, signal.SIGCONT)

    host, _, port = served.environment[VARIABLE].rpartition(":")
    with closing(SimulatedClock((host, int(port)), sleep)) as clock:
        clock.sleep(0.5)
    assert slept[0] == 0.5
    assert sum(slept[1:]) >= 0.3
    SimulatedClock((host, 1), slept.append).sleep(0.7)
    assert slept[-1] == 0.7  # no server: the wall clock
