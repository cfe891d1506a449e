"""Learning: environments for gymnasium on the laboratory and on a fast model of it.

import gymnasium, hil.research.learn
env = gymnasium.make("floaty/Hover-v0", fidelity="firmware")
many = gymnasium.make_vec("floaty/Hover-v0", num_envs=256)
"""

from hil.errors import require

require("hil.research.learn", "learn", "gymnasium")

from gymnasium.envs.registration import register, registry  # noqa: E402

from hil.research.learn.batch import EstimateErrors  # noqa: E402
from hil.research.learn.tasks import TASKS  # noqa: E402

__all__ = ["EstimateErrors"]

for _name in TASKS:
    if (_id := f"floaty/{_name}-v0") not in registry:
        register(
            _id, "hil.research.learn.envs:make_env", vector_entry_point="hil.research.learn.envs:make_vec",
            kwargs={"task": _name},
        )  # fmt: skip
