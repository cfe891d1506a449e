"""The layout of the plant's single flat float64 array.

One array holds the whole plant: state, values computed from it, inputs that may change during a flight, and constants. A
compiled kernel call then has one argument, and truth is read through numpy views. Units are SI; frames are in the names
or comments: W world (z up), B body (x forward, y left, z up, at the centre of mass). Flaps count 0..3 here, at the
quadrants (+,-), (+,+), (-,+), (-,-) of B; plate 2i is the flat part of flap i, 2i+1 its kink.
"""

_size = 0


def _take(count: int = 1) -> int:
    """Reserve the next `count` places and return the first."""
    global _size
    start = _size
    _size += count
    return start


def _each(count: int) -> range:
    """Reserve `count` places and return them all."""
    return range(_take(count), _size)


# State, on the millisecond grid
TIME_US = _take()
P = _take(3)  # [m] p_WB
V = _take(3)  # [m/s] v_WB
Q = _take(4)  # q_WB, w x y z
OMEGA = _take(3)  # [rad/s] of B against W, in B
FLAPS = _take(4)  # [rad] signed flap angles
GUSTS = _take(14)  # [m/s] fast u v w, slow u v w, four flaps fast, four flaps slow
TRAVEL = _take()  # [rad] all flaps together have turned since the start
NOISE_ROW = _take()  # next row of the block of normal draws
BEFORE = _take(13)  # P to OMEGA at the start of the step
DURATION = _take()  # [s] of the part of the step since then

# Computed from the state by `drag`
R = _take(9)  # R_WB, row by row
FLOW = _take(3)  # [m/s] of the air at the centre of mass, in W
UPFLOW = _take()  # [m/s] its mean part, without gusts and side wind
WIND = _take(3)  # [m/s] relative to the body there, in B
ROUGHNESS = _take()  # factor on the gusts at this place
DRAG = _take(6)  # force [N] and torque about the centre of mass [N m] of the flow, in B
HOVER_DRAG = _take(6)  # the same with the flaps at the hover angle; before any correction
PLATE_FORCES = _take(15)  # [N] base and four flaps as isolated plates, in W

# Computed from all that by `evaluate`
ACC = _take(3)  # [m/s2] of the centre of mass, in W, gravity included
ALPHA = _take(3)  # [rad/s2] in B
SPECIFIC_FORCE = _take(3)  # [m/s2] as measured by an accelerometer at the centre of mass, in B
VIBRATION = _take(2)  # [rad/s], [m/s2] rms of rate and specific force by rotating parts, per axis
PULL = _take(3)  # [N] of the tether, in W
GROUND = _take(6)  # force [N] of the net, in W, and its torque [N m], in B

# Servos
COMMAND = _take(4)  # [rad] current commanded angles
NEXT_US = _take()  # instant at which NEXT takes effect, inf: never
NEXT = _take(4)
AFTER_US = _take()  # instant at which AFTER takes effect, inf: never
AFTER = _take(4)
SERVO_TRIM = _take(4)  # [rad] error added to the command
SERVO_SPEED = _take(4)  # 1 healthy, 0 stuck
SERVO_TAU, SERVO_RATE, DEAD_BAND = _each(3)

# Inputs from outside
HELD = _take()  # 1: the body is clamped where it is
PUSH = _take(3)  # [N] in W
PUSH_TORQUE = _take(3)  # [N m] in B
LOST = _take()  # cause, 0: flying
LOST_VALUE = _take()  # value beyond its limit: [m] or [rad]

# Tunnel
SPEED = _take()  # [m/s] mean at the hover point
PROFILE_RADIUS = _take()  # [m]
HEIGHT_SLOPE = _take()  # [1/m] loss of speed with height
HOVER_HEIGHT = _take()  # [m] z of the hover point in W
FAN = _take()  # factor on everything the fans blow
SIDE_WIND = _take(3)  # [m/s] in W
OCCLUSION = _take(4)  # x, y [m] in W, radius [m], depth 0..1
GUST_SCALE = _take()
GUST_RADIUS = _take()  # [m]
GUST_GROWTH_MAX = _take()
GUST_DECAY = _take(14)  # per step
GUST_KICK = _take(14)  # [m/s] per step and unit normal draw

# Body
MASS = _take()
INERTIA = _take(3)
DRAG_FACTOR = _take()
HOVER_FLAPS = _take(4)  # [rad] signed
HOVER_TURN = _take(2)  # cos phi and sin phi of all of them
AXIS_HEIGHT = _take()  # [m] flap axes above the centre of mass
FLOW_POINTS = _take(8)  # [m] x, y of the point where each flap's flow is taken, in B
PRESSURE = _take()  # [kg/m3] rho C_D / 2
BASE_AREA = _take()  # [m2]
AREA = _take(8)  # [m2]
NORMAL = _take(72)  # n(phi) = n0 + n1 cos phi + n2 sin phi: nine numbers per plate, in B
CENTRE = _take(72)  # [m] centre of pressure r(phi), likewise, from the centre of mass

# Identified correction (see correction.py); forces [N], torques [N m]
CORRECTED = _take()  # 0: isolated plates only
AIRSPEED = _take()  # [m/s] of the design
LIFT_FIT = _take(7)
X_INPUT, X_TILT, Y_INPUT, Y_TILT, Z_INPUT = _each(5)
ROLL_INPUT, ROLL_TILT, ROLL_RATE, PITCH_INPUT, PITCH_TILT, PITCH_RATE, YAW_INPUT, YAW_RATE = _each(8)

# Tether, net and limits
TETHER_ANCHOR = _take(3)  # [m] in W
TETHER_LENGTH, TETHER_STIFFNESS, TETHER_DAMPING = _each(3)
NET_HEIGHT = _take()  # [m] z of the net in W
NET_STIFFNESS = _take()  # [N/m] under one foot
NET_DAMPING = _take()  # [N s/m]
FRICTION = _take()
FOOT_SPREAD = _take()  # [m] |x| = |y| of a foot in B
FOOT_BELOW = _take()  # [m] below the centre of mass
FOOT_REACH = _take()  # [m] from the centre of mass
LIMIT_RADIUS, LIMIT_BELOW, LIMIT_ABOVE, LIMIT_COS_TILT = _each(4)

SIZE = _size

LEFT_SIDEWAYS, ROSE, FELL, TETHER_TAUT, TUMBLED = 1, 2, 3, 4, 5  # causes in LOST
STEP_US = 1000
