"""The sensors that a user's own robot declares: samples of the truth, with noise, delay and dropout."""

from collections.abc import Callable, Mapping

import numpy as np

from firmware_py.core.subset import F32s, f32
from firmware_py.logic.loading import Logic, sensed_by
from hil.board.config import SensorConfig
from hil.emulator.events import EventQueue
from hil.errors import LabError, hint
from hil.world.body import Channel, OwnSensor, Quantity
from hil.world.fixed_order import normal

PERIOD_US = 10_000
IDEAL = SensorConfig()


class OwnSensors:
    """Samples every sensor at 100 Hz.

    `samples` has what has arrived on the board, NaN without a sample. The numbers of `configs`, by name, may change in
    flight. Raises `LabError` for a name there that the robot does not have.
    """

    def __init__(
        self, sensors: Mapping[str, OwnSensor], configs: Mapping[str, SensorConfig], rng: np.random.Generator
    ) -> None:
        for name in configs:
            if name not in sensors:
                raise LabError(f"sensors.{name}: {_there(name, sensors)}")
        self._sensors, self._rng = sensors, rng
        self.configs = {name: configs.get(name, IDEAL) for name in sensors}
        self.samples: dict[str, F32s] = {
            name: np.full(len(one.names), np.nan, f32) for name, one in sensors.items()
        }

    def check(self, logic: Logic | None) -> None:
        """Raise `LabError` for what own logic reads and the robot does not measure in that shape and unit."""
        for field in sensed_by(logic):
            sensor = self._sensors.get(field.name)
            if sensor is None:
                raise LabError(f"{field.place}: sensed.{field.name}: {_there(field.name, self._sensors)}")
            asked = field.shape[0] if field.shape else 1
            if (asked, field.unit) != (len(sensor.names), sensor.unit):
                raise LabError(
                    f"{field.place}: sensed.{field.name}: {asked} in {field.unit or 'no unit'}; the robot measures "
                    f"{len(sensor.names)} in {sensor.unit or 'no unit'}"
                )

    def sample(self, now_us: int, events: EventQueue) -> None:
        """Measure all; the samples arrive after the delay of each."""
        for name, sensor in self._sensors.items():
            config, truth = self.configs[name], np.array(sensor.read())
            noise, lost = normal(self._rng, truth.shape), self._rng.random() < config.dropout
            value = np.full(truth.size, np.nan) if lost else truth + config.noise * noise
            events.at(now_us + config.delay_us, self._arrival(name, value.astype(f32)))

    def _arrival(self, name: str, value: F32s) -> Callable[[int], None]:
        def arrive(now_us: int) -> None:
            self.samples[name][:] = value

        return arrive

    def channels(self) -> tuple[Channel, ...]:
        """Return the log channels of what has arrived: columns `sensor.NAME`."""
        return tuple(
            Channel(
                "float32",
                lambda sample=self.samples[name]: sample,  # type: ignore[misc]
                (Quantity(tuple(f"sensor.{one}" for one in sensor.names), sensor.unit),),
            )
            for name, sensor in self._sensors.items()
        )


def _there(name: str, sensors: Mapping[str, OwnSensor]) -> str:
    if not sensors:
        return "the robot has no sensors of its own; its file declares them in `sensed`"
    return f"the robot has no such sensor; {hint(name, sensors)}"
