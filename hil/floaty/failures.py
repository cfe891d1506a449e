"""The failures of Floaty's own parts: four servos, each with its flap."""

import math

from hil.world.body import Failure

DEG = math.radians(1.0)
NUMBERS = (1, 2, 3, 4)
SERVO_FAILURES: dict[str, Failure] = {
    **{
        f"servo.stuck.{number}": Failure(
            f"flap {number} is stuck", "", 0.0, 0.0, 0.0, f"servo.pace.{number}", "times", "degrades"
        )
        for number in NUMBERS
    },
    **{
        f"servo.slow.{number}": Failure(
            f"factor on the pace of servo {number}", "", 0.5, 0.01, 4.0, f"servo.pace.{number}", "times", "holds"
        )
        for number in NUMBERS
    },
    **{
        f"servo.trim.{number}": Failure(
            f"flap {number} deviates this far from its command", "deg", 5.0, -45.0, 45.0, f"servo.trim.{number}", "add",
            "holds", DEG,
        )
        for number in NUMBERS
    },
}  # fmt: skip
