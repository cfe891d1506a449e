"""GDB's remote serial protocol, byte by byte, as its manual describes it (appendix "Remote Protocol")."""

import re
import socket
import xml.etree.ElementTree as ElementTree
from collections.abc import Callable, Iterator
from struct import pack, unpack_from
from types import SimpleNamespace as Made
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

pytest.importorskip("unicorn")

from hil.emulator.stm32f405.backwards import Goal, Position, Search
from hil.emulator.stm32f405.checkpoints import Checkpoints
from hil.emulator.stm32f405.chip import CYCLES_PER_US, FLASH, Chip, StopReason
from hil.emulator.stm32f405.debugged_chip import DebuggedChip
from hil.emulator.stm32f405.freertos import FreeRtos
from hil.emulator.stm32f405.gdb import GdbServer
from hil.emulator.stm32f405.gdb_protocol import (
    PACKET_SIZE,
    REGISTERS,
    SIGINT,
    SIGTRAP,
    RemoteProtocol,
    ResumeRequest,
    framed,
)
from hil.emulator.stm32f405.image import Image
from hil.errors import LabError
from support import stm32_firmware
from support.stm32_bench import Bench
from support.stm32_machine import FirmwareOnChip

RAM = 0x2000_0000
ASSERTION = 3  # of `enum planted`


@pytest.fixture(scope="module")
def image() -> Image:
    return Image(stm32_firmware.build())


@pytest.fixture
def machine() -> Chip:
    return FirmwareOnChip().chip


@pytest.fixture(scope="module")
def lasting() -> Chip:
    return FirmwareOnChip().chip


@pytest.fixture
def protocol(machine: Chip) -> RemoteProtocol:
    return RemoteProtocol(machine)


def ask(protocol: RemoteProtocol, payload: bytes) -> bytes:
    answer = protocol.receive(framed(payload))
    assert answer[:2] == b"+$", answer
    assert answer[-3:] == b"#%02x" % (sum(answer[2:-3]) % 256)
    return re.sub(rb"}(.)", lambda escaped: bytes((escaped[1][0] ^ 0x20,)), answer[2:-3], flags=re.DOTALL)


def test_a_packet_has_the_checksum_of_its_bytes() -> None:
    # The manual's example of an empty answer, and sums by hand.
    assert framed(b"") == b"$#00"
    assert framed(b"OK") == b"$OK#9a"
    assert framed(b"a#b") == b"$a}\x03b#43"


@settings(max_examples=25)
@given(cuts=st.lists(st.integers(1, 20), max_size=12))
def test_packets_may_arrive_in_pieces(lasting: Chip, cuts: list[int]) -> None:
    protocol = RemoteProtocol(lasting)
    stream = b"+" + framed(b"qAttached") + b"+" + framed(b"p0f") + b"+" + framed(b"m20000000,4")
    answers = b""
    for cut in cuts:
        answers += protocol.receive(stream[:cut])
        stream = stream[cut:]
    answers += protocol.receive(stream)
    pc = lasting.register("pc")
    assert answers == b"+" + framed(b"1") + b"+" + framed(pack("<I", pc).hex().encode()) + b"+" + framed(
        b"00000000"
    )


def test_a_wrong_checksum_is_asked_for_again_and_an_answer_repeated(protocol: RemoteProtocol) -> None:
    assert protocol.receive(b"$?#00") == b"-"
    assert protocol.receive(b"$?#3f") == b"+$T05thread:1;#d7"
    assert protocol.receive(b"-") == b"$T05thread:1;#d7"
    assert protocol.receive(b"+") == b""


def test_ctrl_c_interrupts_only_a_machine_that_runs(protocol: RemoteProtocol) -> None:
    assert protocol.receive(b"\x03") == b""
    assert not protocol.interrupted
    protocol.receive(framed(b"c"))
    protocol.receive(b"\x03")
    assert protocol.interrupted


def test_without_acknowledgements_only_answers_are_sent(protocol: RemoteProtocol) -> None:
    assert ask(protocol, b"QStartNoAckMode") == b"OK"
    assert protocol.receive(framed(b"?")) == framed(b"T05thread:1;")
    assert protocol.receive(b"$?#00") == b""


def test_unknown_packets_get_an_empty_answer(protocol: RemoteProtocol) -> None:
    for packet in b"vMustReplyEmpty X20000000,0: G00 qTStatus R00 b Z5,20000000,4 QPassSignals: _".split():
        assert ask(protocol, packet) == b""


@pytest.mark.long
@pytest.mark.parametrize(
    "packet", [b"m", b"m,", b"m20000000", b"mxyz,4", b"p", b"pff", b"P0", b"P0=12", b"M20000000,4:00",
               b"M20000000,0:", b"Z0", b"Z1,", b"c-1", b"M20000000,1:zz"],
)  # fmt: skip
def test_malformed_packets_do_nothing(protocol: RemoteProtocol, machine: Chip, packet: bytes) -> None:
    before = ask(protocol, b"g")
    assert ask(protocol, packet) == b"E01"
    assert ask(protocol, b"g") == before
    assert machine.breakpoints == set()
    assert protocol.request is ResumeRequest.STOP


@settings(max_examples=25)
@given(st.lists(st.binary(max_size=30) | st.sampled_from([b"$", b"#", b"m", b"}"]), max_size=8))
def test_nothing_that_arrives_raises(lasting: Chip, pieces: list[bytes]) -> None:
    protocol = RemoteProtocol(lasting)
    for piece in pieces:
        protocol.receive(piece)
        protocol.receive(framed(piece))


def test_the_supported_features_are_those_that_are_there(protocol: RemoteProtocol) -> None:
    features = ask(protocol, b"qSupported:multiprocess+;swbreak+;hwbreak+").split(b";")
    assert b"PacketSize=%x" % PACKET_SIZE in features
    assert {b"QStartNoAckMode+", b"qXfer:features:read+"} <= set(features)
    assert (ask(protocol, b"qfThreadInfo"), ask(protocol, b"qsThreadInfo"), ask(protocol, b"qC")) == (
        b"m1",
        b"l",
        b"QC1",
    )


def test_the_target_description_numbers_the_registers_as_they_are_sent(protocol: RemoteProtocol) -> None:
    text, piece = b"", b"m"
    while piece[:1] == b"m":
        piece = ask(protocol, b"qXfer:features:read:target.xml:%x,64" % len(text))
        text += piece[1:]
    for size, more in ((len(text) - 1, b"m"), (len(text), b"l"), (len(text) + 1, b"l")):
        assert ask(protocol, b"qXfer:features:read:target.xml:0,%x" % size) == more + text[:size]
    root = ElementTree.fromstring(text)
    registers = [(r.get("name"), int(r.get("bitsize") or 0) // 8) for r in root.iter("reg")]
    assert registers == list(REGISTERS)
    assert [f.get("name") for f in root.iter("feature")] == [
        "org.gnu.gdb.arm.m-profile", "org.gnu.gdb.arm.vfp", "org.gnu.gdb.arm.m-system",
    ]  # fmt: skip
    assert [name for name, _ in registers[:17]] == [*(f"r{n}" for n in range(13)), "sp", "lr", "pc", "xpsr"]


def test_registers_are_read_together_written_singly(protocol: RemoteProtocol, machine: Chip) -> None:
    number = {name: index for index, (name, _) in enumerate(REGISTERS)}
    assert ask(protocol, b"P%x=78563412" % number["r7"]) == b"OK"
    assert ask(protocol, b"P%x=%s" % (number["d3"], pack("<d", -1.5).hex().encode())) == b"OK"
    assert (machine.register("r7"), machine.register("d3")) == (
        0x1234_5678,
        unpack_from("<Q", pack("<d", -1.5))[0],
    )
    assert ask(protocol, b"p%x" % number["r7"]) == b"78563412"
    everything = bytes.fromhex(ask(protocol, b"g").decode())
    assert len(everything) == sum(size for _, size in REGISTERS)
    assert everything[28:32] == bytes.fromhex("78563412")


def test_memory_is_read_and_written(protocol: RemoteProtocol) -> None:
    data = bytes(range(0x20, 0x30)) + b"}}*$#"
    assert ask(protocol, b"M20000100,%x:%s" % (len(data), data.hex().encode())) == b"OK"
    assert bytes.fromhex(ask(protocol, b"m20000100,%x" % len(data)).decode()) == data


def test_memory_that_is_not_there_is_an_error(protocol: RemoteProtocol) -> None:
    assert ask(protocol, b"m30000000,4") == b"E0e"
    assert ask(protocol, b"M30000000,1:00") == b"E0e"


def test_code_is_at_the_image_s_address(protocol: RemoteProtocol, image: Image) -> None:
    assert bytes.fromhex(ask(protocol, b"m8004000,800").decode()) == image.code[:0x800]


@pytest.fixture
def client(machine: Chip) -> Iterator[tuple[GdbServer, socket.socket]]:
    server = GdbServer(0)
    server.attach(machine)
    with socket.create_connection(("127.0.0.1", server.port)) as client:
        client.settimeout(10.0)
        yield server, client
    server.close()


def test_a_run_ends_in_front_of_a_breakpoint_and_a_step_behind_one_instruction(
    client: tuple[GdbServer, socket.socket], machine: Chip, image: Image
) -> None:
    server, line = client
    there = image.reset + 8
    line.sendall(framed(b"QStartNoAckMode") + framed(b"Z1,%x,2" % there) + framed(b"c"))
    assert server.hold() is ResumeRequest.RUN
    assert machine.register("pc") == image.reset
    line.sendall(framed(b"pf") + framed(b"s") + framed(b"pf") + framed(b"z1,%x,2" % there) + framed(b"D"))
    assert machine.run(1000 * CYCLES_PER_US) & StopReason.BREAK
    assert machine.register("pc") == there
    assert server.hold() is ResumeRequest.STEP
    machine.step()
    assert server.hold() is ResumeRequest.DETACH
    assert machine.register("pc") in (there + 2, there + 4)
    pcs = [framed(pack("<I", pc).hex().encode()) for pc in (there, machine.register("pc"))]
    stopped = framed(b"T05thread:1;")
    assert (
        line.recv(4096) == b"+" + framed(b"OK") * 2 + stopped + pcs[0] + stopped + pcs[1] + framed(b"OK") * 2
    )


def test_ctrl_c_stops_a_run(client: tuple[GdbServer, socket.socket], machine: Chip) -> None:
    server, line = client
    machine.write(RAM + 0x100, bytes.fromhex("fee7"))  # b .
    machine.set_register("pc", RAM + 0x100)
    line.sendall(framed(b"QStartNoAckMode") + framed(b"c"))
    assert server.hold() is ResumeRequest.RUN
    assert not server.wants_to_stop()
    line.sendall(b"\x03")
    assert server.wants_to_stop()
    line.sendall(framed(b"D"))
    assert server.hold(SIGINT) is ResumeRequest.DETACH
    assert line.recv(4096) == b"+" + framed(b"OK") + framed(b"T02thread:1;") + framed(b"OK")


def test_after_a_hang_up_the_machine_runs_and_accepts_another(
    client: tuple[GdbServer, socket.socket], machine: Chip, image: Image
) -> None:
    server, line = client
    line.sendall(framed(b"Z0,%x,2" % image.reset))
    line.shutdown(socket.SHUT_WR)
    assert server.hold() is ResumeRequest.DETACH
    assert machine.breakpoints == set()
    assert not server.wants_to_stop()
    with socket.create_connection(("127.0.0.1", server.port)) as other:
        other.sendall(b"+")
        assert server.wants_to_stop()
        other.sendall(framed(b"k"))
        assert server.hold() is ResumeRequest.KILL


class NotedCheckpoints(Checkpoints):
    """Notes what is done with them, and copies no process."""

    def __init__(self) -> None:
        super().__init__()
        self.done: list[str] = []

    def begin(self) -> None:
        self.done.append("begin")

    def clear(self) -> None:
        self.done.append("clear")

    def finish(self) -> None:
        self.done.append("finish")


@pytest.mark.parametrize("packet", [b"D", b"k", b""])
def test_checkpoints_begin_with_a_debugger_and_are_of_no_use_without_it(machine: Chip, packet: bytes) -> None:
    noted = NotedCheckpoints()
    server = GdbServer(0, checkpoints=noted)
    server.attach(machine)
    for _ in range(2):
        with socket.create_connection(("127.0.0.1", server.port)) as line:
            line.sendall(framed(packet) if packet else b"+")
            line.shutdown(socket.SHUT_WR)
            server.hold()
        assert not server.is_connected
        assert noted.done == ["begin", "clear"]
        noted.done.clear()
    server.close()
    assert noted.done == ["finish"]


def test_what_is_not_a_debugger_is_closed_and_writes_nothing(machine: Chip) -> None:
    server = GdbServer(0)
    server.attach(machine)
    before = machine.read(RAM + 0x100, 4)
    page, silent, debugger = (socket.create_connection(("127.0.0.1", server.port), 10.0) for _ in range(3))
    page.sendall(b"POST / HTTP/1.1\r\n\r\n" + framed(b"M20000100,4:deadbeef"))
    debugger.sendall(framed(b"D"))
    assert server.hold() is ResumeRequest.DETACH
    assert machine.read(RAM + 0x100, 4) == before
    for closed in (page, silent, debugger):
        closed.close()
    with socket.create_connection(("127.0.0.1", server.port)) as page:
        page.sendall(b"GET / HTTP/1.1\r\n")
        assert not server.wants_to_stop()
    server.close()


def test_leaving_removes_the_breakpoints(protocol: RemoteProtocol, machine: Chip) -> None:
    for packet in (b"Z0,8005000,2", b"Z0,8007000,2", b"z0,8005000,2", b"z0,8006000,2"):
        assert ask(protocol, packet) == b"OK"
    assert machine.breakpoints == {0x0800_7000}
    assert ask(protocol, b"D") == b"OK"
    assert machine.breakpoints == set()


def test_without_a_scheduler_there_is_one_thread(protocol: RemoteProtocol) -> None:
    answers = {b"qfThreadInfo": b"m1", b"qsThreadInfo": b"l", b"qC": b"QC1", b"T1": b"OK", b"T2": b"E01", b"Hg2": b"E01",
               b"Hg1": b"OK", b"Hg0": b"OK", b"Hc-1": b"OK", b"qThreadExtraInfo,1": b""}  # fmt: skip
    for packet, answer in answers.items():
        assert ask(protocol, packet) == answer, packet


def test_a_ninth_watchpoint_is_refused(protocol: RemoteProtocol) -> None:
    answers = [ask(protocol, b"Z2,200000%d0,4" % number) for number in range(9)]
    assert answers == [*8 * [b"OK"], b"E0e"]


def test_time_stops_while_gdb_asks(client: tuple[GdbServer, socket.socket], machine: Chip) -> None:
    server, line = client
    before = [machine.register(name) for name, _ in REGISTERS]
    line.sendall(b"".join(framed(b"m20000000,4") for _ in range(50)) + framed(b"c"))
    assert server.hold(SIGTRAP) is ResumeRequest.RUN
    assert [machine.register(name) for name, _ in REGISTERS] == before


def test_a_port_that_is_taken_is_refused() -> None:
    server = GdbServer(0)
    with pytest.raises(LabError, match=rf"--gdb {server.port}: Address already in use"):
        GdbServer(server.port)
    server.close()


def on_chip(
    packets: Callable[[Image], list[bytes]], end_us: int, **variables: int
) -> tuple[FirmwareOnChip, bytes]:
    """The firmware on the chip after a run with a debugger that sends these packets, and what it was answered."""
    machine = FirmwareOnChip(**variables)
    server = GdbServer(0)
    with socket.create_connection(("127.0.0.1", server.port)) as line:
        line.sendall(b"".join(map(framed, packets(machine.image))))
        try:
            machine.run_debugged(server, end_us)
            assert machine.chip.now_us >= end_us
        finally:
            server.close()
        answers = b"".join(iter(lambda: line.recv(1 << 16), b""))
    return machine, answers


def contents(answers: bytes) -> list[bytes]:
    return re.findall(rb"\$([^#]*)#", answers)


@pytest.mark.long
def test_a_breakpoint_where_crashes_are_reported_stops_for_both() -> None:
    machine, server = FirmwareOnChip(planted=ASSERTION), GdbServer(0)
    place = machine.image.symbol("assertFail").address
    machine.chip.crash_points.add(place)
    with socket.create_connection(("127.0.0.1", server.port)) as line:
        line.sendall(
            b"".join(map(framed, (b"QStartNoAckMode", b"Z0,%x,2" % place, b"c", b"p0f", b"c", b"D")))
        )
        chip = DebuggedChip(machine.chip, server)
        why = StopReason.SERIAL
        while why in (StopReason.SERIAL, StopReason.COMPARE):
            why = chip.run(100_000 * CYCLES_PER_US)
        server.close()
        answers = contents(b"".join(iter(lambda: line.recv(1 << 16), b"")))
    assert why == StopReason.BREAK  # the report's
    assert machine.chip.register("pc") == place
    assert answers[-2:] == [b"T05thread:1;", pack("<I", place).hex().encode()]


def test_a_step_that_ends_at_a_crash_leaves_its_report_to_the_next_run() -> None:
    bench, server = Bench(bytes.fromhex("00bf 00bf 00bf")), GdbServer(0)
    bench.chip.crash_points.add(FLASH + 10)
    with socket.create_connection(("127.0.0.1", server.port)) as line:
        line.sendall(b"".join(map(framed, (b"QStartNoAckMode", b"s", b"p0f", b"c"))))
        assert DebuggedChip(bench.chip, server).run(CYCLES_PER_US) == StopReason.BREAK
        server.close()
        answers = contents(b"".join(iter(lambda: line.recv(1 << 16), b"")))
    assert answers[1:] == [b"T05thread:1;", pack("<I", FLASH + 10).hex().encode()]
    assert bench.chip.register("pc") == FLASH + 10


@pytest.mark.parametrize("crashes", [False, True])
def test_a_breakpoint_in_an_it_block_stops_at_its_end(crashes: bool) -> None:
    bench, server = Bench(bytes.fromhex("8042 04bf 0131 0231 0431 00bf")), GdbServer(0)  # cmp r0, r0; itt eq
    place = FLASH + 14  # adds r1, #2
    bench.chip.crash_points |= {place} if crashes else set()
    with socket.create_connection(("127.0.0.1", server.port)) as line:
        packets = (b"QStartNoAckMode", b"Z0,%x,2" % place, b"c", b"p0f", b"p01", b"D")
        line.sendall(b"".join(map(framed, packets)))
        why = DebuggedChip(bench.chip, server).run(CYCLES_PER_US)
        server.close()
        answers = contents(b"".join(iter(lambda: line.recv(1 << 16), b"")))
    assert why == StopReason.TIME
    assert answers[2:5] == [b"T05thread:1;", pack("<I", FLASH + 22).hex().encode(), b"07000000"]


@pytest.mark.long
@pytest.mark.parametrize(("kind", "name"), [(b"2", "xTickCount"), (b"3", "planted"), (b"4", "planted")])
def test_a_watchpoint_stops_after_the_access(kind: bytes, name: str) -> None:
    def packets(image: Image) -> list[bytes]:
        place = image.symbol(name).address
        watch = b"%%s%s,%x,4" % (kind, place)
        # xTickCount is first written when the memory is cleared.
        return [
            b"QStartNoAckMode", watch % b"Z", b"c", b"c", b"m%x,4" % place, b"p0f", watch % b"z", b"c", b"D",
        ]  # fmt: skip

    machine, answers = on_chip(packets, 20_000)
    said = contents(answers)
    place = machine.image.symbol(name).address
    assert re.match(rb"T05watch:%x;thread:[0-9a-f]+;" % place, said[3]), said
    pc = int.from_bytes(bytes.fromhex(said[5].decode()), "little")
    assert machine.image.function_at(pc) in {"xTickCount": ("tick",), "planted": ("report", "go_wrong")}[name]
    if name == "xTickCount":
        assert said[4] == b"01000000"


def test_a_debugger_that_has_left_stops_nothing_any_more() -> None:
    machine, server = FirmwareOnChip(), GdbServer(0)
    place = machine.image.symbol("xTickCount").address
    with socket.create_connection(("127.0.0.1", server.port)) as line:
        line.sendall(b"".join(map(framed, (b"QStartNoAckMode", b"Z2,%x,4" % place, b"D"))))
        chip = DebuggedChip(machine.chip, server)
        assert chip.run(CYCLES_PER_US) == StopReason.TIME
    for end_us in (2_000, 4_000):  # the chip itself, without its debugger
        while machine.chip.now_us < end_us:
            assert machine.chip.run(end_us * CYCLES_PER_US) & StopReason.WATCHPOINT == 0
    server.close()


def test_a_stop_selects_the_running_thread() -> None:
    machine = FirmwareOnChip()
    chip, place = machine.chip, machine.image.symbol("vTaskSwitchContext").address
    machine.run(30_000)
    kernel = FreeRtos(machine.image, chip.read)
    protocol = RemoteProtocol(chip, kernel)
    other = next(task.block for task in kernel.tasks() if task.block != kernel.current_block)
    assert ask(protocol, b"Z0,%x,2" % place) == ask(protocol, b"Hg%x" % other) == b"OK"
    assert protocol.receive(framed(b"c")) == b"+"
    while not chip.run(200_000 * CYCLES_PER_US) & StopReason.BREAK:
        assert chip.now_us < 200_000
    protocol.stopped(SIGTRAP)
    assert ask(protocol, b"p0f") == pack("<I", place).hex().encode()


def test_a_task_that_does_not_run_shows_its_saved_registers_which_cannot_be_changed() -> None:
    machine = FirmwareOnChip()
    chip = machine.chip
    machine.run(30_000)
    kernel = FreeRtos(machine.image, chip.read)
    protocol = RemoteProtocol(chip, kernel)
    running = kernel.current_block
    blocks = {task.name: task.block for task in kernel.tasks()}
    assert set(ask(protocol, b"qfThreadInfo")[1:].split(b",")) == {b"%x" % block for block in blocks.values()}
    (other,) = (block for name, block in blocks.items() if name == "FILTER" and block != running)
    saved = kernel.saved_registers(other)
    number = {name: index for index, (name, _) in enumerate(REGISTERS)}
    assert ask(protocol, b"Hg%x" % other) == b"OK"
    for name in ("r0", "r4", "r11", "sp", "lr", "pc"):
        assert ask(protocol, b"p%x" % number[name]) == pack("<I", saved[name]).hex().encode()
    assert machine.image.function_at(saved["pc"]) in ("filter", "receive", "unmask")
    assert ask(protocol, b"p%x" % number["d3"]) == b"xx" * 8  # not on its stack
    assert ask(protocol, b"p%x" % number["msp"]) == pack("<I", chip.register("msp")).hex().encode()
    before = chip.register("r4")
    assert ask(protocol, b"P4=01000000") == b"E0e"
    assert (chip.register("r4"), protocol.take_changes()) == (before, False)
    for machine_s in (b"Hg0", b"Hg-1", b"Hg%x" % running):
        assert ask(protocol, b"Hg%x" % other) == ask(protocol, machine_s) == b"OK"
        assert ask(protocol, b"p4") == pack("<I", before).hex().encode()
    assert ask(protocol, b"P4=01000000") == b"OK"
    assert chip.register("r4") == 1
    extra = bytes.fromhex(ask(protocol, b"qThreadExtraInfo,%x" % other).decode())
    assert re.fullmatch(rb"FILTER, (blocked|suspended), priority 3", extra)


def test_the_chip_waits_for_its_debugger_at_its_first_instruction() -> None:
    machine, answers = on_chip(lambda _: [b"QStartNoAckMode", b"pf", b"me000ed28,4", b"D"], 2_000)
    reset = framed(pack("<I", machine.image.reset).hex().encode())
    assert answers == b"+" + framed(b"OK") + reset + framed(b"00000000") + framed(b"OK")


def test_a_breakpoint_of_others_is_theirs() -> None:
    machine = FirmwareOnChip()
    place = machine.image.symbol("vTaskSwitchContext").address
    machine.chip.crash_points.add(place)
    server = GdbServer(0)
    with socket.create_connection(("127.0.0.1", server.port)) as line:
        line.sendall(framed(b"c"))
        assert DebuggedChip(machine.chip, server).run(5_000 * CYCLES_PER_US) == StopReason.BREAK
    assert machine.chip.register("pc") == place
    server.close()


def test_kill_ends_the_flight_like_ctrl_c() -> None:
    with pytest.raises(KeyboardInterrupt):
        on_chip(lambda _: [b"k"], 2_000)


@pytest.mark.long
@pytest.mark.parametrize(("packet", "request_", "backwards"), [
    (b"vCont;c", ResumeRequest.RUN, False), (b"vCont;C05", ResumeRequest.RUN, False),
    (b"vCont;s:1;c", ResumeRequest.STEP, False),
    (b"vCont;S05:1;c", ResumeRequest.STEP, False), (b"vCont;c;s:1", ResumeRequest.STEP, False),
    (b"vCont", ResumeRequest.STOP, True),
    (b"vKill;1", ResumeRequest.STOP, True), (b"bs", ResumeRequest.BACK_STEP, True), (b"bc", ResumeRequest.BACK_RUN, True),
    (b"bs", ResumeRequest.STOP, False), (b"bx", ResumeRequest.STOP, True), (b"C05;20000000", ResumeRequest.RUN, False),
    (b"S05", ResumeRequest.STEP, False),
])  # fmt: skip
def test_a_packet_resumes_as_the_manual_has_it(
    machine: Chip, packet: bytes, request_: ResumeRequest, backwards: bool
) -> None:
    protocol = RemoteProtocol(machine, backwards=backwards)
    assert ask(protocol, b"vCont?") == b"vCont;c;C;s;S"
    assert (b"ReverseStep+;ReverseContinue+" in ask(protocol, b"qSupported:xmlRegisters=arm")) is backwards
    answer = protocol.receive(framed(packet))
    assert (protocol.request, answer) == (
        request_,
        b"+" + (framed(b"") if request_ is ResumeRequest.STOP else b""),
    )


def test_what_a_debugger_has_set_does_not_go_back_in_time(machine: Chip) -> None:
    """Breakpoints and watchpoints are those of the later instant, acknowledgements and known threads as well."""
    protocol = RemoteProtocol(machine)
    for packet in (b"Z1,8001000,2", b"Z2,20000010,4", b"Z3,20000020,2"):
        assert ask(protocol, packet) == b"OK"
    assert protocol.has_stops
    stored = protocol.stored()
    assert stored["breakpoints"] == [0x800_1000]
    earlier = RemoteProtocol(machine)
    machine.breakpoints.clear()
    watched: list[tuple[int, ...]] = []
    machine.watch = lambda *one, on: watched.append((*one, on))  # type: ignore[method-assign,assignment]
    for packet in (b"Z0,8002000,2", b"Z2,20000010,4", b"Z4,20000030,4"):
        ask(earlier, packet)
    watched.clear()
    earlier.receive(b"\x03" + framed(b"c") + framed(b"g"))  # it runs, and a packet waits
    earlier.restore(stored)
    assert machine.breakpoints == {0x800_1000}
    assert sorted(watched) == [(3, 0x2000_0020, 2, True), (4, 0x2000_0030, 4, False)]
    assert earlier.stored() == stored
    assert (earlier.request, earlier.interrupted, earlier.take_changes()) == (ResumeRequest.RUN, False, False)
    assert earlier.stopped(SIGTRAP) == framed(b"T05thread:1;"), "no packet waits any more"


@pytest.mark.parametrize(("packet", "changes"), [
    (b"P0=00000000", True), (b"M20000000,1:00", True), (b"c8000100", True), (b"g", False), (b"m20000000,4", False),
    (b"Z1,8001000,2", False), (b"c", False),
])  # fmt: skip
def test_what_changes_the_machine_is_noted_once(
    protocol: RemoteProtocol, packet: bytes, changes: bool
) -> None:
    assert not protocol.take_changes()
    protocol.receive(framed(packet))
    assert protocol.take_changes() is changes
    assert not protocol.take_changes()
    assert protocol.stopped(SIGINT, at_begin=True) == framed(b"T02replaylog:begin;thread:1;")
    assert protocol.stopped(SIGTRAP, 0x2000_0010) == framed(b"T05watch:20000010;thread:1;")


@pytest.mark.parametrize(("from_us", "booted_us", "held_us"), [
    (0, 0, 0), (-1, 0, 0), (0, 1_000, 0), (2_000, 0, None), (2_000, 1_000, 3_000), (2_001, 1_000, 4_000), (1, 1, 1_000),
])  # fmt: skip
def test_a_debugger_s_part_begins_at_power_on_or_at_a_time_of_the_laboratory(
    from_us: int, booted_us: int, held_us: int | None
) -> None:
    """The chip is asked each millisecond; before the laboratory begins there is no later time."""
    machine, held = FirmwareOnChip(), list[int]()

    def wait(port: int) -> None:
        held.append(machine.chip.now_us)
        raise KeyboardInterrupt

    server = GdbServer(0, wait, from_us=from_us)
    booted = (lambda: booted_us,) if booted_us else ()
    chip = DebuggedChip(machine.chip, server, None, *booted)
    for end_us in range(1_000, 7_000, 1_000):
        while not held and machine.chip.now_us < end_us:
            try:
                chip.run(end_us * CYCLES_PER_US)
            except KeyboardInterrupt:
                break
    assert [us // 1_000 * 1_000 for us in held] == ([] if held_us is None else [held_us])
    server.close()


def test_a_debugger_that_interrupts_a_way_back_ends_it() -> None:
    """It would stop once more where the way ends."""
    machine, held = FirmwareOnChip(), list[int]()

    def hold(signal: int, watched: int | None = None, at_begin: bool = False) -> ResumeRequest:
        held.append(signal)
        return ResumeRequest.RUN

    server: Any = Made(attach=lambda *of: None, hold=hold, checkpoints=None, from_us=0, is_connected=True)
    server.wants_to_stop = lambda: len(held) == 1 and chip._search is not None
    chip = DebuggedChip(machine.chip, server)
    for end_us in (1_000, 2_000, 3_000):
        while machine.chip.now_us < end_us:
            chip.run(end_us * CYCLES_PER_US)
        if end_us == 1_000:
            assert held == [SIGINT]
            chip._search = Search(Goal.THERE, Position(9, 0, 0, 0, 1 << 60, 1 << 60))
    assert (held, chip._search) == ([SIGINT, SIGINT], None)


@pytest.mark.parametrize("leaves", [False, True])
def test_ctrl_c_that_arrives_with_the_request_to_run_stops_unless_the_debugger_has_left(leaves: bool) -> None:
    machine, server = FirmwareOnChip(), GdbServer(0)
    with socket.create_connection(("127.0.0.1", server.port)) as line:
        line.sendall(framed(b"QStartNoAckMode") + framed(b"c") + b"\x03")
        chip = DebuggedChip(machine.chip, server)
        chip.run(1_000 * CYCLES_PER_US)
        line.sendall(b"" if leaves else framed(b"D"))
        if leaves:
            line.shutdown(socket.SHUT_WR)
        chip.run(2_000 * CYCLES_PER_US)
        server.close()
        answers = contents(b"".join(iter(lambda: line.recv(1 << 16), b"")))
    assert answers == ([b"OK"] if leaves else [b"OK", b"T02thread:1;", b"OK"])
