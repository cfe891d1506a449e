"""CRTP bytes against cflib, and the telemetry blocks over them."""

import struct
from math import inf, nan

import pytest
from cflib.crazyflie.localization import Localization
from cflib.crazyflie.log import LogConfig
from cflib.crtp.crtpstack import CRTPPacket
from hypothesis import given
from hypothesis import strategies as st

from firmware_py.wire import WireError, crtp, high_level, localisation, log, telemetry
from firmware_py.wire.high_level import PathCommand
from firmware_py.wire.scalars import Scalar
from firmware_py.wire.toc import Toc

metres = st.floats(-100.0, 100.0, width=32)
Q = (0.5, -0.5, 0.5, 0.5)


class Recorder:
    """Stands where cflib has its radio and keeps the bytes that would go there."""

    def __init__(self):
        self.sent = b""

    def add_port_callback(self, port, callback):
        pass

    def send_packet(self, packet):
        self.sent = bytes((packet.get_header(), *packet.data))


def cflib_ext_pose(position, q_xyzw):
    crazyflie = Recorder()
    Localization(crazyflie).send_extpose(position, q_xyzw)
    return crazyflie.sent


@given(st.integers(0, 15), st.integers(0, 3), st.binary(max_size=30))
def test_packets_are_cflibs(port, channel, data):
    theirs = CRTPPacket()
    theirs.set_header(port, channel)
    theirs.data = data
    raw = crtp.encode(crtp.Packet(port, channel, data))
    assert raw == bytes((theirs.get_header(), *theirs.data))
    assert crtp.decode(raw) == crtp.Packet(port, channel, data)


@pytest.mark.long
@given(st.tuples(metres, metres, metres), st.integers(0, 200_000))
def test_external_pose_is_cflibs_bytes_and_the_age(p, age_us):
    ours = crtp.encode_ext_pose(p, (0.5, -0.5, 0.5, -0.5), age_us)
    assert ours[:-1] == cflib_ext_pose(p, (-0.5, 0.5, -0.5, 0.5))
    assert len(ours) == 1 + 30


@given(st.tuples(metres, metres, metres), st.integers(-1000, 1_000_000))
def test_pose_survives_the_wire_with_its_age_to_half_a_unit(p, age_us):
    message = crtp.decode_ext_pose(crtp.decode(crtp.encode_ext_pose(p, Q, age_us)).data)
    assert (message.p_GB, message.q_GB) == (p, Q)
    assert abs(message.age_us - min(max(age_us, 0), 127_000)) <= 250


def test_stock_pose_has_no_age():
    assert crtp.decode_ext_pose(cflib_ext_pose((1, 2, 3), (0, 0, 0, 1))[1:]).age_us is None
    assert crtp.decode_ext_pose(crtp.encode_ext_pose((1, 2, 3), Q, None)[1:]).age_us is None


@pytest.mark.parametrize(
    ("p", "q"),
    [
        ((nan, 0, 0), Q),
        ((0, inf, 0), Q),
        ((inf, -inf, 0), Q),
        ((0, 0, 0), (nan, 0, 0, 0)),
        ((0, 0, 0), (0, 0, 0, 0)),
        ((0, 0, 0), (0.89, 0, 0, 0)),
        ((0, 0, 0), (0, 1.11, 0, 0)),
    ],
)
def test_the_board_refuses_an_invalid_pose(p, q):
    with pytest.raises(WireError):
        crtp.decode_ext_pose(struct.pack("<B7fB", 8, *p, *q[1:], q[0], 0))


def test_a_position_outside_of_any_tunnel_is_invalid():
    assert crtp.decode_ext_pose(crtp.encode_ext_pose((0, -1000.0, 0), Q, 0)[1:]).p_GB == (0, -1000.0, 0)
    for x in (1000.5, -1001.0, 3e38):
        with pytest.raises(WireError, match="within 1000 m"):
            crtp.decode_ext_pose(crtp.encode_ext_pose((x, 0, 0), Q, 0)[1:])


@pytest.mark.parametrize("length", [0.91, 1.09])
def test_a_quaternion_s_length_may_be_off_by_a_tenth(length):
    assert crtp.decode_ext_pose(crtp.encode_ext_pose((0, 0, 0), (0, length, 0, 0), 0)[1:]).age_us == 0


@pytest.mark.parametrize(
    ("older", "newer"),
    [
        ((PathCommand.TAKE_OFF_1, 1, 2.0, 3.0), (PathCommand.TAKE_OFF, 1, 2.0, 0.0, False, 3.0)),
        ((PathCommand.LAND_1, 1, 2.0, 3.0), (PathCommand.LAND, 1, 2.0, 0.0, False, 3.0)),
        ((PathCommand.GO_TO_1, 1, True, *range(2, 7)), (PathCommand.GO_TO, 1, True, False, *range(2, 7))),
        ((PathCommand.START_1, 1, True, True, 5, 2.0), (PathCommand.START, 1, True, False, True, 5, 2.0)),
    ],
)
def test_an_older_command_is_the_newer_one_without_what_it_lacks(older, newer):
    read = [high_level.decode(crtp.decode(high_level.encode(*command)).data) for command in (older, newer)]
    assert [command for command, _ in read] == [older[0], newer[0]]
    assert read[0][1] == read[1][1]


@pytest.mark.parametrize("raw", [b"", bytes(32)])
def test_packet_of_impossible_length_is_refused(raw):
    with pytest.raises(WireError):
        crtp.decode(raw)


@pytest.mark.long
@given(st.integers(0, 255), st.integers(0, 1 << 25), st.binary(max_size=26))
def test_log_data_is_laid_out_as_cflib_reads_it(block_id, timestamp_ms, values):
    # cflib/crazyflie/log.py: port 5, channel 2; id, then three bytes of time
    packet = CRTPPacket(0, list(log.encode_data(block_id, timestamp_ms, values)))
    raw = bytes(packet.data)
    assert (raw[0] >> 4, raw[0] & 3, raw[1]) == (5, 2, block_id)
    low, middle, high = struct.unpack("<BBB", raw[2:5])
    assert low | middle << 8 | high << 16 == timestamp_ms % (1 << 24)
    assert raw[5:] == values
    assert log.decode_data(raw[1:]) == (block_id, timestamp_ms % (1 << 24), values)


def test_more_than_fits_is_refused():
    with pytest.raises(WireError):
        log.encode_data(1, 0, bytes(27))
    with pytest.raises(WireError):
        crtp.encode(crtp.Packet(0, 0, bytes(31)))


@pytest.mark.parametrize("block", telemetry.ALL_BLOCKS, ids=lambda block: f"block{block.id}")
def test_block_fits_a_packet_and_comes_back(block):
    values = tuple(range(1, 1 + len(block.variables)))
    raw = log.encode_data(block.id, 123_456, block.layout.pack(*values))
    assert len(raw) <= 31
    number, timestamp_ms, packed = log.decode_data(crtp.decode(raw).data)
    assert (number, timestamp_ms) == (block.id, 123_456)
    assert block.unpack(packed) == pytest.approx(block.si_of(values), rel=1e-7)
    for wrong in (packed[1:], packed + b"\0"):
        with pytest.raises(WireError, match=f"{len(wrong)} bytes of values instead of {len(packed)}"):
            block.unpack(wrong)


@pytest.mark.parametrize("block", telemetry.ALL_BLOCKS, ids=lambda block: f"block{block.id}")
def test_cflib_reads_the_block(block):
    names = {Scalar.U8: "uint8_t", Scalar.U16: "uint16_t", Scalar.F32: "float", Scalar.F16: "FP16"}
    config = LogConfig("theirs", block.period_ms)
    for variable in block.variables:
        config.add_variable(variable.name, names[variable.type])
    received = {}
    config.data_received_cb.add_callback(lambda timestamp, data, config: received.update(data))
    values = tuple(range(1, 1 + len(block.variables)))
    config.unpack_log_data(block.layout.pack(*values), 0)
    assert received == {variable.name: value for variable, value in zip(block.variables, values, strict=True)}


@pytest.mark.long
@given(st.lists(st.tuples(st.integers(0, 255), *[st.floats(-32.0, 32.0)] * 3), min_size=1, max_size=3))
def test_packed_positions_are_the_nearest_millimetre_of_each_robot(robots):
    sent = localisation.encode_packed_poses((address, p, Q) for address, *p in robots)
    for (address, *p), (found, pose) in zip(robots, localisation.decode_packed_poses(sent), strict=True):
        assert found == address
        assert pose.p_GB == pytest.approx(p, abs=0.000501)


def test_variables_have_one_home():
    names = [variable.name for block in telemetry.ALL_BLOCKS for variable in block.variables]
    assert len(names) == len(set(names))
    assert len({block.id for block in telemetry.ALL_BLOCKS}) == len(telemetry.ALL_BLOCKS)


@pytest.mark.parametrize(
    ("group", "name", "good"), [(1, 23, True), (23, 1, True), (12, 13, False), (25, 0, False), (0, 24, False)]
)
def test_a_name_in_a_table_of_contents_has_24_letters_at_most(group: int, name: int, good: bool) -> None:
    listed = [(8, f"{'g' * group}.{'n' * name}")]
    if good:
        assert len(Toc.of(2, listed).entries[0]) == 1 + group + 1 + name + 1
        return
    with pytest.raises(WireError, match="at most 24 letters"):
        Toc.of(2, listed)
