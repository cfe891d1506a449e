"""Decks by their registers: what ST's, PixArt's and NXP's chips answer, and what the radio chip reads of them."""

import math
import struct
from collections.abc import Callable
from typing import get_args

import numpy as np
import pytest

pytest.importorskip("unicorn")
pytest.importorskip("cffi")

from hil.config import RobotConfig, load_config
from hil.emulator.crazyflie import syslink
from hil.emulator.crazyflie.decks import DECKS, EXPANDER_ADDRESS
from hil.emulator.crazyflie.ranger import ADDRESS, Ranger
from support.deck_bench import DeckBench
from support.stm32_bench import Bench

FLOW, MULTIRANGER = 0x0F, 0x0C  # products, of Bitcraze's drivers
START, DATA_READY, RESULT = 0x0087, 0x0031, 0x0089
# ST's driver for "medium" and 25 ms (VL53L1_SetMeasurementTimingBudgetMicroSeconds): timeouts and periods from 0x5E on.
MEDIUM = bytes((0x00, 0x91, 0x0B, 0x00, 0xAE, 0x09))
FLOW_COUNTS = (
    488.3  # per radian: 35 pixels of 0.71674 rad in tenths, as mm_flow.c of Bitcraze's firmware has it
)
SENSOR_BELOW = 0.008


def test_profile_knows_the_decks_that_there_are() -> None:
    (literal, _) = get_args(RobotConfig.model_fields["decks"].annotation)
    assert set(get_args(literal)) == set(DECKS)
    assert load_config("crazyflie-decks").robot.decks == ("flow2", "multiranger")


# One-wire memories


@pytest.mark.long
def test_memories_are_found_and_read_in_pieces() -> None:
    decks = DeckBench("flow2", "multiranger").decks
    assert decks.answer(syslink.SCAN_MEMORIES, b"") == b"\2"
    for number, product, name in ((0, FLOW, b"bcFlow2"), (1, MULTIRANGER, b"bcMultiranger")):
        memory = b""
        while len(memory) < 112:
            head = struct.pack("<BH", number, len(memory))
            size = min(29, 112 - len(memory))
            answer = decks.answer(syslink.READ_MEMORY, head + bytes(size))
            assert (answer[:3], len(answer)) == (head, 3 + size)
            memory += answer[3:]
        assert struct.unpack_from("<BIBB", memory) == (0xEB, 0, 0xBC, product)
        assert memory[10:12] + memory[12 : 12 + len(name)] == bytes((1, len(name))) + name


def test_a_memory_keeps_writes_and_an_absent_one_is_silent() -> None:
    decks = DeckBench("flow2").decks
    for at, data in ((109, b"abc"), (110, b"xyz")):  # up to its last byte, and beyond
        decks.answer(syslink.WRITE_MEMORY, struct.pack("<BHH", 0, at, 3) + data)
    assert decks.answer(syslink.READ_MEMORY, struct.pack("<BH", 0, 108) + bytes(5))[3:] == b"\xffabc"
    assert decks.answer(syslink.MEMORY_INFO, b"\1")[0] == 0xFF
    assert decks.answer(syslink.READ_MEMORY, b"\1\0\0" + bytes(9))[0] == 0xFF


def test_serial_number_has_the_sum_of_maxims_note_27() -> None:
    info = DeckBench("flow2").decks.answer(syslink.MEMORY_INFO, b"\0")
    assert (info[0], len(info)) == (0, 9)
    crc = 0
    for bit in (byte >> i & 1 for byte in info[1:9] for i in range(8)):  # with its own sum: 0
        crc = (crc >> 1) ^ (0x8C if (crc ^ bit) & 1 else 0)
    assert crc == 0


def test_a_board_without_decks_has_no_memories_and_an_empty_bus() -> None:
    bench = DeckBench()
    assert bench.decks.answer(syslink.SCAN_MEMORIES, b"") == b"\0"
    assert not bench.answers(ADDRESS)
    assert not bench.answers(EXPANDER_ADDRESS)


# VL53L1X


def start(bench: DeckBench, address: int, mode: int = 0x40) -> None:
    bench.write(address, b"\0\x5e" + MEDIUM)
    bench.write(address, struct.pack(">HBB", START - 1, 1, mode))


def ready(bench: DeckBench, address: int) -> bool:
    """The interrupt is active low after power-on."""
    return not bench.read(address, DATA_READY.to_bytes(2), 1)[0] & 1


def ranged(bench: DeckBench, address: int) -> tuple[int, float]:
    """Return status and range [m], as ST's driver computes it."""
    status, *_, high, low = bench.read(address, RESULT.to_bytes(2), 15)
    return status, ((high << 8 | low) * 2011 + 1024) // 2048 * 1e-3


def test_the_ranger_measures_in_the_time_of_its_registers() -> None:
    bench = DeckBench("flow2")
    bench.place((0.0, 0.0, 1.0))
    start(bench, ADDRESS)
    begun = bench.us
    while not ready(bench, ADDRESS):
        assert bench.us - begun < 40_000
    # 146 and 175 macro periods of 73.2 and 61.0 us between ST's overheads, to the length of a read on the bus.
    assert bench.us - begun == pytest.approx(1448 + 2100 + 146 * 73.2 + 175 * 61.0, abs=500)


def test_ranger_returns_the_distance_of_the_floor_with_little_noise() -> None:
    bench, seen = DeckBench("flow2"), []
    for height in np.linspace(0.05, 2.5, 12):
        bench.place((0.0, 0.0, float(height)))
        start(bench, ADDRESS)
        bench.wait(30_000)
        status, distance = ranged(bench, ADDRESS)
        assert status == 9
        seen.append(distance - (height - SENSOR_BELOW))
    assert np.std(seen) == pytest.approx(0.0025, abs=0.0015)
    assert np.mean(seen) == pytest.approx(0.0, abs=0.002)


def test_a_ranger_reports_out_of_reach() -> None:
    bench = DeckBench("flow2")
    bench.place((0.0, 0.0, 3.2))  # "medium" reaches 2.9 m
    start(bench, ADDRESS)
    bench.wait(30_000)
    status, distance = ranged(bench, ADDRESS)
    assert (status, distance > 8.0) == (4, True)


@pytest.mark.parametrize(("distance", "status"), [(2.9, 9), (np.nextafter(2.9, 3.0), 4)])
def test_a_ranger_sees_up_to_its_reach(distance: float, status: int) -> None:
    bench, waiting = Bench(), list[Callable[[int], object]]()
    ranger = Ranger(bench.chip, 1, lambda _, do: waiting.append(do), lambda: distance, lambda: 0.0)
    ranger.switch(True)
    registers = ranger._registers
    registers[0x5E:0x64] = np.frombuffer(MEDIUM, np.uint8)
    registers[START] = 0x10
    ranger._obey()
    waiting.pop()(0)
    assert registers[0x89] == status
    registers[0x8B] = 255
    ranger._finish(ranger._run, False, 0)
    assert registers[0x8B] == 128, "the count of measurements goes on with its upper half"


@pytest.mark.parametrize("stop", ["off", "abort", "again"])
def test_a_measurement_that_was_stopped_never_ends(stop: str) -> None:
    bench = DeckBench("multiranger")
    bench.write(EXPANDER_ADDRESS, bytes((3, 0xFF & ~1)))
    bench.write(EXPANDER_ADDRESS, b"\1\1")
    start(bench, ADDRESS, 0x40)
    bench.wait(15_000)
    if stop == "off":
        bench.write(EXPANDER_ADDRESS, b"\1\0")
        bench.write(EXPANDER_ADDRESS, b"\1\1")
        assert bench.read(ADDRESS, b"\0\x5e", 6) == bytes(6)
    else:
        start(bench, ADDRESS, 0x80 if stop == "abort" else 0x10)
    bench.wait(15_000)  # of 25 ms
    assert not ready(bench, ADDRESS)
    bench.wait(15_000)
    assert ready(bench, ADDRESS) == (stop == "again")


def test_timed_ranger_measures_again_and_again_and_counts() -> None:
    bench = DeckBench("flow2")
    bench.place((0.0, 0.0, 1.0))
    bench.write(ADDRESS, b"\0\x6c" + (50 * 600).to_bytes(4))  # 50 ms of its slow oscillator
    start(bench, ADDRESS)
    counts = []
    for _ in range(4):
        bench.wait(50_000)
        counts.append(bench.read(ADDRESS, b"\0\x8b", 1)[0])
    assert np.diff(counts).tolist() == [1, 1, 1]
    bench.write(ADDRESS, b"\0\x8b\xfe")
    for count in (255, 128, 129):  # as on the chip
        bench.wait(50_000)
        assert bench.read(ADDRESS, b"\0\x8b", 1)[0] == count


def test_ranger_has_sts_identity_and_moves_to_the_address_that_it_is_given() -> None:
    bench = DeckBench("flow2")
    assert bench.read(ADDRESS, b"\1\x0f", 3) == bytes((0xEA, 0xCC, 0x10))
    bench.write(ADDRESS, b"\0\1\x6a")
    assert not bench.answers(ADDRESS)
    assert bench.read(0x6A, b"\0\xe5", 1) == b"\1"


# Multi-ranger


def test_expander_lets_one_ranger_after_the_other_come_to_life() -> None:
    bench = DeckBench("multiranger")
    bench.place((0.5, 0.2, 1.0))
    assert not bench.answers(ADDRESS), "nothing drives their pins"
    bench.write(EXPANDER_ADDRESS, b"\1\0")
    bench.write(EXPANDER_ADDRESS, bytes((3, 0xFF & ~0b101_0111)))
    # Of the Multi-ranger: front P4, back P1, up P0, left P6, right P2; walls 2 m, ceiling 2.5 m.
    wanted = {4: 1.485, 1: 2.485, 0: 1.485, 6: 1.785, 2: 2.185}
    on, seen = 0, {}
    for index, pin in enumerate(wanted):
        on |= 1 << pin
        bench.write(EXPANDER_ADDRESS, bytes((1, on)))
        address = 0x6A + index
        bench.write(ADDRESS, bytes((0, 1, address)))
        start(bench, address)
        bench.wait(30_000)
        seen[pin] = ranged(bench, address)[1]
    assert seen == pytest.approx(wanted, abs=0.012)
    bench.write(EXPANDER_ADDRESS, b"\1\0")
    assert not any(bench.answers(address) for address in (ADDRESS, *range(0x6A, 0x6F)))


# PMW3901


def burst(bench: DeckBench) -> tuple[int, int, int, int]:
    """Return motion, delta x, delta y and quality."""
    data = bench.transfer(bytes((0x16,)) + bytes(12))[1:]
    motion, _, x, y, quality = struct.unpack_from("<BBhhB", data)
    return motion, x, y, quality


def moved(
    bench: DeckBench, way: list[tuple[tuple[float, ...], tuple[float, ...]]], images: int = 1
) -> np.ndarray:
    """Return what the sensor adds up on a way through poses, one per image, when it is read after every few images."""
    total = np.zeros(2)
    bench.place(*way[0])
    bench.wait(20_000)
    burst(bench)
    for number, pose in enumerate(way, 1):
        bench.place(*pose)
        bench.wait(8_264)
        if number % images:
            continue
        motion, x, y, _ = burst(bench)
        assert motion == (0xB0 if x or y else 0x30)
        total += x, y
    return total


def test_flow_sensor_has_pixarts_identity_whatever_is_written_elsewhere() -> None:
    bench = DeckBench("flow2")
    for address, value in ((0x7F, 5), (0x5F, 0x34), (0x00, 1)):
        bench.transfer(bytes((address | 0x80, value)))
    assert (bench.transfer(b"\0\0")[1], bench.transfer(b"\x5f\0")[1]) == (0x49, 0xB6)


LEVEL = (1.0, 0.0, 0.0, 0.0)
STEPS = np.linspace(0.0, 1.0, 60)


def about(axis: int, angle: float) -> tuple[float, ...]:
    q = [math.cos(angle / 2), 0.0, 0.0, 0.0]
    q[1 + axis] = math.sin(angle / 2)
    return tuple(q)


@pytest.mark.long
@pytest.mark.parametrize(
    ("to", "wanted"), [((0.5, 0.0), (0.0, -1.0)), ((0.0, 0.5), (-1.0, 0.0)), ((0.0, 0.0), (0.0, 0.0))]
)
@pytest.mark.parametrize("images", [1, 20])
def test_flow_is_the_way_over_the_height(
    to: tuple[float, float], wanted: tuple[float, float], images: int
) -> None:
    """Half a metre at 1 m is 0.5 rad; the firmware takes -delta y as x."""
    bench = DeckBench("flow2")
    way = [((to[0] * s, to[1] * s, 1.0 + SENSOR_BELOW), LEVEL) for s in STEPS]
    assert moved(bench, way, images) / FLOW_COUNTS == pytest.approx(0.5 * np.array(wanted), abs=0.04)


@pytest.mark.parametrize(("axis", "wanted"), [(1, (0.0, 1.0)), (0, (-1.0, 0.0))])
def test_flow_is_seen_from_the_sensors_place(axis: int, wanted: tuple[float, float]) -> None:
    """Nose down, the floor moves forward; with the middle 9 cm above it by a tenth more: the sensor is 8 mm nearer."""
    bench = DeckBench("flow2")
    way = [((0.0, 0.0, 0.09), about(axis, angle)) for angle in np.linspace(-0.3, 0.3, 20)]
    seen = [0.6 * 0.0915 / (0.0915 - SENSOR_BELOW) * sign for sign in wanted]  # 9.0 to 9.4 cm along its view
    assert moved(bench, way) / FLOW_COUNTS == pytest.approx(np.array(seen), abs=0.025)


def test_flow_is_limited_by_the_rate_that_it_can_follow() -> None:
    bench = DeckBench("flow2")
    bench.place((0.0, 0.0, 0.1))
    bench.wait(20_000)
    burst(bench)
    bench.place((0.5, 0.0, 0.1))
    bench.wait(8_264)
    assert burst(bench)[2] == pytest.approx(-7.4 * 8.264e-3 * FLOW_COUNTS, abs=4)


def test_motion_is_forgotten_once_it_was_read_and_by_a_reset() -> None:
    bench = DeckBench("flow2")
    for forget in (lambda: burst(bench), lambda: bench.transfer(b"\xba\x5a")):
        for x in (0.0, 0.1):
            bench.place((x, x, 1.0))
            bench.wait(8_264)
        forget()
        assert burst(bench)[:3] == (0x30, 0, 0)


def test_who_loses_the_floor_sees_no_feature_and_the_way_until_it_is_back_is_not_counted() -> None:
    bench = DeckBench("flow2")
    bench.place((0.0, 0.0, 1.0))
    bench.wait(20_000)
    assert burst(bench)[3] > 0
    for turn in (about(0, math.pi), (0.5, 0.5, 0.5, 0.5)):  # it looks up, or along the floor
        bench.place((0.0, 0.0, 1.0), turn)
        bench.wait(8_264)
        assert burst(bench)[::3] == (0x30, 0)
    bench.place((0.4, 0.3, 1.0))
    bench.wait(8_264)
    _, x, y, quality = burst(bench)
    assert (abs(x) < 8, abs(y) < 8, quality > 0) == (True, True, True)


def test_near_the_floor_fewer_features_are_counted() -> None:
    bench, seen = DeckBench("flow2"), []
    for height in (0.02, 0.05, 0.5, 1.0):
        bench.place((0.0, 0.0, height))
        bench.wait(20_000)
        seen.append(burst(bench)[3])
    assert seen[0] < seen[1] < seen[2] == seen[3]
