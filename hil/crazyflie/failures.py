"""The failures of a Crazyflie's own parts: four motors, each with its propeller."""

from hil.world.body import Failure, of_each_actuator

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
