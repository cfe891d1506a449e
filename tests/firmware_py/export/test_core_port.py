"""The exported app executes the core call by call for a host: each request once, whatever the link does to packets."""

import struct
from contextlib import nullcontext
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from typing import Any
from zlib import crc32

import pytest

from firmware_py.config import parameters_of
from firmware_py.core.structs import Estimator, Input, Parameters
from firmware_py.core_runner import CoreBlocks, default_runner
from firmware_py.export.c99 import translate
from firmware_py.export.profile_c import profile_hash
from firmware_py.wire import WireError
from firmware_py.wire.core_port import (
    ABOUT,
    CALLED,
    HEALTH,
    LAYOUTS,
    NAME_SIZE,
    PORT_CORE,
    READ_MAX,
    VERSION,
    WHY,
    WRITE_MAX,
    About,
    Call,
    CoreAnswer,
    Hil,
    Message,
    Refusal,
    call,
    decode_answer,
    encode_request,
    health,
    hello,
    loop,
    read,
    write,
)
from firmware_py.wire.crtp import MAX_DATA, encode_ext_pose
from firmware_py.wire.supervisor import Cause, State
from ground_station.errors import LinkError
from ground_station.links.core_client import CoreClient
from hil.board.real_core import RealCore
from hil.config import load_config
from hil.deploy.check import check_flight
from hil.errors import LabError
from hil.laboratory.experiments import find_experiment
from hil.laboratory.faults import parse
from hil.laboratory.request import Request
from support.app_packets import AppPackets
from support.core_streams import MEMORY
from support.crazyflie_app import App, build_app
from support.own_logic import make_project

TICK = Parameters.dtype.itemsize + Input.dtype.itemsize + Estimator.dtype.fields["tick"][1]  # where it lies

POSE = encode_ext_pose((0.01, 0.0, 0.0), (1.0, 0.0, 0.0, 0.0), 40_000)[1:]


@pytest.fixture
def app(library: Path, tmp_path: Path) -> App:
    app = App(library, tmp_path / "copy.so")
    app.boot()
    return app


def ask(app: App, number: int, request: tuple[Message, bytes], session: int = 7) -> CoreAnswer | None:
    """Send one packet; None: it is not answered."""
    app.radio(encode_request(*request, session, number), PORT_CORE, 0)
    packet = app.sent()
    assert app.sent() == b""
    return decode_answer(packet[1:]) if packet else None


def begun(app: App) -> App:
    """A session with the profile's parameters in memory, the estimator started: three requests and more are done."""
    ask(app, 0, hello())
    data = parameters_of(load_config()).bytes()
    pieces = [write(offset, data[offset : offset + WRITE_MAX]) for offset in range(0, len(data), WRITE_MAX)]
    for number, request in enumerate((*pieces, call(Call.RESET))):
        assert ask(app, number, request).kind == request[0]
    return app


BEGUN = -(-Parameters.dtype.itemsize // WRITE_MAX) + 1  # requests of `begun`


def ticks(app: App, number: int) -> int:
    return struct.unpack("<i", ask(app, number, read(TICK, 4)).body)[0]


@pytest.mark.long
def test_a_session_begins_with_what_is_on_board_and_memory_of_zeros(app: App) -> None:
    about = ask(app, 0, hello()).about()
    assert f'"{about.core}' in translate().header
    assert profile_hash(load_config()).startswith(about.profile)
    assert len(about.core) == len(about.profile) == NAME_SIZE
    assert (about.done, about.state, about.clock_mhz) == (0, State.CALIBRATING, 168)
    blocks = CoreBlocks(parameters_of(load_config()), default_runner)
    assert about.size == sum(len(block.bytes()) for block in blocks.named.values())
    assert ask(app, 0, read(about.size - READ_MAX, READ_MAX)).body == bytes(READ_MAX)


@pytest.mark.long
def test_a_call_is_answered_with_cycles_and_the_digest_of_all_memory(app: App) -> None:
    blocks = CoreBlocks(parameters_of(load_config()), default_runner)
    blocks.run.call("reset")
    begun(app)
    app.cycles.value = 4321
    blocks.run.call("estimate")
    called = ask(app, BEGUN, call(Call.ESTIMATE)).called()
    assert called.digest == crc32(b"".join(block.bytes() for block in blocks.named.values()))
    assert (called.answer, called.cycles) == (0, 4321)
    assert app.suspended.value == 0


def test_a_call_that_comes_again_is_answered_again_and_not_executed(app: App) -> None:
    begun(app)
    first = ask(app, BEGUN, call(Call.ESTIMATE))
    assert ask(app, BEGUN, call(Call.ESTIMATE)) == first
    assert ticks(app, BEGUN + 1) == 1


def test_a_write_that_was_long_on_its_way_writes_nothing(app: App) -> None:
    begun(app)
    late = write(TICK, struct.pack("<i", 77))
    ask(app, BEGUN, write(TICK, struct.pack("<i", 5)))
    ask(app, BEGUN + 1, call(Call.ESTIMATE))
    assert ask(app, BEGUN, late).kind == Message.WRITE
    assert ticks(app, BEGUN + 2) == 6


def test_an_older_call_that_comes_late_is_neither_executed_nor_answered(app: App) -> None:
    begun(app)
    ask(app, BEGUN, call(Call.ESTIMATE))
    ask(app, BEGUN + 1, call(Call.ESTIMATE))
    assert ask(app, BEGUN, call(Call.ESTIMATE)) is None
    assert ticks(app, BEGUN + 2) == 2


def test_behind_a_lost_request_nothing_is_executed_or_answered(app: App) -> None:
    begun(app)
    assert ask(app, BEGUN + 1, call(Call.ESTIMATE)) is None
    assert ticks(app, BEGUN) == 0


@pytest.mark.long
def test_numbers_go_on_behind_65535(app: App) -> None:
    ask(app, 0, hello())
    for number in range(65_540):
        answer = ask(app, number, write(TICK, struct.pack("<i", number)))
        assert answer.number == number & 0xFFFF
    assert ticks(app, 65_540) == 65_539


def test_a_second_hello_of_a_session_changes_nothing(app: App) -> None:
    begun(app)
    ask(app, BEGUN, call(Call.ESTIMATE))
    assert ask(app, 0, hello()).about().done == BEGUN + 1
    assert ticks(app, BEGUN + 1) == 1


def test_a_new_session_ends_the_old_one(app: App) -> None:
    begun(app)
    assert ask(app, 0, hello(), session=8).about().done == 0
    assert ask(app, BEGUN, call(Call.ESTIMATE)).refusal() == Refusal.NO_SESSION


@pytest.mark.parametrize(
    "request_",
    [
        read(MEMORY - 3, 4), read(0, READ_MAX + 1), write(MEMORY - 3, bytes(4)),
        (Message.CALL, bytes((len(Call),))), (Message.CALL, b""),
        (Message.WRITE, b"\0"), (Message.READ, b"\0\0"), (9, b""),
    ],
)  # fmt: skip
def test_requests_outside_are_refused_and_take_no_number(app: App, request_: tuple[Message, bytes]) -> None:
    begun(app)
    assert ask(app, BEGUN, request_).refusal() == Refusal.OUTSIDE
    assert ask(app, 0, hello()).about().done == BEGUN
    assert ticks(app, BEGUN) == 0


def step(app: App, steps: range, *, poses: bool = False) -> None:
    for now in steps:
        if poses and now % 20 == 0:
            app.radio(POSE)
        app.step(now)


@pytest.fixture
def flown(app: App) -> App:
    """In the air, and its poses have stopped."""
    begun(app)
    step(app, range(1, 1001), poses=True)
    assert app.supervisor.state == State.FLYING
    assert ask(app, BEGUN, call(Call.ESTIMATE)).refusal() == Refusal.FLYING
    step(app, range(1001, 2001))
    assert app.supervisor.cause == Cause.SILENCE
    return app


def test_a_call_touches_nothing_that_flies(app: App) -> None:
    flies = app.estimator()
    begun(app)
    ask(app, BEGUN, call(Call.ESTIMATE))
    assert app.estimator() == flies


def test_a_board_in_failsafe_in_the_air_executes_nothing(flown: App) -> None:
    for request in (call(Call.ESTIMATE), loop(Hil.STILL), read(0, 4), write(0, b"\0")):
        assert ask(flown, BEGUN, request).refusal() == Refusal.FLYING
    assert ask(flown, BEGUN, health()).kind == Message.HEALTH


@pytest.mark.parametrize("parameter", ["armed", "stop"])
def test_disarmed_or_stopped_for_five_seconds_a_board_serves_again(flown: App, parameter: str) -> None:
    flown.set(f"floaty.{parameter}", parameter == "stop")
    step(flown, range(2001, 7000))
    assert ask(flown, BEGUN, read(0, 4)).refusal() == Refusal.FLYING
    step(flown, range(7000, 7011))
    assert ask(flown, BEGUN, read(0, 4)).kind == Message.READ
    flown.set(f"floaty.{parameter}", parameter != "stop")
    step(flown, range(7011, 7021))
    assert ask(flown, BEGUN + 1, read(0, 4)).refusal() == Refusal.FLYING


def test_while_flaps_are_moved_by_hand_nothing_is_executed(app: App) -> None:
    begun(app)
    app.set("extCtrl.manual", 1)
    step(app, range(1, 21))
    assert ask(app, BEGUN, read(0, 4)).refusal() == Refusal.FLYING
    app.set("extCtrl.manual", 0)
    step(app, range(21, 41))
    assert ask(app, BEGUN, read(0, 4)).kind == Message.READ


def test_a_board_that_restarted_by_itself_may_be_in_the_air(library: Path, tmp_path: Path) -> None:
    app = App(library, tmp_path / "copy.so")
    app.after_watchdog.value = 1
    app.boot()
    ask(app, 0, hello())
    step(app, range(1, 11))
    assert ask(app, 0, read(0, 4)).refusal() == Refusal.FLYING


def test_with_hardware_in_the_loop_no_call_stops_the_scheduler(app: App) -> None:
    begun(app)
    answer = ask(app, BEGUN, loop(Hil.STILL))
    assert (answer.kind, answer.body) == (Message.LOOP, b"")
    step(app, range(1, 3))
    while app.sent():
        pass
    assert ask(app, BEGUN + 1, call(Call.ESTIMATE)).refusal() == Refusal.LOOP
    assert ticks(app, BEGUN + 1) == 0


def test_health_has_the_gyro_s_counts_by_axis(app: App) -> None:
    begun(app)
    app.gyro[:], app.gyro_noise = (11, -22, 33), 0
    app.step(1)
    report = ask(app, BEGUN, health()).health()
    assert (report.gyro_x, report.gyro_y, report.gyro_z) == (11, -22, 33)


def test_a_packet_without_a_head_or_on_another_channel_is_not_answered(app: App) -> None:
    app.radio(b"\0\7\0", PORT_CORE, 0)
    app.radio(encode_request(*hello(), 7, 0), PORT_CORE, 1)
    assert app.sent() == b""
    assert ask(app, 0, hello(), session=0).refusal() == Refusal.NO_SESSION
    with pytest.raises(WireError):
        decode_answer(b"\0\7\0")


def test_every_layout_is_as_long_in_c(tmp_path: Path, library: Path) -> None:
    header = (library.parent / "src" / "floaty_wire.h").read_text()
    sizes = {"uint8_t": 1, "int8_t": 1, "int16_t": 2, "char": NAME_SIZE, "uint16_t": 2, "uint32_t": 4}
    for layout in LAYOUTS:
        body = header.split(f"}} __attribute__((packed)) FloatyWire{layout.name};")[0].rsplit("{", 1)[1]
        assert layout.struct.size == sum(sizes[line.split()[0]] for line in body.strip().splitlines())


# The host's end


def client_of(app: App, mess: float = 0.0) -> tuple[CoreClient, AppPackets]:
    packets = AppPackets(app, mess)
    return CoreClient(packets, "app"), packets


class ShortAnswers(AppPackets):
    """A board whose answers end too early."""

    def __init__(self, kind: Message, size: int) -> None:
        self.kind, self.body = kind, bytes(size)

    def send(self, data: bytes) -> None:
        self.request = data

    def receive(self, timeout_s: float) -> bytes | None:
        return bytes((self.kind,)) + self.request[1:4] + self.body


class Silence(AppPackets):
    """A board that does not answer."""

    def __init__(self) -> None:
        self.waits_s: list[float] = []
        self.requests = 0

    def send(self, data: bytes) -> None:
        self.requests += 1

    def receive(self, timeout_s: float) -> bytes | None:
        self.waits_s.append(timeout_s)
        return None


def test_a_board_s_own_result_flies_where_it_is_another_than_here() -> None:
    ours = CoreBlocks(parameters_of(load_config()), default_runner)
    size = sum(block.memory.nbytes for block in ours.named.values())
    theirs = bytes(number % 127 for number in range(size))
    board: Any = SimpleNamespace(
        begin=lambda: About(VERSION, 0, size, 0, 168, "", ""),
        execute=lambda requests: [CoreAnswer(Message.CALL, 1, 0, CALLED.struct.pack(1, 336, crc32(theirs)))],
        memory=lambda asked: theirs[:asked],
    )
    core = RealCore(ours, board)
    for calls in (1, 2):
        assert core.call("supervise") == 1
        assert b"".join(block.memory.tobytes() for block in ours.named.values()) == theirs
        assert (core.unexpected, core.load["supervise"].calls) == (calls, calls)


@pytest.mark.long
def test_a_flight_on_the_app_equals_python_bitwise_whatever_is_lost(app: App) -> None:
    client, _ = client_of(app, 0.1)
    request = Request.of(find_experiment("hover"), duration_s=2.0, faults=(parse("mocap.outlier@1"),))
    checked = check_flight(request, lambda stack: {"app": partial(RealCore, client=client)}, lambda *_: None)
    (target,) = checked.targets
    assert checked.equal
    assert (checked.outcome, target.ticks) == ("completed", 300)
    assert target.calls > 700
    assert client.repeated > 100


@pytest.mark.long
def test_the_board_s_results_fly_even_where_they_are_wrong(tmp_path: Path) -> None:
    folder = tmp_path / "app"
    library = build_app(
        folder, plant=("floaty_core.c", "control->count[flap] =", "control->count[flap] = 1 +")
    )
    app = App(library, tmp_path / "copy.so")
    app.boot()
    client, _ = client_of(app)
    blocks = CoreBlocks(parameters_of(load_config()), partial(RealCore, client=client))
    right = CoreBlocks(parameters_of(load_config()), default_runner)
    for core in (blocks, right):
        core.run.call("reset")
        core.run.call("control")
    assert blocks.control.fields.count.tolist() == [count + 1 for count in right.control.fields.count]
    assert blocks.run.unexpected == 1


def test_measured_cycles_become_processor_time_whatever_is_changed_before_the_call(app: App) -> None:
    client, _ = client_of(app)
    app.cycles.value = 168 * 100 + 1
    blocks = CoreBlocks(parameters_of(load_config()), partial(RealCore, client=client))
    right = CoreBlocks(parameters_of(load_config()), default_runner)
    for core in (blocks, right):
        core.run.call("reset")
        core.run.call("estimate")
    assert blocks.run.control_us() == 101  # executed ahead on the board ...
    for core in (blocks, right):
        core.data.fields.mode = 1  # ... on other inputs than it then gets
        core.run.call("control")
    assert [block.bytes() for block in blocks.named.values()] == [
        block.bytes() for block in right.named.values()
    ]
    calls = {name: load.calls for name, load in blocks.run.load.items() if load.calls}
    assert calls == {"reset": 1, "estimate": 1, "control": 1}
    assert client.sent > 0


def test_an_estimate_is_charged_with_the_poses_filed_before_it(app: App) -> None:
    client, _ = client_of(app)
    blocks = CoreBlocks(parameters_of(load_config()), partial(RealCore, client=client))
    blocks.run.call("reset")
    app.cycles.value = 168 * 50
    blocks.run.call("file_pose")
    assert blocks.run.estimate_us() == 100
    blocks.run.call("estimate")
    assert blocks.run.estimate_us() == 50


def test_a_reboot_is_distinguished_from_silence(app: App, library: Path, tmp_path: Path) -> None:
    client, packets = client_of(app)
    client.begin()
    packets.app = App(library, tmp_path / "rebooted.so")
    packets.app.boot()
    with pytest.raises(LinkError, match=r"^app: it has rebooted, or another program uses it$"):
        client.execute([call(Call.RESET)])
    packets.silent = True
    with pytest.raises(LinkError, match=r"^app: silent for 3 s$"):
        client.begin()


def test_a_full_transmit_queue_on_board_only_delays(app: App) -> None:
    client, packets = client_of(app)
    client.begin()
    receive = packets.receive

    def empties(timeout_s: float) -> bytes | None:
        answer = receive(timeout_s)
        app.transmit_full.value = answer is not None
        return answer

    app.transmit_full.value = 1
    packets.receive = empties
    assert len(client.memory(200)) == 200
    assert client.repeated > 0


def test_no_more_requests_are_under_way_than_the_boards_queue_holds(app: App) -> None:
    client, packets = client_of(app)
    client.begin()
    under_way, most = [0], [0]
    send, receive = packets.send, packets.receive

    def counted_send(data: bytes) -> None:
        under_way[0] += 1
        most[0] = max(most[0], under_way[0])
        send(data)

    def counted_receive(timeout_s: float) -> bytes | None:
        answer = receive(timeout_s)
        under_way[0] -= answer is not None
        return answer

    packets.send, packets.receive = counted_send, counted_receive
    client.memory(MEMORY)
    assert most[0] == 4  # RADIOLINK_CRTP_QUEUE_SIZE is 5, and an assert in the firmware guards it


def test_a_session_number_that_was_in_use_is_not_taken(app: App) -> None:
    client, _ = client_of(app)
    client.begin()
    client.execute([call(Call.RESET)])
    client._session -= 1  # an earlier program had the number that would come next
    assert client.begin().done == 0
    assert client.execute([read(0, 4)])[0].body == bytes(4)


class Hello(AppPackets):
    """A board that answers with this, after packets that answer nothing."""

    def __init__(self, about: tuple[int, ...]) -> None:
        self.about, self.heard, self.waiting = about, 0, list[bytes]()

    def send(self, data: bytes) -> None:
        self.heard += 1
        head = bytes((Message.HELLO,)) + data[1:4]
        self.waiting = [
            b"\0\7",
            head[:1] + bytes((data[1] ^ 1,)) + head[2:],
            head + struct.pack("<BBHH", *self.about).ljust(ABOUT.struct.size, b"\0"),
        ]

    def receive(self, timeout_s: float) -> bytes | None:
        return self.waiting.pop(0) if self.waiting else None


def test_an_app_of_another_protocol_or_without_a_free_session_is_refused_in_one_line() -> None:
    for version in (VERSION - 1, VERSION + 1):
        told = (
            rf"^app: its app has protocol version {version}, expected {VERSION}: export and flash it again$"
        )
        with pytest.raises(LinkError, match=told):
            CoreClient(Hello((version, 0, 4, 0)), "app").begin()
    used = Hello((VERSION, 0, 4, 1))
    with pytest.raises(LinkError, match=r"^app: it starts no session$"):
        CoreClient(used, "app").begin()
    assert used.heard == 255
    assert CoreClient(Hello((VERSION, 1, 4, 0)), "app").begin().size == 4


def test_requests_are_repeated_ever_more_seldom_until_three_seconds_are_silent() -> None:
    silence = Silence()
    with pytest.raises(LinkError, match=r"^app: silent for 3 s$"):
        CoreClient(silence, "app").execute([call(Call.RESET), read(0, 4)])
    assert silence.waits_s == pytest.approx([0.1, 0.2, *[0.4] * 7])
    assert silence.requests == 2 * (1 + 8)


class Slow(AppPackets):
    """A board whose every answer is waited for seven times, 2.3 s together."""

    def __init__(self) -> None:
        self.heard, self.waits = dict[bytes, None](), 0

    def send(self, data: bytes) -> None:
        self.heard[data[:4]] = None

    def receive(self, timeout_s: float) -> bytes | None:
        self.waits += 1
        if self.waits % 8:
            return None
        head = [*self.heard][self.waits // 8 - 1]
        return bytes((Message.CALL,)) + head[1:] + bytes(CALLED.struct.size)


def test_silence_counts_from_the_last_answer_on() -> None:
    answers = CoreClient(Slow(), "app").execute([call(Call.RESET)] * 3)
    assert [answer.kind for answer in answers] == [Message.CALL] * 3


def asked(client: CoreClient, kind: Message) -> None:
    """Send a request of a kind."""
    bodies = {Message.READ: read(0, 5)[1]}
    client.begin() if kind == Message.HELLO else client.execute([(kind, bodies.get(kind, b""))])


@pytest.mark.parametrize(
    ("kind", "size"),
    [
        (Message.HELLO, ABOUT.struct.size), (Message.CALL, CALLED.struct.size), (Message.READ, 5),
        (Message.HEALTH, HEALTH.struct.size), (Message.REFUSED, WHY.struct.size),
    ],
)  # fmt: skip
def test_an_answer_that_lacks_its_last_byte_is_one_line_and_not_silence(kind: Message, size: int) -> None:
    with pytest.raises(
        LinkError, match=rf"^app: {size - 1} bytes behind the head: at least {size} are expected$"
    ):
        asked(CoreClient(ShortAnswers(kind, size - 1), "app"), kind)


@pytest.mark.parametrize("kind", [kind for kind in Message if kind != Message.REFUSED])
@pytest.mark.parametrize("answer", [kind for kind in Message if kind != Message.HELLO])
def test_an_answer_is_of_the_kind_that_was_asked_for_or_a_refusal(kind: Message, answer: Message) -> None:
    wrong = f"an answer of kind {answer} to a request of kind {kind}"
    expected = {kind: None, Message.REFUSED: "it refuses a request"}.get(answer, wrong)
    with pytest.raises(LinkError) if expected else nullcontext() as raised:
        asked(CoreClient(ShortAnswers(answer, MAX_DATA), "app"), kind)
    assert raised is None or str(raised.value) == f"app: {expected}"


class TwiceGreeted(AppPackets):
    """The link to a board whose answer to HELLO comes twice."""

    def send(self, data: bytes) -> None:
        super().send(data)
        if data[0] == Message.HELLO:
            super().send(data)


def test_a_late_answer_to_hello_does_not_answer_the_first_request(app: App) -> None:
    client = CoreClient(TwiceGreeted(app), "app")
    client.begin()
    assert client.memory(READ_MAX) == bytes(READ_MAX)


def test_a_core_of_another_layout_is_refused_in_one_line(app: App, tmp_path: Path) -> None:
    client, _ = client_of(app)
    request = Request.of(find_experiment("hover"), profile=str(make_project(tmp_path)), duration_s=0.5)
    with pytest.raises(
        LabError, match=rf"^app: its core has {MEMORY} B of memory, this one \d+: export and flash it again$"
    ):
        check_flight(request, lambda stack: {"app": partial(RealCore, client=client)}, lambda *_: None)
