"""Telemetry is requested as cflib requests it, and what comes is joined to rows."""

import struct
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from firmware_py.wire import WireError, crtp, log, telemetry
from firmware_py.wire.scalars import LOG_SCALARS
from firmware_py.wire.telemetry import ALL_BLOCKS, ATTITUDE, CONTROL, FLAPS, LOAD, MOTION
from ground_station.links.log_blocks import LogBlocks
from support.log_board import TABLE, LogBoard, data_packet

REPEAT_US, PATIENCE_US = 100_000, 2_000_000


class Line:
    """Log blocks whose requests end in a list, until the board answers."""

    def __init__(self, table=TABLE):
        self.board = LogBoard()
        self.waiting = []
        self.logs = LogBlocks(lambda now_us, data: self.waiting.append(data), lambda: table)

    def talk(self, now_us=0):
        """Let the board answer until nothing is asked any more."""
        while self.waiting:
            reply = self.board.answer(self.waiting.pop(0))
            self.logs.receive(now_us, crtp.decode(reply))

    def hear(self, block, timestamp_ms, values=None):
        values = [1.0 if v.type.is_float else 1 for v in block.variables] if values is None else values
        (sample,) = self.logs.receive(0, crtp.decode(data_packet(block, timestamp_ms, values)))
        return sample


@pytest.fixture
def line():
    line = Line()
    line.logs.request(0)
    line.talk()
    return line


def test_every_block_is_created_with_its_variables_and_types_and_runs_at_its_period(line):
    assert line.board.blocks == {
        block.id: [(variable.type.log_number, variable.name) for variable in block.variables]
        for block in ALL_BLOCKS
    }
    assert {LOG_SCALARS[kind] for items in line.board.blocks.values() for kind, _ in items} == {
        variable.type for block in ALL_BLOCKS for variable in block.variables
    }
    assert line.board.periods == {block.id: block.period_ms // 10 for block in ALL_BLOCKS}
    assert line.logs.notices == []


def test_nothing_is_started_before_all_is_created_and_the_controller_starts_first(line):
    commands = [request[0] for request in line.board.requests]
    assert commands == sorted(commands, key=[5, 6, 7, 3].index) or commands.index(3) > max(
        k for k, command in enumerate(commands) if command in (6, 7)
    )
    assert commands[0] == 5
    started = [request[1] for request in line.board.requests if request[0] == 3]
    assert started[0] == CONTROL.id
    assert sorted(started) == [block.id for block in ALL_BLOCKS]


def test_a_request_is_one_packet_and_the_next_one_waits_for_its_answer():
    line = Line()
    line.logs.request(0)
    for _ in range(30):
        assert len(line.waiting) <= 1
        assert all(len(packet) <= 31 for packet in line.waiting)
        if line.waiting:
            line.logs.receive(0, crtp.decode(line.board.answer(line.waiting.pop())))
    assert len(line.board.periods) == len(ALL_BLOCKS)


@pytest.mark.long
@given(st.lists(st.booleans(), max_size=40))
def test_a_lost_request_is_repeated_after_a_tenth_of_a_second(arrives):
    line, now_us = Line(), 0
    line.logs.request(0)
    for arrived in [*arrives, *[True] * 40]:
        packets, line.waiting = line.waiting, []
        if arrived and packets:
            line.logs.receive(now_us, crtp.decode(line.board.answer(packets[0])))
        now_us += REPEAT_US
        line.logs.repeat(now_us)
        if line.logs.notices:  # twenty were lost in a row
            line.logs.notices.clear()
            line.logs.request(now_us)
    assert set(line.board.periods) == {block.id for block in ALL_BLOCKS}
    assert line.board.blocks[CONTROL.id] == [(v.type.log_number, v.name) for v in CONTROL.variables]


def test_a_missing_variable_costs_only_its_block_and_is_reported():
    line = Line({name: number for name, number in TABLE.items() if name != "system.load"})
    line.logs.request(0)
    line.talk()
    assert set(line.board.periods) == {block.id for block in ALL_BLOCKS if block is not LOAD}
    assert line.logs.notices == ["the board has no system.load: without these blocks of telemetry"]


def test_a_block_whose_creation_was_answered_in_vain_is_there_once_and_the_script_goes_on():
    line, now_us = Line(), 0
    line.logs.request(0)
    while line.waiting:
        if crtp.decode(line.waiting[0]).data[0] == log.LogCommand.CREATE:
            line.board.answer(line.waiting.pop())  # its answer is lost
            now_us += REPEAT_US
            line.logs.repeat(now_us)
        line.logs.receive(now_us, crtp.decode(line.board.answer(line.waiting.pop())))
    assert line.board.periods == {block.id: block.period_ms // 10 for block in ALL_BLOCKS}
    assert [len(line.board.blocks[block.id]) for block in ALL_BLOCKS] == [
        len(b.variables) for b in ALL_BLOCKS
    ]


def test_a_refusal_is_reported_and_ends_the_script():
    line = Line()
    line.logs.request(0)
    line.talk()
    line.logs.request(0)
    command, number = crtp.decode(line.waiting.pop()).data[0], 0
    line.logs.receive(
        0, crtp.Packet(crtp.PORT_LOG, log.CHANNEL_CONTROL, bytes((command, number, log.ENOMEM)))
    )
    line.logs.repeat(0)
    assert line.logs.notices == ["telemetry: log request 05: error 12"]
    assert line.waiting == []


def test_a_board_that_never_answers_is_given_up_and_may_be_asked_again():
    line = Line()
    line.logs.request(0)
    for now_us in range(0, PATIENCE_US + REPEAT_US, REPEAT_US):
        line.logs.repeat(now_us)
    assert line.logs.notices == ["telemetry: no answer within 2 s"]
    assert len(line.waiting) == PATIENCE_US // REPEAT_US
    line.waiting.clear()
    line.logs.request(3_000_000)
    line.talk()
    assert len(line.board.periods) == len(ALL_BLOCKS)


def test_attitudes_of_a_crazyflie_come_in_degrees_and_are_samples_in_radians(line):
    sample = line.hear(ATTITUDE, 1234, (10, -20, 30, 41, 5, 6))
    assert sample.values == pytest.approx((*np.radians((10, 20, 30)), 41, 5, 6))


@pytest.mark.long
@given(phase=st.integers(0, 19), after=st.tuples(*[st.integers(1, 19)] * 3), begin=st.integers(0, 1000))
def test_blocks_of_one_period_share_the_instant_of_the_controllers_block(phase, after, begin):
    line = Line()
    line.logs.request(0)
    line.talk()
    rows = []
    for period in range(begin, begin + 5):
        t_ms = 20 * period + phase
        rows.append([line.hear(CONTROL, t_ms).timestamp_ms])
        rows[-1] += [
            line.hear(b, t_ms + d).timestamp_ms for b, d in zip((MOTION, ATTITUDE, FLAPS), after, strict=True)
        ]
        assert rows[-1] == [t_ms] * 4
    assert {later[0] - earlier[0] for earlier, later in pairwise(rows)} == {20}


def test_time_stamps_go_on_where_they_wrap(line):
    assert line.hear(CONTROL, (1 << 24) - 5).timestamp_ms == (1 << 24) - 5
    assert line.hear(MOTION, 3).timestamp_ms == (1 << 24) - 5


@pytest.mark.parametrize("data", [b"\x4d\0\0\0", bytes((MOTION.id, 0, 0, 0)) + bytes(23), b"\0\0"])
def test_data_of_unknown_blocks_or_of_another_length_is_refused(line, data):
    with pytest.raises(WireError):
        line.logs.receive(0, crtp.Packet(crtp.PORT_LOG, log.CHANNEL_DATA, data))


def test_the_state_is_that_of_the_controllers_block(line):
    half = [0.5] * 11
    samples = [line.hear(MOTION, 0), line.hear(CONTROL, 0, (3, *half))]
    assert telemetry.state_in(samples) == 3
    assert telemetry.state_in(samples[:1]) is None
    assert struct.calcsize("<B11e") == CONTROL.layout.size
