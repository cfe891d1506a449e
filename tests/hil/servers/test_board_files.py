"""What a server keeps of its boards over a restart."""

import shutil
from pathlib import Path

import pytest

from firmware_py.links.parameters import ParameterStorage
from firmware_py.wire.memories import CONFIG_SIZE, RadioSettings, encode_config
from hil.config import load_config
from hil.emulator.crazyflie.nrf51 import AirSettings
from hil.errors import LabError
from hil.servers.server import Server, Service


def serve(state: Path | None, number: int = 1) -> Server:
    return Server(Service(load_config(), number, state=state), lambda line: None)


@pytest.mark.long
def test_the_eeprom_of_each_board_is_kept_over_a_restart(tmp_path: Path) -> None:
    folder = tmp_path / "new" / "boards"
    servers = [serve(folder, number) for number in (1, 2)]
    one, two = (server.robot.board for server in servers)
    ParameterStorage(one.eeprom).store("supervisor.poseTimeout", (321).to_bytes(2, "little"))
    two.eeprom[8000:8003] = b"two"
    for server in servers:
        server.close()

    again = [serve(folder, number).robot for number in (1, 2)]
    for robot, before in zip(again, (one, two), strict=True):
        assert robot.board.eeprom == before.eeprom
    values = {parameter.name: parameter.read() for parameter in again[0].firmware.parameters}
    assert values["supervisor.poseTimeout"] == 321


def test_every_change_is_written_at_once(tmp_path: Path) -> None:
    server = serve(tmp_path)
    for end_us, data in ((30_000, b"new"), (60_000, b"two"), (90_000, b"new")):
        server.robot.board.eeprom[8000:8003] = data
        server.lab.end_at(end_us)
        server.lab.run()
        assert (tmp_path / "board-1.eeprom").read_bytes()[8000:8003] == data
    assert sorted(path.name for path in tmp_path.iterdir()) == ["board-1.eeprom"]
    again = serve(tmp_path)
    again.robot.board.eeprom[8000:8003] = b"aga"  # a change after a load
    again.close()
    assert (tmp_path / "board-1.eeprom").read_bytes()[8000:8003] == b"aga"


@pytest.mark.long
def test_without_a_folder_every_server_begins_with_new_boards() -> None:
    server = serve(None)
    server.robot.board.eeprom[8000:8003] = b"new"
    server.close()
    assert serve(None).robot.board.eeprom[8000:8003] == b"\xff" * 3


def test_an_invalid_memory_file_is_refused(tmp_path: Path) -> None:
    (tmp_path / "board-1.eeprom").write_bytes(b"short")
    with pytest.raises(LabError, match=r"board-1.eeprom: 5 bytes; this memory has 8192"):
        serve(tmp_path)


def test_a_memory_file_that_cannot_be_read_or_written_is_one_line(tmp_path: Path) -> None:
    folder = tmp_path / "boards"
    (folder / "board-1.eeprom").mkdir(parents=True)
    with pytest.raises(LabError, match=r"board-1.eeprom: Is a directory$"):
        serve(folder)
    served = serve(folder, 2).served
    served.keep()
    shutil.rmtree(folder)
    served.keep()  # nothing has changed
    served.robot.board.eeprom[8000:8003] = b"new"
    with pytest.raises(LabError, match=r"board-2.eeprom: No such file or directory$"):
        served.keep()


def test_the_radio_starts_as_a_valid_configuration_has_it_and_stays_otherwise() -> None:
    server = serve(None)
    served, eeprom = server.served, server.robot.board.eeprom
    factory = served.nrf51.settings
    assert served._settings_at_boot() == factory
    eeprom[:CONFIG_SIZE] = encode_config(RadioSettings(37, 1, 0x0102030405))
    assert served._settings_at_boot() == AirSettings(37, 1_000_000, bytes((1, 2, 3, 4, 5)))
    eeprom[:CONFIG_SIZE] = encode_config(RadioSettings(37, 3, 0x0102030405))  # there is no such rate
    assert served._settings_at_boot() == factory
    eeprom[3] ^= 1
    assert served._settings_at_boot() == factory
    assert served.battery_V == pytest.approx(server.robot.board.battery_mv / 1000)
    server.close()
