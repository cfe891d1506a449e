"""Many robots of the fast model (`hil.research.learn.agent`) at a time, one control step of 10 ms after another."""

import math
from collections.abc import Sequence
from copy import copy
from dataclasses import dataclass
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from firmware_py.compiling import bound
from firmware_py.config import parameters_of
from firmware_py.core.structs import Control, Estimator
from firmware_py.core.subset import Block, i32
from firmware_py.elementary import exp
from hil.config import LabConfig
from hil.errors import LabError
from hil.laboratory.arguments import checked
from hil.research.learn.agent import DRAWS, ERRORS, SIGHTS, Agent, Sensing, advance
from hil.research.learn.tasks import Episode
from hil.world.fixed_order import normal
from hil.world.floaty.plant import Plant
from hil.world.structs import GUSTS, STEP_US, FloatyBlocks

CONTROL_US = 10_000
Array = NDArray[np.float64]
Actions = NDArray[np.float32]


@checked
@dataclass(frozen=True, slots=True)
class EstimateErrors:
    """Errors of the estimate, rms. Errors of pose and velocity last `tau_s`; those of the rates change in every step.

    Raises `LabError` for values that no estimate can have.
    """

    position: float = 0.0015  # [m]
    velocity: float = 0.025  # [m/s]
    attitude: float = 0.005  # [rad]
    rate: float = 0.025  # [rad/s]
    tau_s: float = 0.05

    def __post_init__(self) -> None:
        sizes = (self.position, self.velocity, self.attitude, self.rate)
        if not (all(0.0 <= size < math.inf for size in sizes) and 0.0 < self.tau_s < math.inf):
            raise LabError(f"{self}: expected sizes of 0 or more, and tau_s above 0")


class Fleet:
    """Robots that fly at the same time, each its own episode.

    `config` is the boards'; `worlds` are the robots that an episode may draw, free and at home. `delay_us` is the pose's
    age that the estimate does not compensate.
    """

    def __init__(
        self, config: LabConfig, worlds: Sequence[Plant], count: int, delay_us: int, errors: EstimateErrors
    ) -> None:
        self._plant = worlds[0].blocks
        kinds = zip(*(world.blocks for world in worlds), strict=True)
        self._templates = [np.concatenate([block.memory for block in kind]) for kind in kinds]
        self._templates[0]["step_us"] = CONTROL_US
        self._gust_rms = _slow_gusts(self._templates[1])
        self._offsets = np.array([world.zero_offset for world in worlds])
        self._kinds = (*(block.kind for block in self._plant), Agent)
        self._memory = [np.zeros(count, kind.dtype) for kind in self._kinds]
        self._draws = np.zeros((count, DRAWS))
        self._sensing, self._parameters = Sensing.allocate(), parameters_of(config)
        sensing, decay = self._sensing.fields, exp(-CONTROL_US * 1e-6 / errors.tau_s)
        sensing.lasting, sensing.fresh = decay, math.sqrt(1.0 - decay * decay)
        sensing.sizes[:] = np.repeat((errors.position, errors.velocity, errors.attitude, errors.rate), 3)
        sensing.home[:3] = config.flight.home
        self._tick, self._delay = 0, round(delay_us / CONTROL_US)
        self._bind()

    def _bind(self) -> None:
        """Bind the step of every robot to the present memory."""
        shared = self._parameters, Estimator.allocate(), Control.allocate(), self._sensing
        self._steps = []
        for n in range(len(self._draws)):
            rows = (Block(kind, one[n : n + 1]) for kind, one in zip(self._kinds, self._memory, strict=True))
            self._steps.append(bound(advance, *rows, self._draws[n : n + 1], *shared))

    def __deepcopy__(self, memo: object) -> Self:
        """Return an independent copy."""
        twin = copy(self)
        twin._memory, twin._draws = [one.copy() for one in self._memory], self._draws.copy()
        twin._sensing = self._sensing.copy()
        twin._bind()
        return twin

    def begin(self, n: int, episode: Episode, rng: np.random.Generator) -> None:
        """Put robot `n` at the start of an episode, at rest in moving air, and observe it."""
        drawn = int(episode.robot * len(self._offsets))
        bodies, airs, _, agents = self._memory
        for memory, templates in zip(self._memory, self._templates, strict=False):
            memory[n] = templates[drawn]
        bodies["p_WB"][n] += episode.start
        airs["gusts"][n] = self._gust_rms[drawn] * normal(rng, GUSTS)
        agents["zero_offset"][n] = self._offsets[drawn]
        agents["path"][n] = episode.amplitude, episode.frequency_hz
        agents["pushes"][n] = episode.push_at, episode.push_kind, episode.push_size
        agents["previous"][n] = agents["rates"][n] = 0.0
        agents["errors"][n] = self._sensing.fields.sizes * normal(rng, ERRORS)
        agents["begins"][n] = 1
        self._steps[n]()

    def advance(self, actions: Actions, rng: np.random.Generator) -> None:
        """Advance all by 10 ms with their actions (N, 4)."""
        self._tick += 1
        sensing = self._sensing.fields
        sensing.newest, sensing.oldest = i32(self._tick % SIGHTS), i32((self._tick - self._delay) % SIGHTS)
        self.agents["action"] = actions
        self._draws[:] = normal(rng, self._draws.shape)
        for step in self._steps:
            step()

    @property
    def agents(self) -> NDArray[Any]:
        """The records `Agent` after the last step, (N,)."""
        return self._memory[-1]

    @property
    def lost(self) -> NDArray[np.bool_]:
        """Which robots have left the flow, fallen or tumbled, (N,)."""
        return np.asarray(self._memory[0]["lost"] != 0)

    def truth(self, n: int) -> FloatyBlocks:
        """Return a copy of a robot's memory."""
        blocks = self._plant.copy()
        for block, memory in zip(blocks, self._memory, strict=False):
            block.memory[:] = memory[n]
        return blocks


def _slow_gusts(airs: NDArray[Any]) -> Array:
    """Make gusts advance by a control step instead of a millisecond; return their rms, (N, 14) [m/s]."""
    decay, kick = airs["gust_decay"], airs["gust_kick"]
    rms = kick / np.sqrt(1.0 - decay**2)
    decay **= CONTROL_US // STEP_US
    kick[:] = rms * np.sqrt(1.0 - decay**2)
    return np.asarray(rms)
