"""Floaty in the tunnel, as a body of the laboratory (`hil.world.body`): pulses turn flaps, and the flow acts on plates."""

import math
from collections.abc import Sequence

import numpy as np

from firmware_py.compiling import bound
from hil.errors import LabError
from hil.world.body import ACTUATORS, Channel, Failure, Quantity, Vector, View, of_each_actuator
from hil.world.config import BatteryConfig, GeometryConfig, PlantConfig, PlantServoConfig, TunnelConfig
from hil.world.floaty.correction import LEVEL, Constants, OperatingPoint, calm, linearise, trim_and_correct
from hil.world.floaty.drawing import look_of, markers_of
from hil.world.floaty.geometry import weigh
from hil.world.floaty.shape import SIGNS, place_plates
from hil.world.in_tunnel import AT_REST, UPRIGHT, TunnelBody, seen, settings_of
from hil.world.motion import advance, evaluate
from hil.world.scene import Markers, VisualModel
from hil.world.servos import OUTPUTS, commanded_angles, next_period_us
from hil.world.structs import Flaps, FloatyBlocks, Rigid
from hil.world.tunnel import Tunnel

DEG = math.radians(1.0)
LOADS = BatteryConfig()
FLAPS = tuple(f"truth.flap_{number}" for number in ACTUATORS)
PARTS = ("base", "flap1", "flap2", "flap3", "flap4")
PLATES = tuple(f"force.{part}_{axis}" for part in PARTS for axis in "xyz")
SERVO_FAILURES = of_each_actuator({
    "servo.stuck.{}": Failure("flap {} is stuck", "", 0.0, 0.0, 0.0, "servo.pace.{}", "times", "degrades"),
    "servo.slow.{}": Failure("factor on the pace of servo {}", "", 0.5, 0.01, 4.0, "servo.pace.{}", "times", "holds"),
    "servo.trim.{}": Failure(
        "flap {} deviates this far from its command", "deg", 5.0, -45.0, 45.0, "servo.trim.{}", "add", "holds", DEG
    ),
})  # fmt: skip


def assemble(
    geometry: GeometryConfig, config: PlantConfig, tunnel: TunnelConfig
) -> tuple[FloatyBlocks, Tunnel]:
    """Return the plant's memory with the robot, trimmed and corrected, and the knobs of the tunnel around it."""
    knobs = Tunnel(tunnel)
    blocks = FloatyBlocks(Rigid.allocate(), knobs.air, Flaps.allocate())
    body, flaps, weight = blocks.body.fields, blocks.flaps.fields, weigh(geometry)
    place_plates(flaps, geometry, config.hover_angle)
    body.mass, body.tether_height = weight.mass * config.mass_factor, weight.axis_height
    body.inertia[:] = np.array(weight.inertia) * config.inertia_factor
    flaps.drag_factor = config.drag_factor
    flaps.next_us = flaps.after_us = math.inf
    trim_and_correct(blocks, config, weight)
    return blocks, knobs


class Plant(TunnelBody):
    """Body, servos, tether and the air around them; these views of the truth besides those of `TunnelBody`:

    blocks the kernels' memory; flaps (4,) [rad] signed flap angles; wrench_B (6,) force [N] and torque [N m] of the flow
    about the centre of mass; zero_offset (4,) [rad] of the servos' middle, for which the board was trimmed; servo_trim (4,)
    [rad] of the mounting and servo_speed (4,) times the usual one, 0: stuck; plate_forces_W (5, 3) of base and four
    flaps as isolated plates, without the identified correction, so they do not add up to the whole force.
    """

    outputs: Sequence[tuple[int, int]] = OUTPUTS

    def __init__(
        self,
        geometry: GeometryConfig,
        config: PlantConfig,
        tunnel: TunnelConfig,
        servos: PlantServoConfig,
        rng_gust: np.random.Generator,
        p_WB: Vector | None = None,
        loads: BatteryConfig = LOADS,
    ) -> None:
        """Start level, at rest, the flaps at the hover angle, at the hover point unless `p_WB` [m] says otherwise.

        From the battery's configuration it takes the power of servos and electronics.
        """
        self.blocks, knobs = assemble(geometry, config, tunnel)
        super().__init__(self.blocks.body, knobs, config, rng_gust)
        self._flaps = f = self.blocks.flaps.fields
        self._airspeed, self._geometry, self._ground = config.airspeed, geometry, config.ground
        f.lag, f.rate_limit, f.dead_band = servos.tau, servos.rate_limit, servos.dead_band
        self.zero_offset = servos.zero_offset
        f.trim[:], f.pace[:] = servos.trim_error, servos.speed
        self.servo_trim, self.servo_speed = seen(f.trim), seen(f.pace)
        self.settings = settings_of({"servo.trim": f.trim, "servo.pace": f.pace})
        self._counts: Sequence[int] = ()
        self._commanded = (SIGNS * config.hover_angle).tolist()
        f.command[:] = self._commanded
        self._evaluate = bound(evaluate, *self.blocks)
        self._advance = bound(advance, *self.blocks, self._draws)
        self.flaps, self.plate_forces_W = seen(f.angle), seen(f.forces)
        self.wrench_B = seen(self._body.wrench_B)
        start = (0.0, 0.0, tunnel.hover_height) if p_WB is None else p_WB
        self.place(start, UPRIGHT, flaps=self._commanded)
        self._at_rest = loads.electronics_power + len(ACTUATORS) * loads.servo_power  # [W]
        self._servo_energy, self._power = loads.servo_energy, self._at_rest
        self._travel = self.blocks.flaps.cell("travel")
        self._drawn_us, self._drawn_travel = 0, self._travel[0]

    def place(
        self,
        p_WB: Vector,
        q_WB: Vector,
        v_WB: Vector = AT_REST,
        omega_B: Vector = AT_REST,
        flaps: Vector | None = None,
    ) -> None:
        """Set the state of the body, and the flaps' angles [rad]; None leaves them unchanged. Raises LabError."""
        if flaps is not None:
            if not all(map(math.isfinite, flaps)):
                raise LabError(f"cannot place the plant with flaps = {flaps}: not finite")
            self._flaps.angle[:] = flaps
        super().place(p_WB, q_WB, v_WB, omega_B)

    def set_counts(self, now_us: int, counts: Sequence[int]) -> None:
        """Take the counts of the four timer registers; they reach the servos at the next PWM period."""
        counts = tuple(counts)
        if counts == self._counts:
            return
        self._counts = counts
        self.advance(now_us)
        self._commanded = commanded_angles(counts, self.zero_offset, self._commanded)
        f = self._flaps
        # An earlier change may have been latched since the last millisecond: then this one follows it.
        if f.next_us <= now_us:
            f.after_us, f.after[:] = next_period_us(now_us), self._commanded
        else:
            f.next_us, f.next[:] = next_period_us(now_us), self._commanded

    @property
    def look(self) -> VisualModel:
        return look_of(self._geometry, self._ground)

    @property
    def markers(self) -> Markers:
        return markers_of(self._geometry, self._ground)

    def draw(self, now_us: int, cell_V: float) -> float:
        """Return the mean power [W] since the last call: electronics, servos at rest, and the flaps' travel."""
        duration = 1e-6 * (now_us - self._drawn_us)
        if duration > 0.0:
            travel = self._travel[0]
            turned, self._drawn_us, self._drawn_travel = travel - self._drawn_travel, now_us, travel
            self._power = self._at_rest + self._servo_energy * turned / duration
        return self._power

    def channels(self) -> tuple[Channel, ...]:
        """Return the flap angles, and the forces of base plate and flaps as isolated plates."""
        plates = self.plate_forces_W.reshape(15)
        return (
            Channel("float64", lambda: self.flaps, (Quantity(FLAPS, "rad", "B"),)),
            Channel("float32", lambda: plates, (Quantity(PLATES, "N", "W"),)),
        )

    def linearise(self, point: OperatingPoint = LEVEL) -> Constants:
        """Return the linearised dynamics about a point of a uniform flow, by default the level hover of the design."""
        return linearise(self.blocks, self._airspeed if point.speed is None else point.speed, point)

    def mounted_wrench(self, flaps: Vector) -> tuple[View, View]:
        """Return force [N] and torque [N m], (3,) each in B, on the robot fixed level in the design's uniform flow."""
        calm_plant = calm(self.blocks, self._airspeed)
        calm_plant.flaps.fields.angle[:] = flaps
        bound(evaluate, *calm_plant)()
        force, torque = np.split(calm_plant.body.fields.wrench_B, 2)
        return force, torque
