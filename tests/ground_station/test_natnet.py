"""NatNet: packets are read as other clients read them, and no bytes can do harm."""

import struct
from contextlib import suppress

import pytest
from hypothesis import given
from hypothesis import strategies as st

from ground_station.errors import MocapError
from ground_station.sources.natnet import Echo, Frame, ModelDefinition, Other, ServerInfo, decode
from support import natnet_packets as packets
from support.natnet_packets import VERSIONS

TICKS = (100, 200, 300)
Version = tuple[int, int]


@pytest.mark.parametrize("version", VERSIONS)
def test_a_frame_is_read_in_every_version(version: Version) -> None:
    frame = decode(packets.frame(41, version, TICKS, parameters=2), version)
    assert isinstance(frame, Frame)
    assert (frame.number, frame.timestamp_s, frame.parameters) == (41, 12.5, 2)
    assert (frame.mid_exposure, frame.received, frame.transmitted) == TICKS
    (body,) = frame.bodies
    assert (body.id, body.p, body.q, body.valid) == (7, (1.0, 2.0, 3.0), (0.5, 0.5, -0.5, 0.5), True)
    assert frame.unlabelled == ((4.0, 5.0, 6.0),)
    assert [(marker.id, marker.p) for marker in frame.labelled] == [(0x70001, (1.0, 2.0, 3.0))]


@pytest.mark.parametrize("end", [b"", bytes(4)])
@pytest.mark.parametrize("precision", [True, False])
def test_frames_of_4_0_are_read_with_and_without_a_precision_time(precision: bool, end: bytes) -> None:
    payload = packets.frame(41, (4, 0), TICKS, parameters=2, precision=precision)[4:-4] + end
    frame = decode(packets.packet(7, payload), (4, 0))
    assert isinstance(frame, Frame)
    assert (frame.transmitted, frame.parameters) == (300, 2)


@pytest.mark.parametrize("version", VERSIONS)
def test_models_are_read_in_every_version(version: Version) -> None:
    models = decode(packets.model_definition({"floaty": 7, "other": 8}, version), version)
    assert isinstance(models, ModelDefinition)
    assert [(body.name, body.id) for body in models.bodies] == [("floaty", 7), ("other", 8)]
    assert [marker.name for marker in models.bodies[0].markers] == (
        ["a", "b"] if version >= (4, 0) else ["", ""]
    )


@pytest.mark.parametrize("version", VERSIONS)
def test_another_client_reads_the_same_out_of_these_packets(version: Version) -> None:
    module = pytest.importorskip("MAVProxy.modules.mavproxy_optitrack.NatNetClient", exc_type=ImportError)
    client = module.NatNetClient()
    data = packets.frame(41, version, TICKS, parameters=2)
    end, theirs = client._NatNetClient__unpack_mocap_data(data[4:], len(data) - 4, *version)
    ours = decode(data, version)
    assert isinstance(ours, Frame)
    assert end == len(data) - 8
    suffix = theirs.suffix_data
    stamps = (suffix.stamp_camera_mid_exposure, suffix.stamp_data_received, suffix.stamp_transmit)
    assert (ours.mid_exposure, ours.received, ours.transmitted) == stamps
    (body,) = theirs.rigid_body_data.rigid_body_list
    w, x, y, z = ours.bodies[0].q
    assert (body.id_num, body.pos, body.rot) == (ours.bodies[0].id, ours.bodies[0].p, (x, y, z, w))
    data = packets.model_definition({"floaty": 7, "other": 8}, version)
    _, models = client._NatNetClient__unpack_data_descriptions(data[4:], len(data) - 4, *version)
    assert [(body.sz_name, body.id_num) for body in models.rigid_body_list] == [(b"floaty", 7), (b"other", 8)]


def test_the_server_and_its_echo_are_read() -> None:
    server = decode(packets.server_info((4, 1), True), (3, 0))
    group = "239.255.42.99"
    assert server == ServerInfo("Motive", (3, 1, 0, 0), (4, 1, 0, 0), packets.CLOCK_HZ, 1511, True, group)
    reused = packets.server_info((4, 1), True).replace(b"Motive\0\0", b"Motive\0x")
    assert decode(reused, (3, 0)) == server  # whatever stands behind the end of the name
    assert decode(packets.echo(5, 6), (3, 0)) == Echo(5, 6)
    assert decode(packets.packet(100, b""), (3, 0)) == Other(100)


@pytest.mark.long
@pytest.mark.parametrize("version", VERSIONS)
def test_a_packet_cut_anywhere_is_refused_in_one_line(version: Version) -> None:
    for whole in (packets.frame(1, version, TICKS), packets.model_definition({"floaty": 7}, version)):
        tail = 8 if whole[0] == 7 else 4  # header, and the end tag that may be absent
        for size in range(len(whole) - tail):
            if version == (4, 0) and whole[0] == 7 and len(whole) - 4 - size in (8, 12):
                continue  # a whole frame without the precision time, with and without the end tag
            with pytest.raises(MocapError, match=r"^NatNet .*\Z"):
                decode(struct.pack("<HH", whole[0], size) + whole[4 : 4 + size], version)


def test_the_length_in_the_header_and_the_version_must_be_right() -> None:
    with pytest.raises(MocapError, match="says that it has"):
        decode(packets.echo(5, 6) + b"\0", (3, 0))
    with pytest.raises(MocapError, match=r"NatNet 2\.7: only 3\.0"):
        decode(packets.echo(5, 6), (2, 7))
    with pytest.raises(MocapError, match="clock 0 Hz"):
        decode(packets.server_info((4, 1), hz=0), (3, 0))


def test_a_count_of_more_than_there_is_is_refused_at_once() -> None:
    with pytest.raises(MocapError, match="4294967295 items of 5 bytes"):
        decode(packets.packet(7, bytes(4) + b"\xff" * 4 + bytes(40)), (3, 0))


@pytest.mark.long
@given(st.binary(max_size=200), st.integers(0, 20), st.sampled_from(VERSIONS))
def test_any_payload_is_read_or_refused(payload: bytes, message: int, version: Version) -> None:
    with suppress(MocapError):
        decode(packets.packet(message, payload), version)
