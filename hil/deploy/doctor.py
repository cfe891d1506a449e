"""Examines a real board and reports in plain words: firmware, app, link, memory, core, IMU and servos.

Nothing moves. The tested core has separate memory; for half a second the board is in the loop, and then finds its gyro's
zero again.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from statistics import median

import numpy as np

from firmware_py.config import parameters_of
from firmware_py.core_runner import CoreBlocks, default_runner
from firmware_py.export.profile_c import profile_hash
from firmware_py.logic.loading import load_logic, translation_of
from firmware_py.wire import crtp
from firmware_py.wire.core_port import (
    CHANNEL_LOOP,
    PORT_CORE,
    READ_MAX,
    WRITE_MAX,
    About,
    Hil,
    Loop,
    decode_loop,
    health,
    loop,
    read,
    write,
)
from firmware_py.wire.supervisor import PLATFORM_VERSION, VERSION_FIRMWARE, State
from ground_station.clock import clock_us, wait
from ground_station.errors import LinkError
from ground_station.links.core_client import CoreClient, SilenceError
from hil.board.real_core import RealCore
from hil.board.sample_window import SampleWindow
from hil.config import LabConfig

ROUND_TRIPS = 100
BURST = 600  # packets
LOSSY = 0.1  # share of them repeated
LOOKS = 60  # readings of the gyro, with as many different samples
LOOP_SAMPLES = 500  # of the gyro; a board in the loop takes one per millisecond
LOOP_TIMEOUT_US = 5_000_000
LOOK_S = 0.001
TICKS = 20  # of the core
VERSION_TIMEOUT_S = 1.0
STILL_COUNTS = 100.0  # standard deviation; from the board's own gyro calibration
ZERO_MAX = 100.0  # [counts] 6 deg/s: the data sheet allows 1 deg/s
PULSE_COUNTS = (21_000, 42_000)
BATTERY_MV = (3_000, 4_350)


@dataclass(frozen=True, slots=True)
class Finding:
    """One line: the item, the finding, and whether it is correct."""

    subject: str
    text: str
    good: bool = True


def examine(client: CoreClient, config: LabConfig) -> Iterator[Finding]:
    """Yield the findings. Raises `LinkError` when the board does not answer, or flies."""
    firmware = _firmware(client)
    try:
        about = client.begin()
    except SilenceError:
        if not firmware.good:
            raise
        missing = "missing: the firmware answers, Floaty's app does not; see floaty deploy write"
        yield from (firmware, Finding("app", missing, good=False))
        return
    yield firmware
    yield from _app(about, config)
    yield _link(client, 1e6 / config.mocap.period_us)
    yield _memory(client, about.size)
    yield from _health(client)
    yield _core(client, about, config)
    yield _loop(client)


def _firmware(client: CoreClient) -> Finding:
    """Query the stock firmware's platform service."""
    ask = bytes((VERSION_FIRMWARE,))
    client.packets.send_any(crtp.encode(crtp.Packet(crtp.PORT_PLATFORM, PLATFORM_VERSION, ask)))
    end_us = clock_us() + round(VERSION_TIMEOUT_S * 1e6)
    while clock_us() < end_us:
        for packet in map(crtp.decode, client.packets.received()):
            if (packet.port, packet.channel, packet.data[:1]) == (crtp.PORT_PLATFORM, PLATFORM_VERSION, ask):
                return Finding("firmware", packet.data[1:].rstrip(b"\0").decode("ascii", "replace"))
        wait(0.005)
    return Finding("firmware", "does not tell its version", good=False)


def _app(about: About, config: LabConfig) -> Iterator[Finding]:
    for subject, there, here, advice in (
        ("core", about.core, translation_of(config.logic).version, ": export and flash it again"),
        ("profile", about.profile, profile_hash(config), ""),
    ):
        same = here.startswith(there)
        compared = "as here" if same else f"{here[: len(there)]} here{advice}"
        yield Finding(subject, f"{there}, {compared}", same)
    yield Finding("state", State(about.state).name.lower())


def _link(client: CoreClient, poses_hz: float) -> Finding:
    """Measure the link; a flight needs one packet per pose, without repeats."""
    trips_us = []
    for _ in range(ROUND_TRIPS):
        start_us = clock_us()
        client.execute([read(0, READ_MAX)])
        trips_us.append(clock_us() - start_us)
    repeated, start_us = client.repeated, clock_us()
    client.execute([read(0, READ_MAX)] * BURST)
    rate = BURST / max(1, clock_us() - start_us) * 1e6
    trip = f"round trip {median(trips_us) / 1000:.1f} ms, the longest {max(trips_us) / 1000:.1f}"
    again = client.repeated - repeated
    text = f"{trip}; {rate:.0f} packets/s each way, {again} of {BURST} repeated"
    if rate < poses_hz:
        return Finding("link", f"{text}: too slow to fly with {poses_hz:.0f} poses/s", good=False)
    if again > LOSSY * BURST:
        text += ": poses are lost or late in a flight; move the antenna, or change the channel"
    return Finding("link", text)


def _memory(client: CoreClient, size: int) -> Finding:
    pattern = np.arange(size, dtype=np.uint32) * 2654435761 >> 13
    data = pattern.astype(np.uint8).tobytes()
    client.execute([write(at, data[at : at + WRITE_MAX]) for at in range(0, size, WRITE_MAX)])
    wrong = sum(one != other for one, other in zip(client.memory(size), data, strict=True))
    return Finding("memory", f"{size} B written and read back, {wrong} of them wrong", wrong == 0)


def _health(client: CoreClient) -> Iterator[Finding]:
    looks = [client.execute([health()])[0].health() for _ in range(LOOKS)]
    last = looks[-1]
    low, high = BATTERY_MV
    yield Finding("battery", f"{last.battery_mv / 1000:.2f} V", low <= last.battery_mv <= high)
    yield Finding("RAM", f"{last.heap_free} B free")
    counts = np.array([(look.gyro_x, look.gyro_y, look.gyro_z) for look in looks], float)
    zero, noise = counts.mean(axis=0), counts.std(axis=0)
    known = "" if last.calibrated else ", zero not found yet"
    measured = f"zero at {zero[0]:.0f} {zero[1]:.0f} {zero[2]:.0f} counts, noise {noise.max():.1f}{known}"
    if not noise.any():
        yield Finding("gyro", f"dead or frozen: {LOOKS} times the same counts", good=False)
    elif noise.max() > STILL_COUNTS:
        yield Finding("gyro", f"alive; the board moves: {measured}")
    else:
        yield Finding("gyro", f"alive: {measured}", bool(abs(zero).max() <= ZERO_MAX))
    fit = all(PULSE_COUNTS[0] <= count <= PULSE_COUNTS[1] for count in last.counts)
    yield Finding("servos", f"pulses of {' '.join(f'{count / 21:.0f}' for count in last.counts)} us", fit)


def _core(client: CoreClient, about: About, config: LabConfig) -> Finding:
    """Compute some ticks on the board and here."""
    try:
        blocks = CoreBlocks(parameters_of(config), default_runner, load_logic(config.logic))
        core = RealCore(blocks, client)
    except LinkError as error:
        return Finding("computes", str(error).removeprefix(f"{client.name}: "), good=False)
    core.call("reset")
    for _ in range(TICKS):
        for name in ("estimate", "supervise", "control"):
            core.call(name)
    cycles = core.load["estimate"].cycles // TICKS, core.load["control"].cycles // TICKS
    times = f"estimate {cycles[0]} cycles, control {cycles[1]}, at {about.clock_mhz} MHz"
    wrong = core.unexpected
    verdict = f"OTHER bits than here in {wrong} calls" if wrong else "the same bits as here"
    return Finding("computes", f"{verdict}; {times}", not wrong)


def _loop(client: CoreClient) -> Finding:
    """Send samples as fast as a board in the loop takes them."""
    client.execute([loop(Hil.STILL)])
    window, report, start_us = SampleWindow(), None, clock_us()
    while window.used < LOOP_SAMPLES and clock_us() - start_us < LOOP_TIMEOUT_US:
        if not window.full:
            window.put((0, 0, 0))
        # The board takes no samples before its first report.
        while report and client.packets.ready and (data := window.packet(clock_us())) is not None:
            client.packets.send_any(crtp.encode(crtp.Packet(PORT_CORE, CHANNEL_LOOP, data)))
        report = _last_report(client, window) or report
    rate = window.used / (clock_us() - start_us) * 1e6
    client.execute([loop(Hil.OFF)])
    if report is None:
        return Finding("loop", "does not answer", good=False)
    counts = f"{report.held} ms held, {report.lost} lost, {report.doubled} doubled"
    return Finding("loop", f"carries {rate:.0f} samples/s of 1000: {counts}", window.used >= LOOP_SAMPLES)


def _last_report(client: CoreClient, window: SampleWindow) -> Loop | None:
    """Pass the board's reports to the window and return the last; wait for one if the window is full."""
    report = None
    for packet in map(crtp.decode, client.packets.received(LOOK_S if window.full else 0.0)):
        if (packet.port, packet.channel) == (PORT_CORE, CHANNEL_LOOP):
            report = decode_loop(packet.data)
            window.on_report(report, clock_us())
    return report
