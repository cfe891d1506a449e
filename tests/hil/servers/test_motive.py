"""The virtual Motive: every client, ours and unmodified ones, sees the poses that the cameras saw."""

import json
import select
import socket
import struct
import subprocess
import sys
from collections.abc import Callable, Iterator
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from ground_station.config import Axes, CaptureConfig
from ground_station.sources.alignment import Alignment
from ground_station.sources.natnet import (
    MULTICAST_GROUP,
    BodyDescription,
    BodyPose,
    Echo,
    Frame,
    LabelledMarker,
    MarkerDescription,
    MessageId,
    ModelDefinition,
    ServerInfo,
    decode,
    packet,
)
from ground_station.sources.natnet_stream import NatnetStream
from ground_station.unused import Reason
from hil.board.markers import DIAMETER
from hil.errors import LabError
from hil.servers.dongle_server import HOST
from hil.servers.motive import MAX_CLIENTS, Streaming, Up, VirtualMotive
from hil.servers.natnet_bytes import encode_frame, encode_models
from support.motive_bench import FROM_MOTIVE, LATENCY_US, PLACES, MotiveBench, needs, seen, sighted
from support.paths import SUPPORT

VERSIONS = [(3, 0), (3, 1), (4, 0), (4, 1)]

single = st.floats(-100, 100, width=32)
vector = st.tuples(single, single, single)
quaternion = st.tuples(single, single, single, single)
u16, u32, u64 = (st.integers(0, 2**bits - 1) for bits in (16, 32, 64))
text = st.text(st.characters(exclude_characters="\0", exclude_categories=["Cs"]), max_size=20)
bodies = st.builds(BodyPose, u32, vector, quaternion, single, st.booleans())
labelled = st.builds(LabelledMarker, u32, vector, single, u16, single)
frames = st.builds(
    Frame, u32, *(st.lists(kind, max_size=3).map(tuple) for kind in (bodies, vector, labelled)),
    st.floats(0, 1e9), u64, u64, u64, u16,
)  # fmt: skip
markers = st.lists(st.builds(MarkerDescription, vector, u32, text), max_size=3).map(tuple)
described = st.builds(BodyDescription, text, u32, u32, vector, markers)


@pytest.mark.long
@given(frames, st.sampled_from(VERSIONS))
def test_a_frame_arrives_as_it_was_sent(frame: Frame, version: tuple[int, int]) -> None:
    assert decode(encode_frame(frame, version), version) == frame


@pytest.mark.long
@given(st.lists(described, max_size=3), st.sampled_from(VERSIONS[2:]))
def test_model_definitions_arrive_unchanged(models: list[BodyDescription], version: tuple[int, int]) -> None:
    sent = ModelDefinition(tuple(models))
    assert decode(encode_models(sent, version), version) == sent


def test_markers_have_no_names_before_version_4() -> None:
    body = BodyDescription("floaty", 1, 0, (0, 0, 0), (MarkerDescription((1, 2, 3), 4, "nose"),))
    sent = encode_models(ModelDefinition((body,)), (3, 1))
    found = decode(sent, (3, 1))
    assert b"nose" not in sent
    assert found.bodies[0].markers == (MarkerDescription((1, 2, 3), 4, ""),)


@pytest.fixture
def lab() -> Iterator[MotiveBench]:
    lab = MotiveBench()
    yield lab
    lab.motive.close()


class NatNetSocket:
    """A bare socket that speaks NatNet."""

    def __init__(self, lab: MotiveBench) -> None:
        self._lab = lab
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._socket.bind(("127.0.0.1", 0))
        self._socket.settimeout(0.5)

    def say(self, message: MessageId, payload: bytes = b"") -> None:
        self.send(packet(message, payload))

    def send(self, data: bytes) -> None:
        self._socket.sendto(data, ("127.0.0.1", self._lab.motive.port))
        self._lab.answer()

    def connect(self) -> ServerInfo:
        """Connect and keep alive: frames come to this socket from now on."""
        self.say(MessageId.CONNECT)
        info = decode(self.hear(), (4, 1))
        self.say(MessageId.KEEPALIVE)
        return info

    def hear(self) -> bytes:
        return self._socket.recv(65536)

    def hears_nothing(self) -> bool:
        return not select.select([self._socket], (), (), 0)[0]

    def close(self) -> None:
        self._socket.close()


@pytest.fixture
def client(lab: MotiveBench) -> Iterator[NatNetSocket]:
    client = NatNetSocket(lab)
    yield client
    client.close()


@pytest.fixture
def start() -> Iterator[Callable[..., tuple[MotiveBench, NatNetSocket]]]:
    """Start a Motive with options, or with `motive` in its place, and a client of it."""
    started: list[tuple[MotiveBench, NatNetSocket]] = []

    def start(motive: Callable[[MotiveBench], VirtualMotive] | None = None, **options: Any) -> Any:
        lab = MotiveBench(**options)
        if motive is not None:
            lab.motive.close()
            lab.motive = motive(lab)
        started.append((lab, NatNetSocket(lab)))
        return started[-1]

    yield start
    for lab, client in started:
        client.close()
        lab.motive.close()


@pytest.mark.parametrize("payload", [b"", b"Ping\0", bytes(271)], ids=["empty", "Ping", "with the sender"])
def test_each_connect_is_answered_with_frames(lab: MotiveBench, client: NatNetSocket, payload: bytes) -> None:
    client.say(MessageId.CONNECT, payload)
    info = decode(client.hear(), (4, 1))
    assert (info.name, info.natnet_version, info.data_port) == ("Motive", (4, 1, 0, 0), lab.motive.data_port)
    lab.expose()
    assert client.hears_nothing()  # it might take a frame for the answer to its next question
    client.say(MessageId.KEEPALIVE)
    lab.expose()
    frame = decode(client.hear(), (4, 1))
    assert frame.number == 2
    assert frame.bodies[0].p == pytest.approx(FROM_MOTIVE.T @ seen(2).p_WB, abs=1e-6)


@pytest.mark.parametrize(("up", "axes"), [("y", None), ("y", "y-up"), ("z", "z-up")])
def test_the_station_sees_the_world_whichever_axis_points_up(start, up: Up, axes: Axes | None) -> None:
    lab, client = start(up=up)
    stream = NatnetStream("floaty", Alignment(CaptureConfig(axes=axes)))
    for request in (MessageId.CONNECT, MessageId.REQUEST_MODELDEF, MessageId.KEEPALIVE):
        client.say(request)
        if request != MessageId.KEEPALIVE:
            stream.on_packet(client.hear(), 0)
    for number in (1, 2, 3):
        lab.expose()
        found = stream.on_packet(client.hear(), 1_000_000)
        assert found is not None
        assert found.p_WB == pytest.approx(seen(number).p_WB, abs=1e-6)
        turned = Rotation.from_quat(found.q_WB, scalar_first=True).inv()
        assert (turned * Rotation.from_quat(seen(number).q_WB, scalar_first=True)).magnitude() < 1e-6


def test_with_z_up_markers_and_model_are_in_the_world_s_axes(start) -> None:
    lab, client = start(markers=True, up="z")
    client.connect()
    client.say(MessageId.REQUEST_MODELDEF)
    (body,) = decode(client.hear(), (4, 1)).bodies
    assert np.array([marker.p for marker in body.markers]) == pytest.approx(PLACES, abs=1e-6)
    lab.expose()
    frame = decode(client.hear(), (4, 1))
    assert np.array([marker.p for marker in frame.labelled]) == pytest.approx(sighted(1).points, abs=1e-6)
    # NatNet's bits: occluded 1, solved from the point cloud 2, filled from the model 4, of a model 8
    assert [marker.parameters for marker in frame.labelled] == [
        10 if seen else 13 for seen in sighted(1).seen
    ]
    assert [marker.size for marker in frame.labelled] == pytest.approx([DIAMETER] * 8)
    lab.expose()
    frame = decode(client.hear(), (4, 1))
    assert np.array(frame.unlabelled) == pytest.approx(sighted(2).ghosts, abs=1e-6)
    assert len(frame.unlabelled) == 2


def test_a_frame_is_stamped_with_its_exposure(lab: MotiveBench, client: NatNetSocket) -> None:
    hz = client.connect().clock_hz
    lab.run(lambda: lab.number >= 20)  # Motive is older than its cameras' latency then
    frames = [decode(client.hear(), (4, 1)) for _ in range(20)]
    assert frames[-1].transmitted - frames[-1].mid_exposure == LATENCY_US * hz // 1_000_000
    assert frames[-1].timestamp_s == pytest.approx(frames[-1].mid_exposure / hz)
    assert frames[-1].received == frames[-1].transmitted
    assert frames[0].mid_exposure == 0, "not before the start"
    lab.motive.stream_frame(
        1, replace(seen(1), t_us=7_000_000, received_us=7_030_000), 7_000_000 + LATENCY_US
    )
    later = decode(client.hear(), (4, 1))
    assert (later.transmitted - later.received) * 1_000_000 == (LATENCY_US - 30_000) * hz
    client.say(MessageId.ECHO_REQUEST, (2**63 + 5).to_bytes(8, "little"))
    echo = decode(client.hear(), (4, 1))
    assert isinstance(echo, Echo)
    assert echo.asked == 2**63 + 5
    assert frames[-1].transmitted <= echo.server < frames[-1].transmitted + hz


@pytest.mark.parametrize(("reason", "tracked"), [(Reason.NOT_TRACKED, False), (Reason.FROZEN, True)])
def test_a_body_that_is_not_tracked_is_marked_and_one_that_is_frozen_is_not(
    lab: MotiveBench, client: NatNetSocket, reason: Reason, tracked: bool
) -> None:
    client.connect()
    lab.expose(valid=False, reason=reason)
    assert decode(client.hear(), (4, 1)).bodies[0].valid == tracked


def test_markers_of_a_body_that_is_not_tracked_have_no_label(start) -> None:
    lab, client = start(markers=True)
    client.connect()
    lab.expose(valid=False)
    frame = decode(client.hear(), (4, 1))
    expected = sighted(1)
    assert frame.labelled == ()
    places = np.vstack((expected.points[expected.seen], expected.ghosts)) @ FROM_MOTIVE
    assert np.array(frame.unlabelled) == pytest.approx(places, abs=1e-6)


def test_markers_of_all_bodies_share_a_frame_and_are_distinguishable(start) -> None:
    one = Streaming(0, (3, 1), False)
    lab, client = start(lambda lab: VirtualMotive(one, 2, lab.readers, PLACES))
    client.connect()
    for _ in range(2):  # nothing is left of the frame before
        lab.motive.stream_frame(1, seen(1), 0, sighted(1))
        lab.motive.stream_frame(2, seen(2), 0, sighted(2))
        frame = decode(client.hear(), (3, 1))
        assert [marker.id for marker in frame.labelled] == [
            body << 16 | row for body in (1, 2) for row in range(1, 9)
        ]
        ghosts = np.vstack((sighted(1).ghosts, sighted(2).ghosts))
        assert np.array(frame.unlabelled) == pytest.approx(ghosts @ FROM_MOTIVE, abs=1e-6)
        assert [body.error for body in frame.bodies] == pytest.approx([0.001, 0.002])


def test_bodies_of_one_exposure_share_a_frame(start) -> None:
    one = Streaming(0, (3, 1), False)
    lab, client = start(lambda lab: VirtualMotive(one, 2, lab.readers))
    client.connect()
    lab.motive.stream_frame(1, seen(1), 0)
    assert client.hears_nothing()
    lab.motive.stream_frame(2, seen(2), 0)
    found = decode(client.hear(), (3, 1)).bodies
    assert [body.id for body in found] == [1, 2]
    client.say(MessageId.REQUEST_MODELDEF)
    assert [body.name for body in decode(client.hear(), (3, 1)).bodies] == ["floaty", "floaty2"]
    lab.motive.lose(2)
    lab.motive.stream_frame(1, replace(seen(1), t_us=1_000_000), 0)
    assert [body.valid for body in decode(client.hear(), (3, 1)).bodies] == [True, False]


def test_a_body_whose_process_is_late_is_not_tracked_in_one_frame_and_is_in_time_in_the_next(start) -> None:
    one = Streaming(0, (4, 1), False)
    lab, client = start(lambda lab: VirtualMotive(one, 3, lab.readers))
    client.connect()

    def expose(body: int, count: int) -> None:
        """Clocks of their own, which began at different times."""
        frame = replace(seen(10 * count + body), t_us=1_000_000 * body + 10_000 * count)
        lab.motive.stream_frame(body, frame, frame.t_us, None, 50_000_000 - 1_000_000 * body)

    for body in (3, 1):
        expose(body, 1)
    assert client.hears_nothing()
    expose(1, 2)
    late = decode(client.hear(), (4, 1))
    assert [(body.id, body.valid) for body in late.bodies] == [(1, True), (2, False), (3, True)]
    assert late.bodies[2].p == pytest.approx(FROM_MOTIVE.T @ seen(13).p_WB, abs=1e-6)
    for body, count in ((2, 1), (3, 2)):
        expose(body, count)
    assert client.hears_nothing()
    expose(2, 2)
    bodies = decode(client.hear(), (4, 1)).bodies
    assert [body.valid for body in bodies] == [True] * 3
    assert bodies[1].p == pytest.approx(FROM_MOTIVE.T @ seen(22).p_WB, abs=1e-6)
    assert client.hears_nothing()


@pytest.mark.parametrize(("off_us", "frames"), [(-5001, []), (-5000, [2]), (5000, [2]), (5001, [1])])
def test_poses_of_half_a_period_apart_are_of_one_exposure(start, off_us: int, frames: list[int]) -> None:
    """What is older is dropped, and what is newer begins the next frame."""
    one = Streaming(0, (4, 1), False)
    lab, client = start(lambda lab: VirtualMotive(one, 2, lab.readers, period_us=10_000))
    client.connect()
    for body, t_us in ((1, 1_000_000), (2, 1_000_000 + off_us)):
        lab.motive.stream_frame(body, replace(seen(body), t_us=t_us), t_us)
    heard = []
    while not client.hears_nothing():
        heard.append(sum(body.valid for body in decode(client.hear(), (4, 1)).bodies))
    assert heard == frames


def test_the_server_info_names_the_release_of_each_protocol_and_the_group_of_multicast(start) -> None:
    for version, release in (((3, 1), (2, 2, 0, 0)), ((4, 1), (3, 1, 0, 0))):
        for multicast, group in ((False, "0.0.0.0"), (True, MULTICAST_GROUP)):
            _, client = start(version=version, multicast=multicast)
            client.say(MessageId.CONNECT)
            info = decode(client.hear(), (4, 1))
            assert (info.app_version, info.multicast, info.group) == (release, multicast, group)


def test_the_bitstream_is_changed_for_the_client_that_asks(lab: MotiveBench, client: NatNetSocket) -> None:
    client.connect()
    client.say(MessageId.REQUEST, b"Bitstream\0")
    assert client.hear() == packet(MessageId.RESPONSE, b"Bitstream,4.1.0\0")
    client.say(MessageId.REQUEST, b"Bitstream,3.1\0")
    assert client.hear() == packet(MessageId.RESPONSE, struct.pack("<i", 0))
    for number in (1, 2):
        lab.expose()
        assert decode(client.hear(), (3, 1)).number == number
        client.say(MessageId.KEEPALIVE)
    client.say(MessageId.REQUEST, b"Bitstream,2.9\0")
    assert client.hear() == packet(MessageId.RESPONSE, struct.pack("<i", -1))
    client.say(MessageId.REQUEST, b"StartRecording\0")
    assert client.hear() == packet(MessageId.UNRECOGNIZED)


def test_frames_end_with_the_disconnect(lab: MotiveBench, client: NatNetSocket) -> None:
    client.connect()
    client.say(MessageId.DISCONNECT)
    lab.expose()
    assert client.hears_nothing()


def test_a_seventeenth_client_displaces_the_longest_silent_one(lab: MotiveBench) -> None:
    clients = [NatNetSocket(lab) for _ in range(MAX_CLIENTS + 1)]
    for client in clients[:-1]:
        client.connect()
    clients[0].say(MessageId.KEEPALIVE)
    lab.expose()
    assert [bool(client.hear()) for client in clients[:-1]] == [True] * MAX_CLIENTS
    clients[-1].connect()
    lab.expose()
    assert [not client.hears_nothing() for client in clients] == [True, False] + [True] * (MAX_CLIENTS - 1)
    for client in clients:
        client.close()


def test_unreadable_packets_are_counted_and_not_answered(lab: MotiveBench, client: NatNetSocket) -> None:
    longest = b"StartRecording".ljust(256, b"\0")
    client.say(MessageId.REQUEST, longest)
    assert client.hear() == packet(MessageId.UNRECOGNIZED)
    broken = [b"", b"\0", packet(MessageId.FRAME), packet(MessageId.ECHO_REQUEST, b"short")]
    broken.append(packet(MessageId.REQUEST, longest + b"\0"))
    for data in (*broken, packet(MessageId.REQUEST, b"Bitstream")[:-1], b"\xff" * 2048):
        client.send(data)
    assert lab.motive.malformed == len(broken) + 2
    assert client.hears_nothing()


@pytest.mark.long
def test_no_bytes_stop_the_server(lab: MotiveBench, client: NatNetSocket) -> None:
    @settings(max_examples=300, deadline=None)
    @given(st.sampled_from([*MessageId, 3000]), st.binary(max_size=40), st.integers(-3, 3))
    def fuzz(message: int, payload: bytes, wrong: int) -> None:
        size = max(0, len(payload) + wrong)
        client.send(message.to_bytes(2, "little") + size.to_bytes(2, "little") + payload)

    fuzz()
    while not client.hears_nothing():
        client.hear()
    client.say(MessageId.CONNECT)
    assert decode(client.hear(), (4, 1)).name == "Motive"


def test_a_taken_port_is_one_line(lab: MotiveBench) -> None:
    with pytest.raises(
        LabError, match=rf"^natnet port {lab.motive.port}: Address already in use; --set capture.port=0 takes"
    ):
        VirtualMotive(Streaming(lab.motive.port, (4, 1), False), 1, {})


@pytest.mark.parametrize("interface", [HOST, "0.0.0.0"], ids=["loopback", "any"])
def test_a_group_member_on_either_interface_gets_each_frame_once(interface: str) -> None:
    """On any: the kernel takes the interface of the route, as for Bitcraze's scripts with libmotioncapture."""
    lab = MotiveBench(multicast=True)
    member = socket.inet_aton(MULTICAST_GROUP) + socket.inet_aton(interface)
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as client:
        client.bind(("", lab.motive.data_port))
        try:
            client.setsockopt(socket.IPPROTO_IP, socket.IP_ADD_MEMBERSHIP, member)
        except OSError as error:
            pytest.skip(f"no route for {MULTICAST_GROUP}: {error}")
        client.settimeout(0.5)
        for _ in range(3):
            lab.expose()
        heard = [decode(client.recv(65536), (4, 1)).number for _ in range(3)]
        assert heard == [1, 2, 3]
        assert not select.select([client], (), (), 0)[0]
    lab.motive.close()


@pytest.mark.realtime
@pytest.mark.parametrize(
    "name", [pytest.param(name, marks=needs(name)) for name in ("natnet", "motioncapture", "ground_station")]
)
@pytest.mark.parametrize(
    ("version", "multicast"), [((3, 1), False), ((4, 1), True)], ids=["unicast", "multicast"]
)
def test_every_client_sees_the_pose(name: str, version: tuple[int, int], multicast: bool) -> None:
    lab = MotiveBench(version, multicast, markers=True)
    assert_poses(lab, name, "multicast" if multicast else "unicast", "20")


@pytest.mark.realtime
@needs("natnet")
@pytest.mark.parametrize("version", [(3, 1), (4, 1)], ids=["3.1", "4.1"])
def test_an_unmodified_client_sees_the_markers(version: tuple[int, int]) -> None:
    lab = MotiveBench(version, markers=True)
    (described,), *rows = rows_of_client(lab, "natnet-markers", "unicast", "10")
    names = [f"Marker{number}" if version >= (4, 0) else None for number in range(1, 9)]
    assert [name for name, _ in described] == names
    assert np.array([p for _, p in described]) @ FROM_MOTIVE.T == pytest.approx(PLACES, abs=1e-6)
    assert len(rows) == 10
    for number, errors, labelled, unlabelled in rows:
        expected = sighted(number)
        assert errors == pytest.approx([expected.error])
        assert [(model, row) for model, row, *_ in labelled] == [(1, row) for row in range(1, 9)]
        points = np.array([p for _, _, p, _, _ in labelled]) @ FROM_MOTIVE.T
        assert points == pytest.approx(expected.points, abs=1e-6)
        assert [not occluded for *_, occluded, _ in labelled] == expected.seen.tolist()
        assert [residual for *_, residual in labelled] == pytest.approx(expected.residuals)
        ghosts = np.reshape(unlabelled, (-1, 3)) @ FROM_MOTIVE.T
        assert ghosts == pytest.approx(expected.ghosts, abs=1e-6)


def rows_of_client(lab: MotiveBench, name: str, how: str, count: str) -> list[list[Any]]:
    """Run a client until it has what it wants; returns what it printed."""
    script = str(SUPPORT / "natnet_clients.py")
    command = [sys.executable, script, name, str(lab.motive.port), how, count]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE)
    try:
        lab.run(lambda: process.poll() is not None)
        out, errors = process.communicate()
    finally:
        process.kill()
        process.wait()
        lab.motive.close()
    assert process.returncode == 0, errors.decode()
    return [json.loads(line) for line in out.splitlines() if line.startswith(b"[")]  # clients chat


def assert_poses(lab: MotiveBench, name: str, how: str, count: str) -> None:
    """The poses that a client has; each is that of the frame that it names, or of one at all."""
    rows = rows_of_client(lab, name, how, count)
    assert len(rows) == int(count)
    for number, body, p, q, tracked in rows:
        assert (body, tracked) == ("floaty", True)
        p_WB = FROM_MOTIVE @ p
        if number is None:
            numbers = range(1, lab.number + 1)
            number = min(numbers, key=lambda number: np.linalg.norm(seen(number).p_WB - p_WB))
        frame = seen(number)
        assert p_WB == pytest.approx(frame.p_WB, abs=1e-6)
        R_WB = Rotation.from_quat(np.roll(frame.q_WB, -1)).as_matrix()
        assert FROM_MOTIVE @ Rotation.from_quat(q).as_matrix() @ FROM_MOTIVE.T == pytest.approx(
            R_WB, abs=1e-5
        )
