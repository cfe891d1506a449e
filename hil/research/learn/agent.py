"""One robot of the fast model, compiled: a control step of 10 ms from its action to its observation and reward.

Plant, servo lag, tunnel and gusts are the laboratory's (`hil.world`), in one midpoint step per 10 ms instead of ten. The
board is reduced to its observation, allocation and servo mapping, the core's own functions. Estimator, predictor, cameras
and radio are reduced to a delay of the pose and errors of the estimate, as large as in the laboratory's hover.
"""

import math
from pathlib import Path
from typing import Annotated

from firmware_py.compiling import compiler
from firmware_py.core.guard import allocate
from firmware_py.core.observation import ACTIONS, act, observe
from firmware_py.core.servo import drive_servos
from firmware_py.core.structs import ATTITUDE, FLAP, POSITION, RATE, VELOCITY, Control, Estimator, Parameters
from firmware_py.core.subset import F32s, F64s, Integer, Struct, f32, f64, i32
from hil.research.learn import tasks
from hil.research.learn.tasks import PUSH_S, PUSHES
from hil.world.fixed_order import SOURCES, atan2, sine_ahead
from hil.world.motion import evaluate, step
from hil.world.servos import MIDDLE_COUNTS, PERIOD_COUNTS, RAD_PER_COUNT, TIMER_MHZ
from hil.world.structs import GUSTS, STEP_US, Air, Flaps, Rigid

DELAY_MAX = 12  # control steps
SIGHTS = DELAY_MAX + 1
SEEN = 9  # position, velocity in W, and Euler angles, from the cameras
ERRORS = SEEN + 3  # plus the rates, from the gyro
DRAWS = GUSTS + ERRORS

compiled = compiler(Path(__file__).parent, *SOURCES)
reward_of = compiled(tasks.reward_of)


class Agent(Struct):
    """What a robot has beside body, air and flaps."""

    begins: i32  # 1: the next call begins an episode
    action: Annotated[F32s, 4]  # limited by the step
    previous: Annotated[F32s, 4]  # the action of the step before, as limited
    observation: Annotated[F32s, 20]
    reward: f64
    path: Annotated[F64s, 2, 4]  # amplitudes and frequencies of the goal: [m] in W and yaw, [Hz]
    pushes: Annotated[F64s, 3, PUSHES]  # instants [s], kinds, sizes
    sights: Annotated[F64s, SIGHTS, SEEN]  # the cameras' measurements
    errors: Annotated[F64s, ERRORS]  # of the estimate
    zero_offset: Annotated[F64s, 4]  # [rad] of the servos
    goal: Annotated[F64s, 4]  # [m] in W, yaw
    rates: Annotated[F64s, 3]  # [rad/s] the gyro's mean over the step


class Sensing(Struct):
    """The sensors that all robots of a fleet share."""

    newest: i32  # row of the last measurement in `sights`
    oldest: i32  # row of the one that the board has now
    lasting: f64  # share of an error that lasts to the next step, and of the new draw
    fresh: f64
    sizes: Annotated[F64s, ERRORS]  # of the errors, rms
    home: Annotated[F64s, 4]  # of the goal's path: [m] in W, yaw


@compiled
def wrapped(angle: float) -> float:
    """Return the same direction in -pi..pi."""
    return angle - 2.0 * math.pi * math.floor(angle / (2.0 * math.pi) + 0.5)


@compiled
def command(body: Rigid, flaps: Flaps, agent: Agent, control: Control) -> None:
    """Latch the timer counts at the next PWM period, at least 1 ms from now for the board's computation."""
    ready_us = body.time_us + STEP_US
    period = math.floor(ready_us * TIMER_MHZ / PERIOD_COUNTS) + 1.0
    flaps.next_us = f64(-math.floor(-period * PERIOD_COUNTS / TIMER_MHZ))
    for i in range(4):
        flaps.next[i] = (control.count[i] - MIDDLE_COUNTS) * RAD_PER_COUNT - agent.zero_offset[i]


@compiled
def disturb(body: Rigid, agent: Agent) -> None:
    """Apply the pushes of this step."""
    t = (body.time_us + 1.0) * 1e-6  # 1 us later: rounding moves no push to the next step
    pushes = agent.pushes
    for i in range(6):
        body.push[i] = 0.0
    for i in range(PUSHES):
        if pushes[0, i] <= t and t < pushes[0, i] + PUSH_S:
            body.push[int(pushes[1, i])] = pushes[2, i]


@compiled
def look(body: Rigid, agent: Agent, row: Integer) -> None:
    """Write a measurement of the cameras: position, velocity in W, and roll, pitch, yaw."""
    R, sights = body.R_WB, agent.sights
    for i in range(3):
        sights[row, i] = body.p_WB[i]
        sights[row, 3 + i] = body.v_WB[i]
    sights[row, 6] = atan2(R[2, 1], R[2, 2])
    sights[row, 7] = atan2(-R[2, 0], math.sqrt(R[0, 0] * R[0, 0] + R[1, 0] * R[1, 0]))
    sights[row, 8] = atan2(R[1, 0], R[0, 0])


@compiled
def see(
    body: Rigid, flaps: Flaps, agent: Agent, sensing: Sensing, parameters: Parameters, estimator: Estimator
) -> None:
    """Write the goal, and the observation of the board's estimate: in the goal's frame, with errors."""
    sights, errors, goal, row, now = agent.sights, agent.errors, agent.goal, sensing.oldest, estimator.now
    for i in range(4):
        goal[i] = sensing.home[i]
        if agent.path[0, i] != 0.0:
            phase = 2.0 * math.pi * agent.path[1, i] * (body.time_us * 1e-6)
            goal[i] = goal[i] + agent.path[0, i] * sine_ahead(phase, 0)
    c, s = sine_ahead(goal[3], 1), sine_ahead(goal[3], 0)
    x, y = sights[row, 0] + errors[0] - goal[0], sights[row, 1] + errors[1] - goal[1]
    vx, vy = sights[row, 3] + errors[3], sights[row, 4] + errors[4]
    now[POSITION], now[POSITION + 1] = f32(c * x + s * y), f32(c * y - s * x)
    now[POSITION + 2] = f32(sights[row, 2] + errors[2] - goal[2])
    now[VELOCITY], now[VELOCITY + 1] = f32(c * vx + s * vy), f32(c * vy - s * vx)
    now[VELOCITY + 2] = f32(sights[row, 5] + errors[5])
    for i in range(3):
        now[ATTITUDE + i] = f32(sights[row, 6 + i] + errors[6 + i])
        now[RATE + i] = f32(agent.rates[i] + errors[SEEN + i])
    now[ATTITUDE + 2] = f32(f64(now[ATTITUDE + 2]) - goal[3])  # `observe` wraps it
    for i in range(4):
        now[FLAP + i] = f32(flaps.angle[i] - flaps.hover[i])
    observe(parameters, estimator, agent.previous, agent.observation)


@compiled
def advance(
    body: Rigid, air: Air, flaps: Flaps, agent: Agent, draws: F64s,
    parameters: Parameters, estimator: Estimator, control: Control, sensing: Sensing,
) -> None:  # fmt: skip
    """Begin an episode, or advance by one control step with a row of unit normal `draws`; write the observation."""
    if agent.begins != 0:
        agent.begins = i32(0)
        evaluate(body, air, flaps)
        for row in range(SIGHTS):
            look(body, agent, row)
        see(body, flaps, agent, sensing, parameters, estimator)
        return
    act(parameters, agent.action, control)
    allocate(parameters, control)
    drive_servos(parameters, control)
    change = 0.0
    for i in range(ACTIONS):
        difference = agent.action[i] - agent.previous[i]
        change = change + f64(difference * difference)
        agent.previous[i] = agent.action[i]
    command(body, flaps, agent, control)
    disturb(body, agent)
    for i in range(3):
        agent.rates[i] = 0.5 * body.omega_B[i]
    air.noise_row = i32(0)
    step(body, air, flaps, draws)
    for i in range(3):
        agent.rates[i] = agent.rates[i] + 0.5 * body.omega_B[i]
    look(body, agent, sensing.newest)
    errors, sizes = agent.errors, sensing.sizes
    for i in range(SEEN):
        errors[i] = sensing.lasting * errors[i] + sensing.fresh * sizes[i] * draws[0, GUSTS + i]
    for i in range(SEEN, ERRORS):
        errors[i] = sizes[i] * draws[0, GUSTS + i]
    see(body, flaps, agent, sensing, parameters, estimator)
    dx, dy, dz = body.p_WB[0] - agent.goal[0], body.p_WB[1] - agent.goal[1], body.p_WB[2] - agent.goal[2]
    distance = math.sqrt(dx * dx + dy * dy + dz * dz)
    x, y, z = body.R_WB[2, 0], body.R_WB[2, 1], body.R_WB[2, 2]
    tilt = atan2(math.sqrt(x * x + y * y), z)
    yaw_error = wrapped(agent.sights[sensing.newest, 8] - agent.goal[3])
    agent.reward = reward_of(distance, tilt, yaw_error, change)
