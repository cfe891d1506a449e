"""A multilayer perceptron that maps the observation of `firmware_py/core/observation.py` to its action."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from firmware_py.core.observation import ACTIONS, OBSERVATIONS
from firmware_py.errors import FirmwareError

TANH, RELU, NONE = "tanh", "relu", "none"
ACTIVATIONS = (TANH, RELU, NONE)


class PolicyError(FirmwareError):
    """A policy cannot become a law; the text says what of it, and what is allowed."""


@dataclass(frozen=True, slots=True)
class Layer:
    """A matrix, a bias and the activation behind them."""

    name: str  # in the file
    weights: NDArray[np.float32]  # (outputs, inputs)
    biases: NDArray[np.float32]  # (outputs,)
    activation: str = NONE


@dataclass(frozen=True, slots=True)
class Policy:
    """A normalisation, `scale * observation + offset` inside +-`limit`, and the layers behind it.

    Raises `PolicyError` for shapes that do not fit and for numbers that are not finite.
    """

    scale: NDArray[np.float32]  # (20,)
    offset: NDArray[np.float32]  # (20,)
    limit: float  # infinite: none
    layers: tuple[Layer, ...]

    def __post_init__(self) -> None:
        width = OBSERVATIONS
        for name, values in (("scale", self.scale), ("offset", self.offset)):
            _check(f"the normalisation's {name}", values, (width,))
        if not self.limit > 0:
            raise PolicyError(f"the normalisation's limit is {self.limit:g}: expected more than 0")
        for layer in self.layers:
            outputs = layer.weights.shape[0] if layer.weights.ndim == 2 else width
            _check(f"weights of {layer.name}", layer.weights, (outputs, width))
            _check(f"biases of {layer.name}", layer.biases, (outputs,))
            if layer.activation not in ACTIVATIONS:
                allowed = ", ".join(ACTIVATIONS)
                raise PolicyError(
                    f"activation of {layer.name} = {layer.activation}: expected one of {allowed}"
                )
            width = outputs
        if not self.layers or width != ACTIONS:
            raise PolicyError(f"{width if self.layers else 'no'} outputs: an action has {ACTIONS}")

    @property
    def numbers(self) -> int:
        """The number of weights and biases."""
        return sum(layer.weights.size + layer.biases.size for layer in self.layers)

    @property
    def shape(self) -> str:
        """The numbers of inputs and outputs of the layers, as "20-64-64-4"."""
        return "-".join(map(str, (OBSERVATIONS, *(len(layer.biases) for layer in self.layers))))

    def answer(self, observations: NDArray[np.float32]) -> NDArray[np.float64]:
        """Return the outputs (n, 4) to observations (n, 20), computed in float64."""
        x: NDArray[np.float64]
        x = np.clip(self.scale * observations.astype(float) + self.offset, -self.limit, self.limit)
        for layer in self.layers:
            x = (layer.weights * x[:, None, :]).sum(axis=2) + layer.biases
            if layer.activation != NONE:
                x = np.tanh(x) if layer.activation == TANH else np.maximum(x, 0.0)
        return x


def _check(what: str, values: NDArray[np.float32], shape: tuple[int, ...]) -> None:
    if values.shape != shape:
        there = " x ".join(map(str, values.shape)) or "a single number"
        raise PolicyError(f"{what}: {there}; expected {' x '.join(map(str, shape))}")
    if not np.isfinite(values).all():
        place = [int(index) for index in np.argwhere(~np.isfinite(values))[0]]
        raise PolicyError(f"{what}: element {place} is {values[tuple(place)]}: expected finite numbers")
