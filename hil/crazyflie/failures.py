"""The failures of a Crazyflie's own parts: four motors, each with its propeller."""

from hil.world.body import Failure

NUMBERS = (1, 2, 3, 4)
MOTOR_FAILURES: dict[str, Failure] = {
    **{
        f"motor.weak.{number}": Failure(
            f"factor on thrust and torque of propeller {number}, as of a chipped one", "", 0.8, 0.0, 1.5,
            f"motor.strength.{number}", "times", "holds",
        )
        for number in NUMBERS
    },
    **{
        f"motor.stop.{number}": Failure(
            f"motor {number} gets no current", "", 0.0, 0.0, 0.0, f"motor.current.{number}", "times", "lost"
        )
        for number in NUMBERS
    },
    **{
        f"motor.stuck.{number}": Failure(
            f"motor {number} stays at its last command", "", 0.0, 0.0, 0.0, f"motor.obeys.{number}", "times", "lost"
        )
        for number in NUMBERS
    },
}  # fmt: skip
