"""A Crazyflie in the air of a room: four motors on a rigid body, the floor below it, the walls around it.

Frames: W world (z up, the floor at 0), B body (x forward, y left, z up, at the centre of mass). The motors count as in the
firmware: M1 front right, M2 back right, M3 back left, M4 front left; seen from above M1 and M3 turn counter-clockwise.
The keys of `QuadrotorConfig` name the sources of all constants; the firmware also uses one curve, `volts_to_thrust`: both
have it from Bitcraze's measurement. Brushed motors take PWM; brushless ones have ESCs, which take DSHOT.

The truth is computed per whole millisecond, as for every body.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import partial
from typing import Annotated, Literal

import numpy as np
from pydantic import Field

from firmware_py.compiling import bound
from firmware_py.core.subset import F64s, Struct, f64, i32
from firmware_py.elementary import cos
from firmware_py.section import Section, number
from hil.world.body import Channel, Failure, Quantity, Setting, Vector, View, of_each_actuator
from hil.world.config import BatteryConfig, PlantConfig, TunnelConfig
from hil.world.fixed_order import atan2, compiled, exp, normal
from hil.world.in_tunnel import UPRIGHT, TunnelBody, seen, settings_of
from hil.world.motion import GRAVITY, accelerate, begin, lose, move, surround
from hil.world.room import Room
from hil.world.scene import CENTRE, PALE, Markers, VisualModel, box, eight_markers
from hil.world.structs import NOISE_ROWS, Air, Rigid
from hil.world.tunnel import Tunnel

ORANGE = "#e69f00"
OUTPUTS = {  # of M1 to M4, timer and channel counted from 0: TIM2_CH2, TIM2_CH4, TIM2_CH1, and TIM4_CH4 or TIM2_CH3
    "brushed": ((1, 1), (1, 3), (1, 0), (3, 3)),
    "brushless": ((1, 1), (1, 3), (1, 0), (1, 2)),
}
# Of what the outputs carry: TIM2 and TIM4 count to 255, and DSHOT has 11 bits. The firmware's 16 bits lose their lower ones.
STEPS = {"brushed": 256, "brushless": 2048}
RADIANS_PER_RPM = 2.0 * math.pi / 60.0
FRONT, LEFT = (1.0, -1.0, -1.0, 1.0), (-1.0, -1.0, 1.0, 1.0)  # where the motors are
TURN = (1.0, -1.0, 1.0, -1.0)  # of the propellers about z of B

LEFT_ROOM, TOO_HIGH, HIT_FLOOR, TUMBLED = 1, 2, 3, 4  # causes of a loss
LOSS_TEXTS = {
    LEFT_ROOM: "left the room: {:.2f} m from its middle",
    TOO_HIGH: "hit the ceiling at {:.2f} m",
    HIT_FLOOR: "hit the floor at {:.2f} m/s",
    TUMBLED: "tumbled: tilt {:.2f} rad",
}
MOTOR_FAILURES = of_each_actuator({
    "motor.weak.{}": Failure(
        "factor on thrust and torque of propeller {}, as of a chipped one", "", 0.8, 0.0, 1.5, "motor.strength.{}", "times",
        "holds",
    ),
    "motor.stop.{}": Failure("motor {} gets no current", "", 0.0, 0.0, 0.0, "motor.current.{}", "times", "lost"),
    "motor.stuck.{}": Failure(
        "motor {} stays at its last command", "", 0.0, 0.0, 0.0, "motor.obeys.{}", "times", "lost"
    ),
})  # fmt: skip

Positive = Annotated[float, Field(gt=0.0)]


class QuadrotorConfig(Section):
    """A Crazyflie and the room around it; the defaults are a 2.1+ with its battery of 250 mAh and no deck.

    "Förster" is his bachelor's thesis, "System Identification of the Crazyflie 2.0 Nano Quadrocopter", ETH Zurich 2015;
    "crazyflow" the parameters of the simulator of the same name, 0.4 (Learning Systems and Robotics Lab, 2025), cf2x_P250.
    """

    mass: float = number(0.029, "(0.005, 1]", "[kg]; Bitcraze's data sheet, and CF_MASS of its firmware")
    inertia: tuple[float, float, float] = Field(
        (16.571710e-6, 16.655602e-6, 29.261652e-6), description="about x, y, z of B [kg m2]; Förster"
    )
    arm: float = number(0.046, "(0.01, 0.5]", "centre to motor [m]; ARM_LENGTH of Bitcraze's firmware")
    motors: Literal["brushed", "brushless"] = Field(
        "brushed",
        description="brushed, on a board of device type CF21, or brushless with ESCs, on one of C21B",
    )
    volts_to_thrust: tuple[float, float, float, float] = Field(
        (-0.02476537915958403, 0.06523793527519485, -0.026792504967750107, 0.006776789303971145),
        description="thrust of one motor [N] over its voltage, from the constant to the cubic; crazyflie-firmware 2a18fc29, "
        'platform_defaults_cf2.h, and Bitcraze\'s report of October 2025, "Keeping thrust consistent as the battery drains"',
    )
    curve_begin: float = number(0.4558, "(0, 5]", "the curve holds from here on [V]; its zero")
    dead_share: float = number(
        0.0, "[0, 0.9]", "share of curve_begin up to which motors stand, then linear in speed [1]; chosen"
    )
    rpm_to_thrust: tuple[float, Positive] = Field(
        (-3.6200226530383495e-7, 1.6060924304100328e-10),
        description="thrust of one propeller [N] over its speed, linear and quadratic; crazyflow",
    )
    rpm_to_torque: tuple[float, Positive] = Field(
        (-2.2665265829562245e-9, 1.1149485566919186e-12),
        description="torque of one propeller [N m] over its speed, linear and quadratic; crazyflow",
    )
    rotor_lag: float = number(
        0.0647, "(0.001, 0.5]", "of a rotor's speed, first order [s]; Förster: pole 0.96954 at 500 Hz"
    )
    rotor_inertia: float = number(26.97e-9, "[0, 1e-5]", "of a propeller with its motor [kg m2]; crazyflow")
    rotor_drag: tuple[float, float] = Field(
        (9.1785e-7, 10.311e-7),
        description="force per airspeed and sum of the rotors' speeds, sideways and along z [kg]; Förster",
    )
    rotor_radius: float = number(0.0231348, "(0, 0.3]", "[m]; Förster")
    rotor_above: float = number(0.010, "[-0.1, 0.1]", "propellers above the centre of mass [m]; chosen")
    ground_effect: float = number(
        11.36859,
        "[0, 50]",
        "gain g in T/T0 = 1 + g (R / 4 z)2; gym-pybullet-drones, cf2x; 1: Cheeseman and Bennett",
    )
    foot_below: float = number(0.015, "(0, 0.1]", "feet below the centre of mass [m]; chosen")
    vibration: tuple[float, float] = Field(
        (0.02, 0.5),
        description="rms of what the rotors add to one sample of gyro [rad/s] and accelerometer [m/s2] in a hover, over the "
        "square of their speeds; chosen: Bitcraze's Kalman filter assumes 0.1 rad/s, and its test of one propeller passes "
        "1.1 m/s2 (2.5 g2 in 100 samples of two axes)",
    )
    floor_stiffness: float = number(
        150.0, "(0, 5000]", "under one foot [N/m]; chosen: 0.5 mm under the weight"
    )
    floor_damping: float = number(1.2, "[0, 50]", "under one foot [N s/m]; chosen: about half of critical")
    floor_friction: float = number(0.5, "[0, 2]", "coefficient [1]; chosen")
    motor_power: float = number(
        24.1, "[0, 200]", "from the battery per thrust [W/N]; Bitcraze's table of 2015: 0.236 W per gram"
    )
    motor_spread: float = number(
        0.02, "[0, 0.3]", "standard deviation of the motors' strengths, drawn once [1]; chosen"
    )
    room: float = number(2.0, "(0.2, 50]", "the robot is lost so far from the middle, sideways [m]; chosen")
    ceiling: float = number(2.5, "(0.2, 50]", "and so high [m]; chosen")
    impact: float = number(
        2.0, "(0, 20]", "and when it hits the floor faster than that [m/s]; chosen: a fall from 20 cm"
    )
    tilt: float = number(math.pi / 2, f"(0, {math.pi})", "and tilted so far [rad]; chosen")


class Rotors(Struct):
    """The motors and propellers, and how hard the feet meet the floor."""

    command: Annotated[F64s, 4]  # share of the supply voltage
    wanted: Annotated[F64s, 4]  # [N] at which the thrusts would settle if nothing had failed
    duty: Annotated[F64s, 4]  # share of the supply voltage that a motor gets
    rpm: Annotated[F64s, 4]  # of the propellers
    spin_up: Annotated[F64s, 4]  # [rpm/s]
    thrust: Annotated[F64s, 4]  # [N]
    energy: f64  # [J] taken by the motors since the start
    touched: i32  # 1: the feet were on the floor a step before
    sinking: f64  # [m/s] when the step began
    # Inputs from outside
    supply: f64  # [V] at the motors' drivers
    strength: Annotated[F64s, 4]  # thrust and torque over the nominal
    current: Annotated[F64s, 4]  # 0: the motor's wire is broken
    obeys: Annotated[F64s, 4]  # 0: the duty stays
    # Constants
    x: Annotated[F64s, 4]  # [m] of the motors, in B
    y: Annotated[F64s, 4]
    turn: Annotated[F64s, 4]  # 1, -1: of the propellers about z of B
    lag: f64  # [s]
    inertia: f64
    drag: Annotated[F64s, 3]  # [kg] in B
    ground_gain: f64
    radius: f64  # [m]
    above: f64  # [m] the centre of mass
    shaking: Annotated[F64s, 2]  # [rad/s, m/s2] per rms of the rotors' squared speeds [rpm2]
    power: f64  # [W/N] of the motors
    volts_to_thrust: Annotated[F64s, 4]  # from the constant to the cubic
    rpm_to_thrust: Annotated[F64s, 2]  # linear, quadratic
    rpm_to_torque: Annotated[F64s, 2]
    curve_begin: f64  # [V]
    dead_volts: f64  # [V] up to here a motor stands
    slow_rpm: f64  # [rpm/V] between the two
    impact_max: f64  # [m/s]


@compiled
def thrust_at(rotors: Rotors, rpm: float) -> float:
    """Return the nominal thrust [N] of a propeller at a speed."""
    return max(f64(rpm * (rotors.rpm_to_thrust[0] + rpm * rotors.rpm_to_thrust[1])), 0.0)


@compiled
def rpm_for(rotors: Rotors, thrust: float) -> float:
    """Return the speed [rpm] at which a propeller has a thrust [N]."""
    a, b = rotors.rpm_to_thrust[0], rotors.rpm_to_thrust[1]
    return f64((-a + math.sqrt(a * a + 4.0 * b * thrust)) / (2.0 * b))


@compiled
def curve_rpm(rotors: Rotors, volts: float) -> float:
    """Return the speed [rpm] that the curve of thrust over voltage has at a voltage."""
    c = rotors.volts_to_thrust
    return rpm_for(rotors, max(c[0] + volts * (c[1] + volts * (c[2] + volts * c[3])), 0.0))


@compiled
def steady_rpm(rotors: Rotors, volts: float) -> float:
    """Return the speed [rpm] at which a propeller turns with a voltage at its motor."""
    if volts <= rotors.curve_begin:
        return max(volts - rotors.dead_volts, 0.0) * rotors.slow_rpm
    return curve_rpm(rotors, volts)


@compiled
def calibrate(body: Rigid, rotors: Rotors) -> None:
    """Compute the slope of slow speeds, and the vibration of a speed from that in hover, which `shaking` has before."""
    rotors.slow_rpm = curve_rpm(rotors, rotors.curve_begin) / (rotors.curve_begin - rotors.dead_volts)
    hover_rpm = rpm_for(rotors, 0.25 * body.mass * GRAVITY)
    for i in range(2):
        rotors.shaking[i] = rotors.shaking[i] / (2.0 * (hover_rpm * hover_rpm))


@compiled
def spin(rotors: Rotors, duration: float) -> None:
    """Bring the propellers towards the speeds of their voltages, for `duration` [s]."""
    for i in range(4):
        wanted = steady_rpm(rotors, rotors.duty[i] * rotors.supply * rotors.current[i])
        n = rotors.rpm[i]
        rotors.rpm[i] = wanted + (n - wanted) * exp(-duration / rotors.lag)
        rotors.spin_up[i] = (rotors.rpm[i] - n) / duration


@compiled
def settle(rotors: Rotors) -> None:
    """Write the thrusts that the commands lead to."""
    for i in range(4):
        rotors.wanted[i] = thrust_at(rotors, steady_rpm(rotors, rotors.command[i] * rotors.supply))


@compiled
def near_ground(body: Rigid, rotors: Rotors) -> float:
    """Return by what factor the floor raises the thrust."""
    height = max(f64(body.p_WB[2] - body.net_height + rotors.above), rotors.radius)
    share = rotors.radius / (4.0 * height)
    return 1.0 + rotors.ground_gain * share * share


@compiled
def evaluate(body: Rigid, air: Air, rotors: Rotors) -> None:
    """Compute forces and accelerations from state, inputs and constants."""
    surround(body, air)
    lift, mx, my, mz, turning, momentum, squares = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    gain = near_ground(body, rotors)
    for i in range(4):
        n = rotors.rpm[i]
        thrust = gain * rotors.strength[i] * thrust_at(rotors, n)
        drag = rotors.strength[i] * max(n * (rotors.rpm_to_torque[0] + n * rotors.rpm_to_torque[1]), 0.0)
        torque = drag + rotors.inertia * RADIANS_PER_RPM * rotors.spin_up[i]
        rotors.thrust[i] = thrust
        lift = lift + thrust
        mx = mx + rotors.y[i] * thrust
        my = my - rotors.x[i] * thrust
        mz = mz - rotors.turn[i] * torque
        turning = turning + RADIANS_PER_RPM * n
        momentum = momentum + rotors.inertia * RADIANS_PER_RPM * rotors.turn[i] * n
        squares = squares + (n * n) * (n * n)
    body.vibration[0] = rotors.shaking[0] * math.sqrt(squares)
    body.vibration[1] = rotors.shaking[1] * math.sqrt(squares)
    f = body.wrench_B
    for i in range(3):
        f[i] = rotors.drag[i] * turning * air.wind_B[i]
    f[2] = f[2] + lift
    f[3] = mx - body.omega_B[1] * momentum  # omega x h of the propellers
    f[4] = my + body.omega_B[0] * momentum
    f[5] = mz
    accelerate(body)


@compiled
def watch(body: Rigid, rotors: Rotors) -> None:
    """Record the first reason why the flight is over."""
    radius = max(abs(body.p_WB[0]), abs(body.p_WB[1]))
    height = body.p_WB[2] - body.net_height
    cos_tilt = body.R_WB[2, 2]
    touches = body.ground[2] > 0.0
    if radius > body.limit_radius:
        lose(body, LEFT_ROOM, radius)
    elif height > body.limit_above:
        lose(body, TOO_HIGH, height)
    elif touches and rotors.touched == 0 and rotors.sinking > rotors.impact_max:
        lose(body, HIT_FLOOR, rotors.sinking)
    elif cos_tilt < body.limit_cos_tilt:
        lose(body, TUMBLED, atan2(math.sqrt(1.0 - cos_tilt * cos_tilt), cos_tilt))
    rotors.touched = i32(touches)


@compiled
def step(body: Rigid, air: Air, rotors: Rotors, draws: F64s) -> None:
    """Advance by one step: the midpoint rule; its accelerations hold for the start."""
    begin(body, air, draws)
    duration = body.step_us * 1e-6  # [s]
    thrust = rotors.thrust[0] + rotors.thrust[1] + rotors.thrust[2] + rotors.thrust[3]
    rotors.energy = rotors.energy + rotors.power * thrust * duration
    if body.held != 0:
        spin(rotors, duration)
        evaluate(body, air, rotors)
        return
    rotors.sinking = -body.v_WB[2]
    for part in range(2):
        body.duration = 0.5 * f64(1 + part) * duration
        move(body)
        spin(rotors, 0.5 * duration)
        evaluate(body, air, rotors)
    if body.lost == 0:
        watch(body, rotors)


@compiled
def advance(body: Rigid, air: Air, rotors: Rotors, draws: F64s) -> None:
    """Do every step that is due, as long as there are draws."""
    for _ in range(air.noise_row, NOISE_ROWS):
        if body.time_us + body.step_us > body.until_us:
            return
        step(body, air, rotors, draws)


class Quadrotor(TunnelBody):
    """The robot, its motors and the room, in the air of a tunnel whose fans may stand still.

    Beside the views of every body: rpm, thrust (4,) of the rotors [rpm, N]; escs those speeds for the ESCs of brushless
    motors, None with brushed ones. `rotors` is the memory of the kernels.
    """

    loss_texts = LOSS_TEXTS

    def __init__(
        self,
        config: QuadrotorConfig,
        tunnel: TunnelConfig,
        battery: BatteryConfig,
        rng: np.random.Generator,
        p_WB: Vector | None = None,
    ) -> None:
        """Start at rest, motors off, on the floor in the middle of the room unless `p_WB` [m] says otherwise."""
        body, self.rotors = Rigid.allocate(), Rotors.allocate()
        super().__init__(body, Tunnel(tunnel), PlantConfig(), rng)
        b, r = body.fields, self.rotors.fields
        b.tether_length, b.net_height = math.inf, 0.0
        b.mass, b.inertia[:] = config.mass, config.inertia
        arm_xy = config.arm * math.sqrt(0.5)
        r.x[:], r.y[:], r.turn[:] = np.multiply(FRONT, arm_xy), np.multiply(LEFT, arm_xy), TURN
        r.lag, r.inertia, r.power = config.rotor_lag, config.rotor_inertia, config.motor_power
        sideways, along = config.rotor_drag
        r.drag[:] = sideways, sideways, along
        r.volts_to_thrust[:] = config.volts_to_thrust
        r.rpm_to_thrust[:], r.rpm_to_torque[:] = config.rpm_to_thrust, config.rpm_to_torque
        r.curve_begin, r.dead_volts = config.curve_begin, config.curve_begin * config.dead_share
        r.shaking[:] = config.vibration
        bound(calibrate, body, self.rotors)()
        r.ground_gain, r.radius, r.above = config.ground_effect, config.rotor_radius, config.rotor_above
        b.foot_spread, b.foot_below = arm_xy, config.foot_below
        b.foot_reach = math.sqrt(config.arm * config.arm + config.foot_below * config.foot_below)
        b.net_stiffness, b.net_damping = config.floor_stiffness, config.floor_damping
        b.friction = config.floor_friction
        b.limit_radius, b.limit_above, r.impact_max = config.room, config.ceiling, config.impact
        b.limit_cos_tilt = cos(config.tilt)
        r.current[:] = r.obeys[:] = 1.0
        r.strength[:] = 1.0 + config.motor_spread * normal(rng, 4)
        self._config = config
        self.room = Room(0.0, config.room, config.ceiling)
        self._settle = bound(settle, self.rotors)
        memory = body, self.tunnel.air, self.rotors
        self._evaluate, self._advance = bound(evaluate, *memory), bound(advance, *memory, self._draws)
        self.rpm, self.thrust = seen(r.rpm), seen(r.thrust)
        self.outputs: Sequence[tuple[int, int]] = OUTPUTS[config.motors]
        self.escs = self.rpm if config.motors == "brushless" else None
        self._electronics = self._power = battery.electronics_power
        self._drawn_us, self._drawn_J = 0, 0.0
        self._energy = self.rotors.cell("energy")
        self.settings: Mapping[str, Setting] = settings_of(
            {"motor.strength": r.strength, "motor.current": r.current, "motor.obeys": r.obeys}
        )
        sunk = config.mass * GRAVITY / (4.0 * config.floor_stiffness)
        self.place((0.0, 0.0, config.foot_below - sunk) if p_WB is None else p_WB, UPRIGHT)

    def set_counts(self, now_us: int, counts: Sequence[int]) -> None:
        """Take the compare counts of M1 to M4, or their throttles; a PWM period of 3 us is no delay."""
        self.advance(now_us)
        steps, r = STEPS[self._config.motors], self.rotors.fields
        for i, count in enumerate(counts):
            r.command[i] = duty = min(max(count, 0), steps) / steps
            if r.obeys[i] != 0.0:
                r.duty[i] = duty

    def draw(self, now_us: int, cell_V: float) -> float:
        """Return the mean power [W] of electronics and motors since the last call; the motors run on `cell_V` [V]."""
        self.rotors.fields.supply = cell_V
        duration, taken_J = 1e-6 * (now_us - self._drawn_us), self._energy[0]
        if duration > 0.0:
            self._power = self._electronics + (taken_J - self._drawn_J) / duration
            self._drawn_us, self._drawn_J = now_us, taken_J
        return self._power

    def channels(self) -> tuple[Channel, ...]:
        """Return speed and thrust of the rotors, and the thrust that each would settle at if nothing had failed."""
        return tuple(
            Channel("float32", read, (Quantity(tuple(f"rotor.{name}_{i}" for i in (1, 2, 3, 4)), unit),))
            for name, read, unit in (
                ("rpm", partial(_same, self.rpm), "rpm"),
                ("thrust", partial(_same, self.thrust), "N"),
                ("command", self._commanded_thrust, "N"),
            )
        )

    def _commanded_thrust(self) -> View:
        self._settle()
        return self.rotors.fields.wanted

    @property
    def look(self) -> VisualModel:
        """Two beams with a rotor at each end, the front ones orange, and the board between them."""
        r, above = self.rotors.fields, self._config.rotor_above
        ends = [(x, y, 0.0) for x, y in zip(r.x.tolist(), r.y.tolist(), strict=True)]
        beams = tuple(np.array((ends[i], ends[i + 2])) for i in (0, 1))
        size = 2.0 * self._config.rotor_radius
        rotors = [
            replace(
                box((size, size, 0.002), (x, y, above), ORANGE if x > 0.0 else PALE),
                name=f"M{i + 1}", label=str(i + 1),
            )
            for i, (x, y, _) in enumerate(ends)
        ]  # fmt: skip
        board = box((0.03, 0.03, 0.012))
        return VisualModel(
            (board, *rotors), beams, beams, CENTRE, tuple(map(tuple, self.markers.places.tolist()))
        )

    @property
    def markers(self) -> Markers:
        """Eight markers, as on a marker deck with arms."""
        return Markers(eight_markers(self._config.arm))


def _same(view: View) -> View:
    return view
