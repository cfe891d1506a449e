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
from numpy.typing import NDArray
from pydantic import Field

from firmware_py.compiling import bound
from firmware_py.elementary import cos
from firmware_py.section import Section, number
from hil.scene import CENTRE, PALE, Look, Markers, box, eight_markers
from hil.world import layout as at
from hil.world.body import Channel, Quantity, Setting, Vector, View
from hil.world.config import BatteryConfig, PlantConfig, TunnelConfig
from hil.world.fixed_order import atan2, compiled, exp, normal
from hil.world.in_tunnel import UPRIGHT, InTunnel
from hil.world.motion import GRAVITY, accelerate, gust, move, surround
from hil.world.plates import State
from hil.world.room import Room
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

# Places of the array behind those that bodies share
DUTY = at.SIZE  # (4,) share of the supply voltage that a motor gets
RPM = DUTY + 4  # (4,) of the propellers
SPIN_UP = RPM + 4  # (4,) [rpm/s]
SUPPLY = SPIN_UP + 4  # [V] at the motors' drivers
STRENGTH = SUPPLY + 1  # (4,) thrust and torque over the nominal
CURRENT = STRENGTH + 4  # (4,) 0: the motor's wire is broken
OBEYS = CURRENT + 4  # (4,) 0: the duty stays
THRUST = OBEYS + 4  # (4,) [N]
LAG = THRUST + 4  # [s]
ARM_XY = LAG + 1  # [m]
MOTOR_POWER = ARM_XY + 1  # [W/N]
ENERGY = MOTOR_POWER + 1  # [J] taken by the motors since the start
ROTOR_INERTIA = ENERGY + 1
ROTOR_DRAG = ROTOR_INERTIA + 1  # (2,) sideways, along z
GROUND_GAIN = ROTOR_DRAG + 2
ROTOR_RADIUS = GROUND_GAIN + 1
ROTOR_ABOVE = ROTOR_RADIUS + 1
IMPACT_MAX = ROTOR_ABOVE + 1
TOUCHED = IMPACT_MAX + 1  # 1: the feet were on the floor a step before
SINKING = TOUCHED + 1  # [m/s] when the step began
SHAKING = SINKING + 1  # (2,) [rad/s, m/s2] per rms of the rotors' squared speeds [rpm2]
VOLTS_TO_THRUST = SHAKING + 2  # (4,) from the constant to the cubic
RPM_TO_THRUST = VOLTS_TO_THRUST + 4  # (2,) linear, quadratic
RPM_TO_TORQUE = RPM_TO_THRUST + 2  # (2,)
CURVE_BEGIN = RPM_TO_TORQUE + 2  # [V]
DEAD_VOLTS = CURVE_BEGIN + 1  # [V] up to here a motor stands
SLOW_RPM = DEAD_VOLTS + 1  # [rpm/V] between the two
SIZE = SLOW_RPM + 1

LEFT_ROOM, TOO_HIGH, HIT_FLOOR, TUMBLED = 1, 2, 3, 4  # causes in LOST
LOSS_TEXTS = {
    LEFT_ROOM: "left the room: {:.2f} m from its middle",
    TOO_HIGH: "hit the ceiling at {:.2f} m",
    HIT_FLOOR: "hit the floor at {:.2f} m/s",
    TUMBLED: "tumbled: tilt {:.2f} rad",
}


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


@compiled
def thrust_at(s: State, rpm: float) -> float:
    """Return the nominal thrust [N] of a propeller at a speed."""
    return max(rpm * (float(s[RPM_TO_THRUST]) + rpm * float(s[RPM_TO_THRUST + 1])), 0.0)


@compiled
def rpm_for(s: State, thrust: float) -> float:
    """Return the speed [rpm] at which a propeller has a thrust [N]."""
    a, b = float(s[RPM_TO_THRUST]), float(s[RPM_TO_THRUST + 1])
    return (-a + math.sqrt(a * a + 4.0 * b * thrust)) / (2.0 * b)


@compiled
def curve_rpm(s: State, volts: float) -> float:
    """Return the speed [rpm] that the curve of thrust over voltage has at a voltage."""
    c = VOLTS_TO_THRUST
    return rpm_for(s, max(float(s[c] + volts * (s[c + 1] + volts * (s[c + 2] + volts * s[c + 3]))), 0.0))


@compiled
def steady_rpm(s: State, volts: float) -> float:
    """Return the speed [rpm] at which a propeller turns with a voltage at its motor."""
    if volts <= s[CURVE_BEGIN]:
        return max(volts - float(s[DEAD_VOLTS]), 0.0) * float(s[SLOW_RPM])
    return curve_rpm(s, volts)


@compiled
def spin(s: State, duration: float) -> None:
    """Bring the propellers towards the speeds of their voltages, for `duration` [s]."""
    for i in range(4):
        wanted = steady_rpm(s, s[DUTY + i] * s[SUPPLY] * s[CURRENT + i])
        n = s[RPM + i]
        s[RPM + i] = wanted + (n - wanted) * exp(-duration / s[LAG])
        s[SPIN_UP + i] = (s[RPM + i] - n) / duration


@compiled
def near_ground(s: State) -> float:
    """Return by what factor the floor raises the thrust."""
    height = max(s[at.P + 2] - s[at.NET_HEIGHT] + s[ROTOR_ABOVE], s[ROTOR_RADIUS])
    share: float = s[ROTOR_RADIUS] / (4.0 * height)
    return 1.0 + float(s[GROUND_GAIN]) * share * share


@compiled
def evaluate(s: State) -> None:
    """Compute forces and accelerations from state, inputs and constants."""
    surround(s)
    lift, mx, my, mz, turning, momentum = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    gain = near_ground(s)
    for i in range(4):
        n = s[RPM + i]
        thrust = gain * s[STRENGTH + i] * thrust_at(s, n)
        torque = s[STRENGTH + i] * max(n * (s[RPM_TO_TORQUE] + n * s[RPM_TO_TORQUE + 1]), 0.0)
        torque += s[ROTOR_INERTIA] * RADIANS_PER_RPM * s[SPIN_UP + i]
        s[THRUST + i] = thrust
        lift += thrust
        mx += LEFT[i] * s[ARM_XY] * thrust
        my -= FRONT[i] * s[ARM_XY] * thrust
        mz -= TURN[i] * torque
        turning += RADIANS_PER_RPM * n
        momentum += s[ROTOR_INERTIA] * RADIANS_PER_RPM * TURN[i] * n
    squares = 0.0
    for i in range(4):
        square = s[RPM + i] * s[RPM + i]
        squares += square * square
    s[at.VIBRATION] = s[SHAKING] * math.sqrt(squares)
    s[at.VIBRATION + 1] = s[SHAKING + 1] * math.sqrt(squares)
    f = at.DRAG
    for i in range(3):
        s[f + i] = s[ROTOR_DRAG + i // 2] * turning * s[at.WIND + i]
    s[f + 2] += lift
    s[f + 3] = mx - s[at.OMEGA + 1] * momentum  # omega x h of the propellers
    s[f + 4] = my + s[at.OMEGA] * momentum
    s[f + 5] = mz
    accelerate(s)


@compiled
def watch(s: State) -> None:
    """Note the first reason why the flight is over."""
    radius = max(abs(s[at.P]), abs(s[at.P + 1]))
    height, down = s[at.P + 2] - s[at.NET_HEIGHT], s[SINKING]
    touches = s[at.GROUND + 2] > 0.0
    cos_tilt = s[at.R + 8]
    cause, value = 0, 0.0
    if radius > s[at.LIMIT_RADIUS]:
        cause, value = LEFT_ROOM, radius
    elif height > s[at.LIMIT_ABOVE]:
        cause, value = TOO_HIGH, height
    elif touches and s[TOUCHED] == 0.0 and down > s[IMPACT_MAX]:
        cause, value = HIT_FLOOR, down
    elif cos_tilt < s[at.LIMIT_COS_TILT]:
        cause, value = TUMBLED, atan2(math.sqrt(1.0 - cos_tilt * cos_tilt), cos_tilt)
    s[TOUCHED] = 1.0 if touches else 0.0
    if cause != 0:
        s[at.LOST], s[at.LOST_VALUE] = cause, value


@compiled
def step(s: State, draws: View, step_us: float) -> None:
    """Advance by one step: the midpoint rule; ACC and ALPHA hold for the start."""
    gust(s, draws)
    duration = step_us * 1e-6  # [s]
    s[at.TIME_US] += step_us
    s[ENERGY] += s[MOTOR_POWER] * (s[THRUST] + s[THRUST + 1] + s[THRUST + 2] + s[THRUST + 3]) * duration
    if s[at.HELD] != 0.0:
        spin(s, duration)
        evaluate(s)
        return
    for i in range(13):
        s[at.BEFORE + i] = s[at.P + i]
    s[SINKING] = -s[at.V + 2]
    for part in range(2):
        s[at.DURATION] = 0.5 * duration if part == 0 else duration
        move(s)
        spin(s, 0.5 * duration)
        evaluate(s)
    if s[at.LOST] == 0.0:
        watch(s)


@compiled
def advance(s: State, draws: View, now_us: NDArray[np.int64]) -> bool:
    """Do every step that ends at or before `now_us[0]`; return True when the draws ran out before that."""
    row = int(s[at.NOISE_ROW])
    while s[at.TIME_US] + at.STEP_US <= now_us[0]:
        if row == draws.shape[0]:
            s[at.NOISE_ROW] = 0.0
            return True
        step(s, draws[row], at.STEP_US)
        row += 1
    s[at.NOISE_ROW] = row
    return False


class Quadrotor(InTunnel):
    """The robot, its motors and the room, in the air of a tunnel whose fans may stand still.

    Beside the views of every body: truth (SIZE,) everything; acceleration_W, alpha_B (3,); rpm, thrust (4,) of the rotors
    [rpm, N]; escs those speeds for the ESCs of brushless motors, None with brushed ones.
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
        s = np.zeros(SIZE)
        super().__init__(s, Tunnel(tunnel, s), PlantConfig(), rng)
        s[at.TETHER_LENGTH], s[at.NET_HEIGHT] = math.inf, 0.0
        s[at.MASS], s[at.INERTIA : at.INERTIA + 3] = config.mass, config.inertia
        s[ARM_XY] = config.arm * math.sqrt(0.5)
        s[LAG], s[ROTOR_INERTIA], s[MOTOR_POWER] = config.rotor_lag, config.rotor_inertia, config.motor_power
        s[ROTOR_DRAG : ROTOR_DRAG + 2] = config.rotor_drag
        s[VOLTS_TO_THRUST : VOLTS_TO_THRUST + 4] = config.volts_to_thrust
        s[RPM_TO_THRUST : RPM_TO_THRUST + 2] = config.rpm_to_thrust
        s[RPM_TO_TORQUE : RPM_TO_TORQUE + 2] = config.rpm_to_torque
        begin, dead = config.curve_begin, config.curve_begin * config.dead_share
        s[CURVE_BEGIN], s[DEAD_VOLTS], s[SLOW_RPM] = begin, dead, curve_rpm(s, begin) / (begin - dead)
        hover_rpm = rpm_for(s, 0.25 * config.mass * GRAVITY)
        s[SHAKING : SHAKING + 2] = np.array(config.vibration) / (2.0 * hover_rpm**2)
        s[GROUND_GAIN], s[ROTOR_RADIUS] = config.ground_effect, config.rotor_radius
        s[ROTOR_ABOVE] = config.rotor_above
        s[at.FOOT_SPREAD], s[at.FOOT_BELOW] = s[ARM_XY], config.foot_below
        s[at.FOOT_REACH] = math.sqrt(config.arm * config.arm + config.foot_below * config.foot_below)
        s[at.NET_STIFFNESS], s[at.NET_DAMPING] = config.floor_stiffness, config.floor_damping
        s[at.FRICTION] = config.floor_friction
        s[at.LIMIT_RADIUS], s[at.LIMIT_ABOVE], s[IMPACT_MAX] = config.room, config.ceiling, config.impact
        s[at.LIMIT_COS_TILT] = cos(config.tilt)
        s[CURRENT : CURRENT + 4] = s[OBEYS : OBEYS + 4] = 1.0
        s[STRENGTH : STRENGTH + 4] = 1.0 + config.motor_spread * normal(rng, 4)
        self._config = config
        self.room = Room(0.0, config.room, config.ceiling)
        self._evaluate, self._advance = bound(evaluate, s), bound(advance, s, self._draws, self._now_us)
        self.truth = self._view(0, SIZE)
        self.acceleration_W, self.alpha_B = self._view(at.ACC, 3), self._view(at.ALPHA, 3)
        self.rpm, self.thrust = self._view(RPM, 4), self._view(THRUST, 4)
        self.outputs: Sequence[tuple[int, int]] = OUTPUTS[config.motors]
        self.escs = self.rpm if config.motors == "brushless" else None
        self._electronics = self._power = battery.electronics_power
        self._drawn_us, self._drawn_J = 0, 0.0
        self._commanded = np.zeros(4)  # share of the supply voltage
        self.settings: Mapping[str, Setting] = self._settings(
            {"motor.strength": STRENGTH, "motor.current": CURRENT, "motor.obeys": OBEYS}
        )
        sunk = config.mass * GRAVITY / (4.0 * config.floor_stiffness)
        self.place((0.0, 0.0, config.foot_below - sunk) if p_WB is None else p_WB, UPRIGHT)

    def set_counts(self, now_us: int, counts: Sequence[int]) -> None:
        """Take the compare counts of M1 to M4, or their throttles; a PWM period of 3 us is no delay."""
        self.advance(now_us)
        steps = STEPS[self._config.motors]
        for i, count in enumerate(counts):
            self._commanded[i] = duty = min(max(count, 0), steps) / steps
            if self._s[OBEYS + i] != 0.0:
                self._s[DUTY + i] = duty

    def draw(self, now_us: int, cell_V: float) -> float:
        """Return the mean power [W] of electronics and motors since the last call; the motors run on `cell_V` [V]."""
        self._s[SUPPLY] = cell_V
        duration, taken_J = 1e-6 * (now_us - self._drawn_us), float(self._s[ENERGY])
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

    def _commanded_thrust(self) -> NDArray[np.float64]:
        volts = self._commanded * self._s[SUPPLY]
        return np.array([thrust_at(self._s, steady_rpm(self._s, one)) for one in volts.tolist()])

    @property
    def look(self) -> Look:
        """Two beams with a rotor at each end, the front ones orange, and the board between them."""
        xy, above = float(self._s[ARM_XY]), self._config.rotor_above
        ends = [(x * xy, y * xy, 0.0) for x, y in zip(FRONT, LEFT, strict=True)]
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
        return Look((board, *rotors), beams, beams, CENTRE, tuple(map(tuple, self.markers.places.tolist())))

    @property
    def markers(self) -> Markers:
        """Eight markers, as on a marker deck with arms."""
        return Markers(eight_markers(self._config.arm))


def _same(view: View) -> View:
    return view
