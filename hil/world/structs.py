"""The memory of the world: what bodies in the tunnel share, the air around them, and Floaty's flaps.

A body is one `Rigid`, one `Air` and its actuators; compiled kernels take them as records, and truth is read through their
blocks. Units are SI; frames are in the names or comments: W world (z up), B body (x forward, y left, z up, at the centre of
mass). Flaps count 0..3 here, at the quadrants (+,-), (+,+), (-,+), (-,-) of B; plate 2i is the flat part of flap i, 2i+1 its
kink.
"""

from typing import Annotated, NamedTuple

from firmware_py.core.subset import Block, F64s, Struct, f64, i32

STEP_US = 1000
GUSTS = 14
NOISE_ROWS = 2048  # steps of gusts drawn at once


class Rigid(Struct):
    """A rigid body with its tether, the net below it and the limits of its flight."""

    time_us: f64  # on the grid of milliseconds
    until_us: f64  # steps that end at or before this instant are due
    # State: thirteen numbers in one piece
    p_WB: Annotated[F64s, 3]  # [m]
    v_WB: Annotated[F64s, 3]  # [m/s]
    q_WB: Annotated[F64s, 4]  # w x y z
    omega_B: Annotated[F64s, 3]  # [rad/s] of B against W
    before: Annotated[F64s, 13]  # the same at the start of the step
    duration: f64  # [s] of the part of the step since then
    # Computed from the state
    R_WB: Annotated[F64s, 3, 3]
    wrench_B: Annotated[F64s, 6]  # force [N] and torque about the centre of mass [N m] of air and rotors
    pull_W: Annotated[F64s, 3]  # [N] of the tether
    ground: Annotated[F64s, 6]  # force [N] of the net, in W, and its torque [N m], in B
    acceleration_W: Annotated[F64s, 3]  # [m/s2] of the centre of mass, gravity included
    alpha_B: Annotated[F64s, 3]  # [rad/s2]
    specific_force_B: Annotated[F64s, 3]  # [m/s2] as measured by an accelerometer at the centre of mass
    vibration: Annotated[F64s, 2]  # [rad/s], [m/s2] rms per axis of rate and specific force by rotating parts
    # Inputs from outside
    held: i32  # 1: the body is clamped where it is
    push: Annotated[F64s, 6]  # force [N], in W, and torque [N m], in B
    lost: i32  # cause, 0: flying
    lost_value: f64  # value beyond its limit: [m] or [rad]
    # Constants
    step_us: f64
    mass: f64
    inertia: Annotated[F64s, 3]  # about x, y, z of B
    tether_height: f64  # [m] of its knot above the centre of mass
    tether_anchor: Annotated[F64s, 3]  # [m] in W
    tether_length: f64
    tether_stiffness: f64  # [N/m]
    tether_damping: f64  # [N s/m]
    net_height: f64  # [m] z of the net in W
    net_stiffness: f64  # [N/m] under one foot
    net_damping: f64  # [N s/m]
    friction: f64
    foot_spread: f64  # [m] |x| = |y| of a foot in B
    foot_below: f64  # [m] below the centre of mass
    foot_reach: f64  # [m] from the centre of mass
    limit_radius: f64
    limit_below: f64
    limit_above: f64
    limit_cos_tilt: f64


class Air(Struct):
    """The tunnel's flow and gusts; what it computes holds for the body in it."""

    gusts: Annotated[F64s, GUSTS]  # [m/s] fast u v w, slow u v w, four flaps fast, four flaps slow
    noise_row: i32  # next row of the block of normal draws
    # Computed from the body's state
    flow_W: Annotated[F64s, 3]  # [m/s] of the air at the centre of mass
    upflow: f64  # [m/s] its mean part, without gusts and side wind
    wind_B: Annotated[F64s, 3]  # [m/s] relative to the body there
    roughness: f64  # factor on the gusts at this place
    # Inputs from outside
    fan: f64  # factor on everything the fans blow
    gust_scale: f64
    side_wind_W: Annotated[F64s, 3]  # [m/s]
    occlusion_W: Annotated[F64s, 2]  # [m] x, y
    occlusion_radius: f64
    occlusion_depth: f64  # 0..1
    # Constants
    speed: f64  # [m/s] mean at the hover point
    profile_radius: f64  # [m]
    height_slope: f64  # [1/m] loss of speed with height
    hover_height: f64  # [m] z of the hover point in W
    gust_radius: f64  # [m]
    gust_growth_max: f64
    gust_decay: Annotated[F64s, GUSTS]  # per step
    gust_kick: Annotated[F64s, GUSTS]  # [m/s] per step and unit normal draw


class Flaps(Struct):
    """Floaty's servos, its nine plates and their identified correction (see hil/world/floaty/correction.py)."""

    angle: Annotated[F64s, 4]  # [rad] signed flap angles
    travel: f64  # [rad] all flaps together have turned since the start
    command: Annotated[F64s, 4]  # [rad] current commanded angles
    next_us: f64  # instant at which `next` takes effect, inf: never
    next: Annotated[F64s, 4]
    after_us: f64  # instant at which `after` takes effect, inf: never
    after: Annotated[F64s, 4]
    trim: Annotated[F64s, 4]  # [rad] error added to the command
    pace: Annotated[F64s, 4]  # 1 healthy, 0 stuck
    lag: f64  # [s]
    rate_limit: f64  # [rad/s]
    dead_band: f64  # [rad]
    # Computed from the state
    wind_B: Annotated[F64s, 3]  # [m/s] at a flap
    struck: Annotated[F64s, 2, 6]  # force [N] and torque [N m] of a flap's two plates, in B
    hover_wrench_B: Annotated[F64s, 6]  # of all plates with the flaps at the hover angle
    forces: Annotated[F64s, 5, 3]  # [N] base and four flaps as isolated plates, in W
    # Plates
    drag_factor: f64
    hover: Annotated[F64s, 4]  # [rad] signed angles
    hover_turn: Annotated[F64s, 2]  # cos phi and sin phi of all of them
    flow_points: Annotated[F64s, 4, 3]  # [m] where each flap's flow is taken, in B
    pressure: f64  # [kg/m3] rho C_D / 2
    base_area: f64  # [m2]
    area: Annotated[F64s, 8]  # [m2]
    normal: Annotated[F64s, 8, 9]  # n(phi) = n0 + n1 cos phi + n2 sin phi: nine numbers per plate, in B
    centre: Annotated[F64s, 8, 9]  # [m] centre of pressure r(phi), likewise, from the centre of mass
    # Correction, forces [N] and torques [N m]
    corrected: i32  # 0: isolated plates only
    airspeed: f64  # [m/s] of the design
    lift_fit: Annotated[F64s, 7]
    # By axis, x y z roll pitch yaw
    by_input: Annotated[F64s, 6]  # factor on the input's part; of z and pitch: per u4 and u2
    by_tilt: Annotated[F64s, 6]  # per slope of the wind
    by_rate: Annotated[F64s, 6]


class FloatyBlocks(NamedTuple):
    """The memory of one Floaty in the tunnel."""

    body: Block[Rigid]
    air: Block[Air]
    flaps: Block[Flaps]

    def copy(self) -> "FloatyBlocks":
        """Return an independent copy."""
        return FloatyBlocks(self.body.copy(), self.air.copy(), self.flaps.copy())
