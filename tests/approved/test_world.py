"""The world and the hardware at a board's pins answer random use as they did, of configurations whose numbers all differ.

Bodies with all of their memory, their air, radio, serial line, cameras with markers, IMU, own sensors, pins. If a change
is meant: make approve.
"""

from collections.abc import Callable, Iterator
from dataclasses import asdict
from functools import partial
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import pytest

from firmware_py.core.subset import Struct
from firmware_py.section import Section
from firmware_py.wire.core_port import Loop
from hil.board.cameras import VirtualMocap
from hil.board.config import SensorConfig
from hil.board.eeprom import address_of, factory_config
from hil.board.imu import VirtualImu
from hil.board.markers import Sighting, VirtualMarkers
from hil.board.own_sensors import OwnSensors
from hil.board.pins import CpuLoad, Requests, VirtualBoard
from hil.board.radio import VirtualRadio
from hil.board.sample_window import SampleWindow
from hil.board.uart import VirtualSerial
from hil.config import LabConfig, load_config
from hil.emulator.crazyflie.config import RadioConfig
from hil.emulator.crazyflie.nrf51 import RATES
from hil.emulator.crazyflie.shockburst import air_us, exchange_us
from hil.emulator.events import EventQueue
from hil.errors import LabError
from hil.laboratory.bodies import make_body
from hil.world.battery import Battery, endurance
from hil.world.body import OwnSensor
from hil.world.config import MassConfig
from hil.world.floaty.correction import OperatingPoint
from hil.world.floaty.plant import SERVO_FAILURES, Plant
from hil.world.quadrotor import MOTOR_FAILURES, Rotors
from hil.world.rigid import RigidBody
from hil.world.room import Room, to_body, to_world
from hil.world.scene import ball, box, cylinder, disc, eight_markers
from hil.world.servos import commanded_angles, next_period_us
from hil.world.structs import Air, Flaps, Rigid
from support.approved import approve, judge, tiers
from support.random_use import Random, by_seed, hash_of, shown

USES = Path(__file__).with_name("world.json")
SEEDS = range(1, 4)
ARMS = (MassConfig(mass=0.01, place=(0.03, 0.02, -0.05), size=(0.01, 0.02, 0.03), mirrored=True),)


class Used(Random):
    """Notes numbers to five digits, and makes configurations in which no two numbers are alike."""

    def __init__(self, seed: int) -> None:
        super().__init__(seed)
        self.seed = seed

    def note(self, kind: str, *what: Any) -> None:
        self.log.note(kind, *map(shown, what))

    def varied(self, section: Any) -> Any:
        """Return a section of a profile, or one of its values, with its numbers some percent off."""
        if isinstance(section, Section):
            found = {name: self.varied(getattr(section, name)) for name in type(section).model_fields}
            return section.model_copy(update=found)
        if isinstance(section, tuple):
            return tuple(self.varied(one) for one in section)
        if isinstance(section, float):
            return section * float(self.rng.uniform(0.95, 1.05)) or float(self.rng.uniform(0.0, 0.02))
        return section

    def attempt(self, kind: str, act: Callable[[], object]) -> None:
        """Note what an act returns, or that it is refused."""
        try:
            self.note(kind, act())
        except (LabError, ValueError) as error:
            self.note(f"refused {kind}", str(error))

    def three(self, size: float) -> tuple[float, ...]:
        return tuple(self.rng.uniform(-1.7 * size, 1.7 * size, 3).tolist())

    def turn(self, size: float = 0.5) -> tuple[float, ...]:
        return (1.0, *self.three(size))


class Flown(Used):
    """A body that is placed, held, pushed and driven, in an air that changes; all of its memory is noted."""

    profile = "floaty"

    def robot(self, config: LabConfig) -> Any:
        return make_body(config, self.rng.spawn(1)[0], (0.1, -0.2, 1.3))

    def memories(self) -> Iterator[tuple[type[Struct], Any]]:
        """Yield each part of the kernels' memory."""
        yield Rigid, self.body._body
        yield Air, self.body.tunnel.air.fields
        if hasattr(self.body, "blocks"):
            yield Flaps, self.body.blocks.flaps.fields
        if hasattr(self.body, "rotors"):
            yield Rotors, self.body.rotors.fields

    def told(self) -> dict[str, str]:
        config = load_config(*(["crazyflie"] if self.profile == "crazyflie" else []))
        self.body = body = self.robot(self.config(config))
        self.look("made")
        battery = Battery(self.varied(config.battery), 1.5)
        now_us = 0
        for number in range(120):
            self.act(now_us)
            now_us += self.pick(0, 400, 1_000, 2_000, 7_300, next_period_us(now_us) - now_us)
            body.advance(now_us)
            if number % 10 == 0:
                battery.draw(now_us, body.draw(now_us, battery.voltage))
                battery.sag_V = 0.01 * self.below(20)
                self.note("battery", battery.charge, battery.voltage, battery.power, battery.millivolts)
            self.note("truth", now_us, body.state, body.specific_force_B, body.vibration, body.flow_W)
            self.note("lost", number, body.lost, body.lift, body.pushes)
            for one in body.channels():
                self.note(
                    "logged", one.dtype, [(each.names, each.unit, each.frame) for each in one.quantities]
                )
                self.note("values", one.read())
        self.look("left")
        if isinstance(body, Plant):
            for _ in range(2):
                inputs = (*self.three(0.05), 0.02)
                point = OperatingPoint(inputs, self.turn(0.1)[1:], self.three(0.5), self.pick(None, 9.0))  # type: ignore[arg-type]
                self.note("linear", body.linearise(point), *body.mounted_wrench(inputs))
        return self.log.told()

    def config(self, config: LabConfig) -> LabConfig:
        geometry = config.geometry
        changed: dict[str, Any] = {
            name: self.varied(getattr(config, name))
            for name in ("plant", "tunnel", "battery", "actuators", "quadrotor")
        }
        symmetric = {
            name: self.varied(getattr(geometry, name))
            for name in (
                "footprint",
                "base_side",
                "strip_width",
                "kink_angle",
                "flow_point",
                "flap_mass",
                "inertia",
            )
        }
        edge = 0.06, 0.0
        symmetric |= [
            {"kink_side": "x"},
            {"inertia": "masses", "dihedral": 0.1, "masses": (*geometry.masses, *ARMS)},
            {"outline": (edge, (0.1, 0.0), (0.1, 0.1), (0.0, 0.1), edge[::-1]), "axis_azimuth": 0.7},
        ][self.seed - 1]
        variant = ("methods", "table_open", "plate")[self.seed - 1]
        changed["plant"] = changed["plant"].model_copy(update={"variant": variant})
        changed["geometry"] = geometry.model_copy(update=symmetric)
        return config.model_copy(update=changed)

    def look(self, kind: str) -> None:
        """Note all that can be seen from outside, and the memory of the kernels."""
        body = self.body
        for struct, memory in self.memories():
            for name in struct.dtype.names:
                self.note(f"{kind} {struct.__name__}", name, np.asarray(getattr(memory, name)))
        self.note(kind, body.outputs, body.room, body.escs, sorted(body.settings), body.tunnel.side_wind)
        self.note(
            kind, body.look, body.markers, body.tunnel.fan_factor, body.tunnel.gust_scale, body.tunnel.shadow
        )

    def act(self, now_us: int) -> None:
        body = self.body
        what = self.pick("counts", "counts", "air", "setting", "place", "hold", "release", "push")
        if what == "counts":
            if self.profile == "crazyflie":
                counts = [self.pick(0, 40, 100, 168, 200, 256, -3, 65_535) for _ in range(4)]
            else:
                counts = [self.pick(28_000, 31_500, 34_000, 10_499, 10_500, 52_500, 52_501) for _ in range(4)]
            self.note(what, body.set_counts(now_us, counts))
        elif what == "air":
            tunnel, (x, y, z) = body.tunnel, self.three(1.0)
            name, values = self.pick(
                ("set_fan_factor", (abs(x),)), ("set_gust_scale", (abs(3.0 * y),)), ("set_side_wind", (x, y, 9.0 * z)),
                ("set_side_wind", (x, y)), ("set_wake", (z, x, y)), ("block", (x, y, abs(z), abs(x))),
            )  # fmt: skip
            self.attempt(name, partial(getattr(tunnel, name), *values))
        elif what == "setting" and body.settings:
            name = self.pick(*body.settings)
            setting = body.settings[name]
            setting.write(self.pick(0.0, 0.5, 1.0, 0.1))
            self.note(what, name, setting.read())
        elif what == "place":
            speeds = (self.three(0.5), self.three(2.0))[: self.below(3)]
            given: tuple[Any, ...] = ((*self.three(0.1)[:2], 0.05 + 1.3 * self.rng.random()),)
            act = self.pick("place", "place", "put_back")
            if act == "place":
                given += (self.pick(self.turn(), self.turn(), (0, 0, 0, 0)), *speeds)
            self.attempt(act, partial(getattr(body, act), *given))
        elif what == "push":
            body.push(*(self.three(0.3), self.three(0.01))[: 1 + self.below(2)])
        elif what in ("hold", "release"):
            getattr(body, what)()


class Flying(Flown):
    """A quadrotor, with brushed motors or brushless ones."""

    profile = "crazyflie"

    def config(self, config: LabConfig) -> LabConfig:
        made = super().config(config)
        motors = self.pick("brushed", "brushless")
        return made.model_copy(update={"quadrotor": made.quadrotor.model_copy(update={"motors": motors})})


class OwnBody(Flown):
    """A body that a user wrote, with its own actuators, sensors and log columns."""

    def robot(self, config: LabConfig) -> Any:
        class Own(RigidBody):
            mass, inertia = 0.3, (1e-3, 2e-3, 3e-3)
            logged: ClassVar = {"turned": ("left right", "rad"), "spent": ("spent", "")}
            sensed: ClassVar = {"heat": ("heat_a heat_b", "K"), "spent": ("spent", "J")}
            turned, spent = [0.0, 0.0], 0.0

            def wrench(self, wind_B: list[float]) -> Any:
                x, y, z = wind_B
                return (0.01 * x, 0.02 * y, 0.29 * z), (self.turned[0], 0.002, -self.turned[1])

            def actuate(self, duration: float) -> None:
                left, right, *_ = self.counts
                self.turned = [left * 1e-7, right * 2e-7]
                self.spent += duration

            def power(self) -> float:
                return 3.0 + self.spent

            def heat(self) -> tuple[float, float]:
                return self.spent, self.time_s

        plant = config.plant.model_copy(update={"drag_factor": 1.0})
        return Own(config.model_copy(update={"plant": plant}), self.rng.spawn(1)[0], (0.1, -0.2, 1.3))

    def look(self, kind: str) -> None:
        super().look(kind)
        for name, sensor in self.body.sensors.items():
            self.note(f"{kind} sensors", name, sensor.names, sensor.unit, sensor.read())


class Carried(Used):
    """What a radio or a serial line carries, that bit errors, losses and full buffers spoil."""

    def told(self) -> dict[str, str]:
        events, config = EventQueue(), load_config()
        radio = config.radio.model_copy(
            update={
                "bits_per_second": RATES[self.seed - 1], "uplink_queue": 3, "downlink_queue": 4,
                "uplink_loss": 0.1, "downlink_loss": 0.2, "usb_us": 270, "usb_jitter_us": self.pick(0, 90),
            }
        )  # fmt: skip
        serial = config.serial.model_copy(
            update={"baud": (57_600, 921_600, 115_200)[self.seed - 1], "receive_buffer": 150, "transmit_buffer": 200,
                    "interrupt_threshold": 17, "host_latency_us": 700}
        )  # fmt: skip
        air = VirtualRadio(radio, events, self.rng.spawn(1)[0])
        air.connect(
            lambda us, data: self.note("radio up", us, data.hex()),
            lambda us, data: self.note("radio down", us, data.hex()),
            lambda us: self.note("polled", us),
        )
        line = VirtualSerial(serial, events, self.rng.spawn(1)[0])
        line.connect(
            lambda us: self.note("line up", us, line.read().hex() if self.below(3) else "waits"),
            lambda us, data: self.note("line down", us, data.hex()),
        )
        for number in range(400):
            now_us, what = events.now_us, self.pick("up", "down", "line up", "line down", "fault", "wait")
            if what == "up":
                self.attempt(
                    what,
                    partial(air.uplink, now_us, self.data(1, 5, 32, 33 - self.below(40) // 39 * 33)[:32]),
                )
            elif what == "down":
                self.attempt(what, partial(air.downlink, now_us, self.data(0, 1, 5, 30, 32, 33)))
            elif what == "line up":
                line.uplink(now_us, self.data(1, 16, 17, 18, 90, 600))
            elif what == "line down":
                self.note(what, line.write(now_us, self.data(1, 16, 17, 90, 190)))
            elif what == "fault":
                line.connected = self.pick(True, True, False)
                line.uplink_bit_error_rate = self.pick(0.0, 0.0, 1e-3, 1.0)
                line.downlink_bit_error_rate = self.pick(0.0, 0.0, 1e-2, 1.0)
                air.medium.uplink_loss = self.pick(0.0, 0.1, 0.5)
                air.medium.downlink_loss = self.pick(0.0, 0.1, 0.5)
                air.medium.uplink_bit_error_rate = self.pick(0.0, 1e-3)
                air.medium.downlink_bit_error_rate = self.pick(0.0, 2e-3)
                air.medium.uplink_jitter_us, air.medium.downlink_jitter_us = self.pick(
                    (0, 0), (900, 0), (0, 700)
                )
            events.run(now_us + self.pick(0, 0, 100, 1_000, 1_000, 9_000, 40_000))
            self.note("radio", number, asdict(air.up), asdict(air.down), asdict(air.air))
            self.note("line", number, asdict(line.up), asdict(line.down), line.overruns)
        return self.log.told()


class Watched(Used):
    """Cameras with markers and without, an IMU and its twin, own sensors, of a body that is moved."""

    def told(self) -> dict[str, str]:
        config, events = load_config(), EventQueue()
        made = make_body(config, self.rng.spawn(1)[0], (0.1, -0.2, 1.3))
        body: Any = made
        body.hold()
        mocap = config.mocap.model_copy(update={"dropout": 0.05, "outlier": 0.2, "latency_us": 31_000})
        marked = self.varied(config.markers).model_copy(
            update={"mislabelled": 0.1, "ghosts": self.pick(0, 2)}
        )
        markers = VirtualMarkers(marked, body.markers, self.rng.spawn(1)[0])
        cameras = {
            "plain": VirtualMocap(self.varied(mocap), self.rng.spawn(1)[0]),
            "marked": VirtualMocap(self.varied(mocap), self.rng.spawn(1)[0], markers),
        }
        imu, later = (VirtualImu(self.varied(config.imu), self.rng.spawn(1)[0]) for _ in range(2))
        sensors = OwnSensors(
            {"wind": OwnSensor(("x", "y", "z"), "m/s", lambda: body.flow_W),
             "height": OwnSensor(("h",), "m", lambda: (body.p_WB[2],))},
            {"height": SensorConfig(noise=0.1, delay_us=4_000, dropout=0.3)}, self.rng.spawn(1)[0],
        )  # fmt: skip
        for number in range(250):
            body.place(
                (*self.three(0.2)[:2], 1.15 + self.three(0.1)[0]), self.turn(0.3), omega_B=self.three(2.0)
            )
            self.change(cameras[self.pick("plain", "marked")], markers, imu)
            for name, camera in cameras.items():
                frame, arrival_us = camera.expose(5_000 * number, body)
                self.note(name, frame, arrival_us)
                if camera.sighting is not None:
                    self.see(camera.sighting)
            for _ in range(self.below(4)):
                self.note("imu", imu.sample(body), imu.rate_range, imu.noise_scale, imu.rate_bias, imu.frozen)
            if self.below(20) == 0:
                later.continue_from(imu)
                twin = imu.twin()
                self.note("later", later.sample(body), twin.sample(body), twin.sample(body))
            sensors.sample(events.now_us, events)
            events.run(events.now_us + self.pick(1_000, 3_999, 4_000, 10_000))
            for one in sensors.channels():
                self.note("sensed", one.quantities[0].names, one.quantities[0].unit, one.read())
        return self.log.told()

    def see(self, sighting: Sighting) -> None:
        self.note("sighting", sighting, sighting.bits, sighting.unlabelled)

    def change(self, camera: VirtualMocap, markers: VirtualMarkers, imu: VirtualImu) -> None:
        what, size = self.pick("camera", "markers", "imu", "", ""), self.rng.random()
        if what == "camera":
            name = self.pick("dropout", "outlier", "wrong_by", "swapped_by", "more_latency_us", "frozen")
            setattr(camera, name, self.pick(0.0, 0.0, size * (9_000.0 if name.endswith("us") else 0.4)))
        elif what == "markers":
            name, most = self.pick(("hidden", 6.0), ("swapped", 1.0), ("noise_scale", 3.0), ("ghosts", 3.0))
            setattr(markers, name, self.pick(0.0, 0.0, float(round(most * size, 1))))
        elif what == "imu":
            act: Callable[[], object] = self.pick(
                partial(imu.set_noise_scale, 3.0 * size), partial(imu.set_noise_scale, -1.0),
                partial(imu.set_rate_bias, *self.three(0.3)), partial(imu.set_rate_range, 40.0 * size),
                partial(imu.freeze, size < 0.5), partial(imu.silence, size < 0.5),
            )  # fmt: skip
            self.attempt("imu set", act)


class Pins(Used):
    """A board's pins before and after its processor has booted."""

    def told(self) -> dict[str, str]:
        events, board = EventQueue(), None
        kernel: Any = type("", (), {"now_us": 0, "stop_before": lambda _, us: self.note("stop", us)})()
        uart: Any = type("", (), {
            "overruns": 7, "read": lambda _: b"read",
            "write": lambda _, us, data: self.note("uart", us, data) or len(data) < 3,
        })()  # fmt: skip
        requests = Requests(
            *(partial(self.note, kind) for kind in ("reset", "command")),
            lambda *of: self.note("fail", *of) or 5,  # type: ignore[arg-type, return-value, func-returns-value]
        )
        parts = (
            (lambda *of: self.note("servo", *of)),
            (lambda us, data: self.note("radio", us, data) or len(data) < 3),
        )
        for number in range(300):
            if number % 60 == 0:
                given = (uart, requests, bytearray(b"own"), {"heat": np.zeros(1)})[: number // 60]
                board = VirtualBoard(*parts, partial(self.note, "console"), *given)  # type: ignore[arg-type]
                self.note("made", board.imu, board.battery_mv, hash_of(board.eeprom), sorted(board.sensors))
            assert board is not None
            kernel.now_us += self.below(2_000)
            what = self.pick("boot", "run", "plan", *(12 * ["use"]))
            if what == "boot":
                board.boot(self.below(10_000))
            elif what == "run":
                board.run_on(kernel, events)
            elif what == "plan":
                events.at(events.now_us + self.below(9_000), int)
                events.run(events.now_us + self.below(3_000))
            else:
                name, given = self.pick(
                    ("measure", (self.rng.integers(-9, 9, 6),)), ("supply", (self.below(4_000),)), ("read_battery_mv", ()),
                    ("write_compare", ((1, 2, 3, 4),)), ("radio_send", (self.data(1, 5),)), ("radio_command", (5, b"x")),
                    ("uart_read", ()), ("uart_write", (self.data(1, 5),)), ("debug_write", ("text",)), ("reset", ()),
                    ("inject_failure", (1, 2, 3)),
                )  # fmt: skip
                self.note(name, getattr(board, name)(*given))
            self.note("state", board.now_us, board.uart_overruns, board.battery_mv, board.imu)
        load = CpuLoad()
        for load.share in (0.0, 0.2, 0.3334, 1.0):
            self.note("load", load.taken_us())
        return self.log.told()


class Window(Used):
    """Samples on the way to a board whose reports are late, old or wrong."""

    def told(self) -> dict[str, str]:
        window, now_us, received, used, lost = SampleWindow(), 0, 0, 0, 0
        for number in range(1500):
            now_us += self.pick(0, 300, 1_000, 1_000, 60_000 if number % 20 == 0 else 0)
            if not window.full:
                window.put((number, number + 1, number + 2))
            packet = window.packet(now_us)
            self.note("packet", number, packet)
            if packet is not None and self.below(12):
                received = window._sent
            elif packet is not None:
                lost += 1
            used = max(used, received - self.below(9))
            told_used, told_received = self.pick(
                *(9 * [(used, received)]), (used - 3, received), (used, received + 99)
            )
            names = {"used": told_used & 0xFFFF, "received": told_received & 0xFFFF, "lost": lost}
            report = Loop(**{name: names.get(name, 0) for name in Loop._fields})
            if self.below(2):
                self.note("report", window.on_report(report, now_us))
            self.note("state", window.count, window.used, window.batch, window.repeated, window.full)
        return self.log.told()


def fixed() -> dict[str, str]:
    """Return what simple functions return: shapes, places, times on the air, addresses, angles, the end of a charge."""
    used = Used(1)
    for shape in (box((1.0, 2.0, 3.0)), cylinder(1.0, 2.0), ball(1.5), disc(0.5)):
        used.note("shape", shape)
    where = (1.0, 2.0, 3.0), "#123456"
    for shape in (
        box((1.0, 2.0, 3.0), *where), cylinder(1.0, 2.0, *where), ball(1.5, *where), disc(1.0, *where),
    ):  # fmt: skip
        used.note("placed", shape)
    used.note("markers", eight_markers(0.2))
    for number, first in ((1, ""), (2, ""), (16, ""), (1, "0102030405"), (3, "01020304FE")):
        used.note("address", address_of(number, first).hex())
        for rate in RATES:
            radio = RadioConfig(bits_per_second=rate, channel=81, address=first)  # type: ignore[arg-type]
            used.note(
                "factory", factory_config(number, radio).hex(), air_us(7, rate), exchange_us(3, 32, rate)
            )
    for counts in ((10_499, 10_500, 31_500, 52_501), (52_500, 42_000, 21_000, 0)):
        used.note("angles", commanded_angles(counts, (0.1, 0.2, 0.3, 0.4), (1.0, 2.0, 3.0, 4.0)))
    for now_us in (0, 1, 2_500, 2_501, 5_000, 5_001, 123_456_789):
        used.note("period", next_period_us(now_us))
    for name, failure in sorted((SERVO_FAILURES | MOTOR_FAILURES).items()):
        used.note("failures", name, failure)
    battery = load_config().battery
    for power, empty_V in ((0.0, 3.0), (3.4, 3.0), (9.0, 3.3), (100.0, 3.0)):
        used.note("endurance", endurance(battery.model_copy(update={"capacity": 90.0}), power, empty_V))
    for _ in range(100):
        room = Room(used.three(1.0)[0], 1.0 + used.rng.random(), 2.0)
        q, direction = np.array(used.turn()), np.array(used.three(1.0))
        q, direction = q / np.linalg.norm(q), direction / np.linalg.norm(direction)
        used.note("room", room.distance(used.three(1.0), direction.tolist(), used.pick(1.0, 0.97, 0.6)))
        used.note("turned", to_world(q.tolist(), used.three(1.0)), to_body(q.tolist(), used.three(1.0)))
    return used.log.told()


KINDS = (Flown, Flying, OwnBody, Carried, Watched, Pins, Window)
FOUND = by_seed(KINDS, SEEDS, lambda kind, seed: kind(seed).told()) | {"fixed": fixed}


# They reach no line that the others do not.
LONG = [f"{kind} {seed}" for kind in ("Watched", "OwnBody", "Carried", "Window", "Flown") for seed in (1, 2)]


@pytest.mark.parametrize("name", tiers(FOUND, LONG))
def test_the_world_answers_random_use_as_it_did(name: str) -> None:
    judge(USES, name, FOUND[name]())


if __name__ == "__main__":
    approve(USES, FOUND)
