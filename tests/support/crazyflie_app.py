"""The exported app on a board of memory: compiled for this machine with the stubs, and driven step by step."""

import ctypes
import hashlib
import os
import shutil
import struct
import subprocess
from collections.abc import Iterator, Mapping
from pathlib import Path

import numpy as np

from firmware_py.core.structs import Estimator, Input, Sampling, Supervisor
from firmware_py.core.subset import S_co
from firmware_py.export.compilers import compilers
from firmware_py.export.crazyflie import write_app
from hil.config import LabConfig, load_config
from support.paths import STUBS
from support.stm32_firmware import BUILD

TIMER_REGISTERS = "CR1 CR2 SMCR DIER SR EGR CCMR1 CCMR2 CCER CNT PSC ARR RCR CCR1 CCR2 CCR3 CCR4"
PIN_REGISTERS = "MODER OTYPER OSPEEDR PUPDR IDR ODR BSRR LCKR"
LOCALISATION = 6
GENERIC = 1
OUT_OF_TREE = 3  # StateEstimatorTypeOutOfTree


class Setpoint(ctypes.Structure):
    """setpoint_t; modes 0 disable, 1 absolute, 2 velocity."""

    _fields_ = (
        ("timestamp", ctypes.c_uint32),
        ("attitude_time", ctypes.c_uint32),
        *((name, ctypes.c_float) for name in ("roll", "pitch", "yaw")),
        ("attitudeRate", ctypes.c_float * 4),
        *((name, ctypes.c_float) for name in ("qx", "qy", "qz", "qw", "thrust")),
        ("position_time", ctypes.c_uint32),
        *((name, ctypes.c_float) for name in ("x", "y", "z")),
        ("derivatives", ctypes.c_float * 12),
        ("velocity_body", ctypes.c_bool),
        *((f"{name}_mode", ctypes.c_uint8) for name in ("x", "y", "z", "roll", "pitch", "yaw", "quat")),
    )


class Timer(ctypes.Structure):
    """TIM_TypeDef, its registers in their order."""

    _fields_ = tuple((name, ctypes.c_uint32) for name in TIMER_REGISTERS.split())


class Pins(ctypes.Structure):
    """GPIO_TypeDef."""

    _fields_ = (*((name, ctypes.c_uint32) for name in PIN_REGISTERS.split()), ("AFR", ctypes.c_uint32 * 2))


def build_app(
    folder: Path, config: LabConfig | None = None, plant: tuple[str, str, str] | None = None
) -> Path:
    """Export the app, of the default profile unless told otherwise, and return it as a shared library.

    `plant` is a mistake: in a file, the first of two texts is replaced by the second, once. The same sources are compiled
    once.
    """
    write_app(config or load_config(), "floaty", folder)
    if plant is not None:
        source = folder / "src" / plant[0]
        text = source.read_text()
        assert plant[1] in text
        source.write_text(text.replace(plant[1], plant[2], 1))
    # The system's, if there is one: it is faster.
    compiler = min(compilers(), key=lambda one: one.name == "zig")
    sources = sorted((folder / "src").glob("*.c"))
    texts = [
        path.read_text() for path in (*sorted((folder / "src").glob("*.[ch]")), *sorted(STUBS.iterdir()))
    ]
    flags = (
        "-std=gnu11", "-fshort-enums", "-O1", "-Wall", "-Werror", "-Wdouble-promotion", "-fno-math-errno",
        "-shared", "-fPIC", *(("-fno-sanitize=all", "-Wl,--no-gc-sections") if compiler.name == "zig" else ()),
    )  # fmt: skip
    digest = hashlib.sha256(repr((compiler, flags, texts)).encode()).hexdigest()[:16]
    kept = BUILD / f"app-{digest}.so"
    library = folder / "app.so"
    if kept.is_file():
        shutil.copy2(kept, library)
        return library
    caches = {name: str(folder / "zig") for name in ("ZIG_LOCAL_CACHE_DIR", "ZIG_GLOBAL_CACHE_DIR")}
    subprocess.run(
        (
            *compiler.command, *flags, "-I", str(STUBS), "-o", str(library),
            *map(str, sources), str(STUBS / "board.c"), "-lm",
        ),
        check=True, env=os.environ | caches,
    )  # fmt: skip
    BUILD.mkdir(parents=True, exist_ok=True)
    partial = kept.with_suffix(f".{os.getpid()}")
    shutil.copy2(library, partial)
    partial.replace(kept)
    return library


class App:
    """A freshly booted app; each one is a library of its own, because the app's memory is static."""

    def __init__(self, library: Path, copy: Path) -> None:
        copy.write_bytes(library.read_bytes())
        c = self.c = ctypes.CDLL(str(copy))
        c.stub_log_name.restype = c.stub_param_name.restype = ctypes.c_char_p
        c.stub_log_value.restype = c.stub_param_get.restype = ctypes.c_double
        c.stub_param_set.argtypes = c.stub_param_load.argtypes = (ctypes.c_int, ctypes.c_double)
        for test in (c.estimatorOutOfTreeTest, c.watchdogNormalStartTest, c.cfAssertNormalStartTest):
            test.restype = ctypes.c_bool
        self.now = ctypes.c_uint64.in_dll(c, "stub_now_us")
        self.gyro_noise = 1  # of the last bit, from step to step; 0: frozen
        self.gyro = (ctypes.c_int32 * 3).in_dll(c, "stub_gyro")
        self.battery = ctypes.c_float.in_dll(c, "stub_battery")
        self.usec_reset = ctypes.c_uint64.in_dll(c, "stub_usec_reset_us")
        self.first_tick = ctypes.c_uint32.in_dll(c, "stub_first_tick")
        self.locked = ctypes.c_int32.in_dll(c, "stub_locked")
        self.stop_requested = ctypes.c_int32.in_dll(c, "stub_stop_requested")
        self.watchdog_fed = ctypes.c_int32.in_dll(c, "stub_watchdog_fed")
        self.gyro_known = ctypes.c_int32.in_dll(c, "stub_gyro_known")
        self.sensors = ctypes.c_int32.in_dll(c, "stub_sensors")
        self.estimator_type = ctypes.c_int32.in_dll(c, "stub_estimator")
        self.connected = ctypes.c_int32.in_dll(c, "stub_connected")
        self.armed = ctypes.c_int32.in_dll(c, "stub_armed")  # the firmware's supervisor
        self.can_arm = ctypes.c_int32.in_dll(c, "stub_can_arm")
        self.can_fly = ctypes.c_int32.in_dll(c, "stub_can_fly")
        self.after_watchdog = ctypes.c_int32.in_dll(c, "stub_after_watchdog")
        self.after_assert = ctypes.c_int32.in_dll(c, "stub_after_assert")
        self.self_test_passed = ctypes.c_int32.in_dll(c, "stub_self_test_passed")
        self.cycles = ctypes.c_uint32.in_dll(c, "stub_cycles")
        self.suspended = ctypes.c_int32.in_dll(c, "stub_suspended")
        self.transmit_full = ctypes.c_int32.in_dll(c, "stub_transmit_full")
        self.idle_thrust = ctypes.c_uint32.in_dll(c, "stub_idle_thrust")
        self.ratios = (ctypes.c_int32 * 4).in_dll(c, "stub_ratios")
        self.supervisor, self.sampling = self._struct(Supervisor), self._struct(Sampling)
        self.data = self._struct(Input)
        self.timers = [Timer.in_dll(c, name) for name in ("stub_tim3", "stub_tim5")]
        self.pins = [Pins.in_dll(c, name) for name in ("stub_gpio_a", "stub_gpio_b")]
        self._estimator = (ctypes.c_char * Estimator.dtype.itemsize).in_dll(c, "floaty_estimator")
        self._console = (ctypes.c_char * 4096).in_dll(c, "stub_console")
        self._state = ctypes.create_string_buffer(256)
        self._control = ctypes.create_string_buffer(256)
        self._nothing = ctypes.create_string_buffer(1024)
        self.setpoint = Setpoint()  # of the stock commander
        self.params = {name: i for i, name in _names(c.stub_param_name)}
        self.logs = {name: i for i, name in _names(c.stub_log_name)}

    def _struct(self, kind: type[S_co]) -> S_co:
        """Return a struct of the core's, as if it were one here."""
        memory = (ctypes.c_char * kind.dtype.itemsize).in_dll(self.c, f"floaty_{kind.__name__.lower()}")
        view: S_co = kind._view(np.frombuffer(memory, kind.dtype))
        return view

    def boot(self, stored: Mapping[str, float] | None = None, absolute: bool = False) -> None:
        """Start as the firmware's system task does, with parameters `stored` in the EEPROM, up to the stabilizer's loop.

        Then set what poses are, as whoever connects does: `absolute`, in a box as wide as a room, or corrections.
        """
        c = self.c
        c.appInit()
        for name, value in (stored or {}).items():
            c.stub_param_load(self.params[name], value)
        c.estimatorOutOfTreeInit()
        self.estimator_type.value = OUT_OF_TREE
        c.controllerOutOfTreeInit()
        tests = (c.estimatorOutOfTreeTest, c.watchdogNormalStartTest, c.cfAssertNormalStartTest)
        self.self_test_passed.value = min(test() for test in tests)  # each of them is asked
        c.stub_run_app(0)
        self.set("extPose.absolute", absolute)
        for size in ("radius", "below", "above") if absolute else ():
            self.set(f"box.{size}", 5.0)

    def step(self, step: int, *, controlled: bool = True) -> None:
        """Run one pass of the stabilizer, which waits for the self-test; another controller may be selected."""
        self.now.value = step * 1000
        if not self.self_test_passed.value:
            return
        self.c.estimatorOutOfTree(self._state, step)
        if controlled:
            self.c.controllerOutOfTree(
                self._control, ctypes.byref(self.setpoint), self._nothing, self._state, step
            )
        self.gyro[2] ^= self.gyro_noise

    def radio(self, data: bytes, port: int = LOCALISATION, channel: int = GENERIC) -> None:
        self.c.stub_radio(port, channel, data, len(data))

    def sent(self) -> bytes:
        """Take the next packet to the ground, empty when there is none."""
        packet = ctypes.create_string_buffer(32)
        length = self.c.stub_transmitted(packet)
        return packet.raw[:length]

    def app_channel(self, data: bytes) -> None:
        self.c.stub_app_packet(data, len(data))
        self.c.stub_run_app(1)

    def counts(self) -> list[int]:
        """Return what the compare registers of M1..M4 hold."""
        tim3, tim5 = self.timers
        return [tim5.CCR3, tim3.CCR1, tim3.CCR2, tim5.CCR4]

    def estimator(self) -> bytes:
        return self._estimator.raw

    def state(self) -> dict[str, float]:
        """Return what the firmware logs of the estimate, by the names of its log variables."""
        parts = (("roll", "pitch", "yaw"), ("qx", "qy", "qz", "qw"), ("x", "y", "z"), ("vx", "vy", "vz"))
        values = struct.unpack_from("<4x3f4f4x3f4x3f", self._state)
        return dict(zip((f"stateEstimate.{name}" for part in parts for name in part), values, strict=True))

    def console(self) -> str:
        return self._console.value.decode()

    def log(self, name: str) -> float:
        return float(self.c.stub_log_value(self.logs[name]))

    def get(self, name: str) -> float:
        return float(self.c.stub_param_get(self.params[name]))

    def set(self, name: str, value: float) -> None:
        self.c.stub_param_set(self.params[name], value)


def _names(of: "ctypes._CFuncPtr") -> Iterator[tuple[int, str]]:  # type: ignore[name-defined]
    i = 0
    while (name := of(i)) is not None:
        if name:
            yield i, name.decode()
        i += 1
