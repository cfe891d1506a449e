"""Unmodified cflib against a board over udp: everything that a client does from connecting to losing the board.

The board runs in a thread of its own, paced to the wall clock. Every wait is for an event and has an end.
"""

import logging
import struct
import threading
import time
from collections.abc import Iterator
from pathlib import Path

import cflib.crtp
import numpy as np
import pytest
from cflib.crazyflie.mem import MemoryElement
from cflib.crtp.crtpstack import CRTPPacket, CRTPPort
from cflib.utils.encoding import compress_quaternion

from firmware_py.wire.supervisor import State
from support.cflib_client import CflibClient
from support.udp_pump import UdpBoard

PATIENCE_S = 20.0


@pytest.fixture(scope="module")
def board() -> Iterator[UdpBoard]:
    logging.getLogger("cflib").setLevel(logging.ERROR)
    cflib.crtp.init_drivers()
    board = UdpBoard()
    yield board
    board.close()


class Session(CflibClient):
    """A connection of cflib's over UDP."""

    patience_s = PATIENCE_S


@pytest.fixture(scope="module")
def cache(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("toc")


@pytest.fixture(scope="module")
def session(board: UdpBoard, cache: Path) -> Iterator[Session]:
    session = Session(board.uri, cache).ready()
    yield session
    session.close()


def test_both_tables_are_complete(session: Session) -> None:
    assert session.cf.platform.get_protocol_version() == 12
    names = {f"{group}.{name}" for group, values in session.cf.param.values.items() for name in values}
    table = {f"{group}.{name}" for group, values in session.cf.param.toc.toc.items() for name in values}
    assert names == table
    assert session.cf.param.get_value("system.selftestPassed") == "1"
    assert session.cf.log.toc.get_element_by_complete_name("stateEstimate.x").ctype == "float"
    assert session.cf.param.toc.get_element_by_complete_name("sound.effect").is_persistent()


def test_log_block_comes_at_a_hundred_hertz_with_the_boards_values(board: UdpBoard, session: Session) -> None:
    rows = session.rows(100, 10, "pm.vbat", "motor.m1", "motor.m2", "supervisor.state", "acc.z")
    assert set(np.diff([stamp for stamp, _ in rows])) == {10}
    counts = board.firmware.signals.count
    for _, values in rows:
        assert values["pm.vbat"] == pytest.approx(3.9)
        assert (values["motor.m1"], values["motor.m2"]) == (counts[0], counts[1])
        assert values["acc.z"] == pytest.approx(1.0, abs=0.2)


def test_parameter_is_set_on_the_running_core_and_refused_outside_its_range(
    board: UdpBoard, session: Session
) -> None:
    core = board.firmware._core.parameters.fields
    assert session.set("extCtrl.z_P", 2.5) == 2.5 == core.gain_z
    assert session.set("extCtrl.z_P", 99) == 2.5 == core.gain_z
    assert session.cf.param.get_value("extCtrl.z_P") == "2.5"
    assert session.set("motorShifts.m1", -3599) == -3599 == core.trim[0]
    assert session.set("motorShifts.m1", -3600) == -3600


def test_defaults_and_states_of_parameters(session: Session) -> None:
    assert session.answer(session.cf.param.get_default_value, "extCtrl.z_P") == ("extCtrl.z_P", 3.0)
    assert session.answer(session.cf.param.get_default_value, "cpu.flash") == ("cpu.flash", None)
    name, state = session.answer(session.cf.param.persistent_get_state, "extCtrl.z_P")
    assert (name, state.is_stored, state.default_value, state.stored_value) == (
        "extCtrl.z_P",
        False,
        3.0,
        None,
    )
    assert session.answer(session.cf.param.persistent_store, "sound.effect") == ("sound.effect", True)
    assert session.answer(session.cf.param.persistent_clear, "sound.effect") == ("sound.effect", True)
    assert session.answer(session.cf.param.persistent_clear, "sound.effect") == ("sound.effect", False)


@pytest.mark.parametrize("way", ["extpose", "packed"])
def test_poses_sent_either_way_are_flown(session: Session, way: str) -> None:
    goal = (0.01, -0.02, 0.03) if way == "extpose" else (-0.01, 0.02, -0.03)
    stop = threading.Event()

    def send() -> None:
        while not stop.wait(0.02):
            if way == "extpose":
                session.cf.extpos.send_extpose(*goal, 0, 0, 0, 1)
            else:
                packet = CRTPPacket()
                packet.set_header(CRTPPort.LOCALIZATION, 1)
                x, y, z = (round(1000 * value) for value in goal)
                packet.data = struct.pack("<BBhhhI", 9, 0xE7, x, y, z, compress_quaternion((0, 0, 0, 1)))
                session.cf.send_packet(packet)

    sender = threading.Thread(target=send)
    sender.start()
    try:
        names = ("stateEstimate.x", "stateEstimate.y", "stateEstimate.z", "supervisor.state")
        _, last = session.rows(80, 10, *names)[-1]
    finally:
        stop.set()
        sender.join()
    assert [last[name] for name in names[:3]] == pytest.approx(goal, abs=5e-3)
    assert last["supervisor.state"] == State.FLYING


def test_position_alone_arrives(session: Session) -> None:
    session.cf.extpos.send_extpos(0.5, 0.25, -0.125)
    _, values = session.rows(3, 10, "locSrv.x", "locSrv.y", "locSrv.z")[-1]
    assert list(values.values()) == [0.5, 0.25, -0.125]


def test_stop_and_recovery(session: Session) -> None:
    session.cf.param.set_value("floaty.stop", 1)
    assert session.rows(5, 10, "supervisor.cause")[-1][1]["supervisor.cause"] == 3
    session.cf.supervisor.send_crash_recovery_request()
    assert session.rows(5, 10, "supervisor.cause")[-1][1]["supervisor.cause"] != 3
    assert session.cf.supervisor.is_armed


def test_application_channel_echoes(session: Session) -> None:
    data = bytes(range(30))
    heard = threading.Event()
    got: list[bytes] = []

    def received(packet: bytes) -> None:
        got.append(bytes(packet))
        heard.set()

    session.cf.appchannel.packet_received.add_callback(received)
    session.cf.appchannel.send_packet(data)
    assert heard.wait(PATIENCE_S)
    assert got == [data]


def test_console_speaks(board: UdpBoard, session: Session) -> None:
    assert "supervisor: flying\n" in session.console
    assert "supervisor: failsafe, emergency stop\n" in session.console
    assert set(session.console.splitlines()) <= set(board.console)


def test_memories_are_read_and_written(session: Session) -> None:
    (eeprom,) = session.cf.mem.get_mems(MemoryElement.TYPE_I2C)
    session.answer(eeprom.update)
    assert eeprom.valid
    assert eeprom.elements["radio_address"] == 0xE7E7E7E7E7
    eeprom.elements["pitch_trim"] = 0.25
    session.answer(eeprom.write_data)
    eeprom.elements.clear()
    session.answer(eeprom.update)
    assert (eeprom.valid, eeprom.elements["pitch_trim"]) == (True, 0.25)
    (deck,) = session.cf.mem.get_mems(MemoryElement.TYPE_1W)
    assert (deck.valid, deck.elements["Board name"]) == (True, "bcFloaty")
    (tester,) = session.cf.mem.get_mems(MemoryElement.TYPE_MEMORY_TESTER)
    session.answer(tester.read_data, 5, 1000)
    assert tester.readValidationSuccess
    session.answer(tester.write_data, 5, 1000)
    assert session.rows(2, 10, "memTst.errCntW")[-1][1]["memTst.errCntW"] == 0


def test_power_cycle_is_noticed_and_stored_parameters_come_back(board: UdpBoard, cache: Path) -> None:
    first = Session(board.uri, cache).ready()  # the newest client wins
    assert first.set("extCtrl.vz_P", 0.75) == 0.75
    assert first.set("extCtrl.yaw_P", 0.75) == 0.75
    assert first.answer(first.cf.param.persistent_store, "extCtrl.vz_P") == ("extCtrl.vz_P", True)
    board.power_off()
    assert first.gone.wait(PATIENCE_S)
    first.close()  # so that nothing of it answers in place of the second
    board.power_on()
    begin = time.monotonic()
    second = Session(board.uri, cache).ready()
    assert time.monotonic() - begin < PATIENCE_S / 2
    assert second.cf.param.get_value("extCtrl.vz_P") == "0.75"
    assert second.cf.param.get_value("extCtrl.yaw_P") == pytest.approx("1.2000000476837158")
    assert second.answer(second.cf.param.persistent_clear, "extCtrl.vz_P") == ("extCtrl.vz_P", True)
    second.close()
