"""Every robot's EEPROM holds its own configuration block, and boards count up from the first address."""

import pytest

from firmware_py.wire.memories import CONFIG_SIZE, decode_config
from hil.board.eeprom import factory_config
from hil.board.pins import VirtualBoard
from hil.config import load_config
from hil.emulator.crazyflie.config import RadioConfig
from hil.errors import LabError
from hil.laboratory.experiments import EXPERIMENTS
from hil.laboratory.lockstep import lockstep_flight
from hil.laboratory.request import Request
from hil.servers.server import Server, Service

RATES = ("250K", "1M", "2M")


ADDRESSES = [
    ("", 1, "E7E7E7E7E7"), ("", 2, "E7E7E7E702"), ("", 16, "E7E7E7E710"), ("E7E7E7E700", 1, "E7E7E7E700"),
    ("e7e7e7e700", 4, "E7E7E7E703"), ("E7E7E7E7FF", 2, "E7E7E7E800"), ("FFE7E7E7D7", 16, "FFE7E7E7E6"),
]  # fmt: skip


def test_a_block_has_the_radio_of_the_profile_and_the_address_of_its_board() -> None:
    for first, number, own in ADDRESSES:
        for channel, rate in ((37, 250_000), (2, 1_000_000), (125, 2_000_000)):
            radio = RadioConfig(address=first, channel=channel, bits_per_second=rate)
            read = decode_config(factory_config(number, radio))
            assert (f"{read.address:010X}", read.channel) == (own, channel)
            assert read.data_rate == (250_000, 1_000_000, 2_000_000).index(rate)


@pytest.mark.long
@pytest.mark.parametrize(("first", "number", "own"), ADDRESSES)
def test_boards_count_up_from_the_first_address_in_lockstep_and_served(
    first: str, number: int, own: str
) -> None:
    keys = (f"radio.address={first}", "radio.channel=37", "radio.bits_per_second=1_000_000")
    config = load_config(overrides=keys)
    read = decode_config(factory_config(number, config.radio))
    assert (f"{read.address:010X}", read.channel, RATES[read.data_rate]) == (own, 37, "1M")
    flight = lockstep_flight(Request.of(EXPERIMENTS["hover"], overrides=keys), number=number)
    assert decode_config(bytes(flight.robot.board.eeprom[:CONFIG_SIZE])) == read
    flight.close()
    assert Server(Service(config, number, 1), lambda _: None).served.uri == f"radio://0/37/1M/{own}"


@pytest.mark.parametrize(
    "address",
    ["E7E7E7E7", "E7E7E7E7E7E7", "E7E7E7E7G1", "0xE7E7E7E7", "1122334455", "FFE7E7E7D8", "FFFFFFFFFF"],
)
def test_an_address_that_leaves_boards_none_of_their_own_or_is_a_number_is_refused(address: str) -> None:
    with pytest.raises(LabError, match=r"^radio.address = .*10 hexadecimal digits in .* at most FFE7E7E7D7$"):
        load_config(overrides=(f"radio.address={address}",))
    load_config(overrides=('radio.address="1122334455"',))


def test_before_it_boots_a_board_has_the_hardwares_time_and_an_empty_eeprom() -> None:
    said: list[tuple[int, str]] = []
    board = VirtualBoard(lambda *_: None, lambda *_: True, lambda *line: said.append(line))
    assert (board.now_us, bytes(board.eeprom)) == (0, b"\xff" * 8192)
    board.debug_write("on")
    board.boot(7_000)
    board.debug_write("again")
    assert said == [(0, "on"), (7_000, "again")]
