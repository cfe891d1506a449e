"""The control law of an environment: flies the action that the environment has set, a number -1..1 per input.

It is written like user logic: the estimate, the guard, the allocation and the servo mapping around it are the board's.
"""

from typing import Annotated

from firmware_py.core.guard import allocate
from firmware_py.core.observation import ACTIONS, act, observe
from firmware_py.core.structs import Control, Estimator, Parameters
from firmware_py.core.subset import F32s, Struct, Tunable, f32, kernel


class Action(Struct):
    """The action, held until the next one."""

    u1: Annotated[f32, Tunable(0.0, "", low=-1.0, high=1.0)]
    u2: Annotated[f32, Tunable(0.0, "", low=-1.0, high=1.0)]
    u3: Annotated[f32, Tunable(0.0, "", low=-1.0, high=1.0)]
    u4: Annotated[f32, Tunable(0.0, "", low=-1.0, high=1.0)]


class Memory(Struct):
    """The previous action, and the law's observation before it."""

    action: Annotated[F32s, 4]
    previous: Annotated[F32s, 4]
    seen: Annotated[F32s, 20]


@kernel
def reset_law(memory: Memory) -> None:
    """Forget the previous action."""
    for i in range(ACTIONS):
        memory.action[i] = f32(0.0)
        memory.previous[i] = f32(0.0)


@kernel
def control_law(
    parameters: Parameters, estimator: Estimator, control: Control, own: Action, memory: Memory
) -> None:
    """Write the inputs and the flap angles, 100 times a second."""
    for i in range(ACTIONS):
        memory.previous[i] = memory.action[i]
    observe(parameters, estimator, memory.previous, memory.seen)
    memory.action[0] = own.u1
    memory.action[1] = own.u2
    memory.action[2] = own.u3
    memory.action[3] = own.u4
    act(parameters, memory.action, control)
    allocate(parameters, control)
