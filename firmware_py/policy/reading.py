"""Reads a trained policy, a multilayer perceptron, from an ONNX or a safetensors file.

The policy is the nodes of an ONNX graph that lead from its input to its first output; other outputs are ignored. The names
in a safetensors file are those of a `torch.nn.Sequential` or of a stable-baselines3 policy (docs/howto/learned-policy.md).
"""

import re
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from firmware_py.core.observation import ACTIONS, OBSERVATIONS
from firmware_py.errors import FirmwareError

Answer: TypeAlias = Callable[[NDArray[np.float32]], NDArray[Any]]  # observations (n, 20) to actions (n, 4)
LIBRARIES: Mapping[str, str] = {".onnx": "onnx", ".safetensors": "safetensors"}  # by suffix
DENSE, SCALE, LIMIT, TANH, RELU = "dense", "scale", "limit", "tanh", "relu"
NODES = "Gemm, MatMul, Tanh, Relu, Add, Sub, Mul and Div with constants, and Clip to -a..a"
# Of stable-baselines3: the prefix of the hidden layers, the last layer, the usual activation, that of the output.
KNOWN = (
    ("mlp_extractor.policy_net.", "action_net", TANH, "none"),
    ("actor.latent_pi.", "actor.mu", RELU, TANH),
)
OBSERVED = ("observation.mean", "observation.std")


class PolicyError(FirmwareError):
    """A policy cannot become a law; the text names the part, and what is allowed."""


@dataclass(frozen=True, slots=True)
class NetworkStep:
    """A step of a network, on the outputs of the last dense one: WEIGHTS and BIASES, FACTORS and SUMMANDS, or LIMIT."""

    kind: str
    name: str  # in the file
    arrays: Mapping[str, NDArray[Any]] = field(default_factory=dict)
    layer: int = 0  # how many dense steps there are up to this one
    inputs: int = OBSERVATIONS
    outputs: int = OBSERVATIONS


@dataclass(frozen=True, slots=True)
class Policy:
    """The steps from the observation to the action, and the answers of the framework."""

    steps: tuple[NetworkStep, ...]
    answer: Answer

    @property
    def numbers(self) -> int:
        """How many constants the steps have."""
        return sum(array.size for step in self.steps for array in step.arrays.values())

    @property
    def shape(self) -> str:
        """The numbers of inputs and outputs of the layers, as "20-64-64-4"."""
        return "-".join(
            [str(OBSERVATIONS), *(str(step.outputs) for step in self.steps if step.kind == DENSE)]
        )


def read_policy(path: Path) -> Policy:
    """Return the policy of a file. Raises `PolicyError` for layers, shapes and numbers that cannot become a law."""
    if path.suffix not in LIBRARIES:
        raise PolicyError(f"{path.suffix or 'no suffix'}: expected a file {' or '.join(LIBRARIES)}")
    try:
        with np.errstate(all="ignore"):  # values that are not finite are refused
            return _read_onnx(path) if path.suffix == ".onnx" else _read_safetensors(path)
    except OSError as error:
        raise PolicyError(error.strerror or str(error)) from None


def _checked(steps: Iterable[NetworkStep]) -> tuple[NetworkStep, ...]:
    """Return the steps with the numbers of their inputs and outputs, as float32."""
    done, width, layer = [], OBSERVATIONS, 0
    for step in steps:
        arrays = {name: np.atleast_1d(array).astype(np.float32) for name, array in step.arrays.items()}
        outputs = len(arrays["WEIGHTS"]) if step.kind == DENSE else width
        for name, array in arrays.items():
            if step.kind == SCALE and array.size == 1:
                arrays[name] = array = np.full(width, array.ravel()[0])
            wanted = {"WEIGHTS": (outputs, width), "LIMIT": (1,)}.get(name, (outputs,))
            if array.shape != wanted:
                shapes = [" x ".join(map(str, shape)) for shape in (array.shape, wanted)]
                raise PolicyError(f"{name.lower()} of {step.name}: {shapes[0]}; expected {shapes[1]}")
            if not np.isfinite(array).all():
                place = np.argwhere(~np.isfinite(array))[0].tolist()
                text = f"element {place} is {array[tuple(place)]}: expected finite numbers"
                raise PolicyError(f"{name.lower()} of {step.name}: {text}")
        layer += step.kind == DENSE
        done.append(replace(step, arrays=arrays, layer=layer, inputs=width, outputs=outputs))
        width = outputs
    if not layer or width != ACTIONS:
        raise PolicyError(f"{width if layer else 'no'} outputs: an action has {ACTIONS}")
    return tuple(done)


def answer_of(steps: Iterable[NetworkStep], observations: NDArray[np.float32]) -> NDArray[np.float64]:
    """Return the outputs (n, 4) to observations (n, 20), computed in float64."""
    x = observations.astype(float)
    for step in steps:
        first, second, *_ = *(array.astype(float) for array in step.arrays.values()), np.zeros(1), np.zeros(1)
        if step.kind == DENSE:
            x = (first * x[:, None, :]).sum(axis=2) + second
        elif step.kind == SCALE:
            x = first * x + second
        else:
            x = {TANH: np.tanh(x), RELU: np.maximum(x, 0.0), LIMIT: np.clip(x, -first, first)}[step.kind]
    return x


def _read_onnx(path: Path) -> Policy:
    import onnx
    from onnx.numpy_helper import to_array
    from onnx.reference import ReferenceEvaluator

    try:
        model = onnx.load(path)
        onnx.checker.check_model(model)
        evaluator: Any = ReferenceEvaluator(model)
    except OSError:
        raise
    except Exception as error:  # protobuf's and the checker's own
        raise PolicyError(f"not a valid ONNX file: {str(error).splitlines()[0]}") from None
    graph = model.graph
    constants = {tensor.name: to_array(tensor) for tensor in graph.initializer}
    for node in graph.node:
        if node.op_type == "Constant" and node.attribute[0].name == "value":
            constants[node.output[0]] = to_array(node.attribute[0].t)
    given = [one for one in graph.input if one.name not in constants]
    if len(given) != 1 or not graph.output:
        raise PolicyError(
            f"{len(given)} inputs and {len(graph.output)} outputs: expected the observation and the action"
        )
    kind = given[0].type.tensor_type
    number = onnx.helper.tensor_dtype_to_np_dtype(kind.elem_type)

    def answer(observations: NDArray[np.float32]) -> NDArray[Any]:
        rows = observations if len(kind.shape.dim) == 1 else observations[:, None, :]
        inputs: list[dict[str, Any]] = [{given[0].name: row.astype(number)} for row in rows]
        return np.stack([np.ravel(evaluator.run(None, one)[0]) for one in inputs])

    steps = []
    for node in _nodes_to(graph.output[0].name, graph, constants):
        attributes = {one.name: onnx.helper.get_attribute_value(one) for one in node.attribute}
        if node.op_type not in ("Identity", "Flatten"):
            steps.append(_step(node, [constants.get(name) for name in node.input], attributes))
    return Policy(_checked(steps), answer)


def _nodes_to(output: str, graph: Any, constants: Mapping[str, Any]) -> list[Any]:
    """Return the nodes that lead from the graph's input to an output, in their order."""
    makers = {name: node for node in graph.node for name in node.output}
    nodes: list[Any] = []
    while output in makers:
        nodes.insert(0, makers[output])
        before = [name for name in nodes[0].input if name and name not in constants]
        if len(before) != 1:
            name = f"{nodes[0].op_type} {nodes[0].name}"
            raise PolicyError(f"{name}: {len(before)} inputs that are not constant: expected 1")
        output = before[0]
    return nodes


def _step(node: Any, given: list[NDArray[Any] | None], attributes: Mapping[str, Any]) -> NetworkStep:
    """Return the step of a node; `given` are its constant inputs."""
    kind, name = str(node.op_type), f"{node.op_type} {node.name}".strip()
    known = [np.asarray(one, float) for one in given if one is not None]
    forward = given[0] is None  # the first input is the observation's
    if kind in ("Tanh", "Relu"):
        return NetworkStep(kind.lower(), name)
    if kind in ("Add", "Mul") or (kind in ("Sub", "Div") and forward):
        value = np.ravel(known[0])
        factors = value if kind == "Mul" else 1.0 / value if kind == "Div" else np.ones(1)
        summands = value if kind == "Add" else -value if kind == "Sub" else np.zeros(1)
        return NetworkStep(SCALE, name, {"FACTORS": factors, "SUMMANDS": summands})
    if kind == "Clip":
        ends = [*known, *(np.asarray(attributes[key]) for key in ("min", "max") if key in attributes)]
        if len(ends) == 2 and ends[0] == -ends[1] < 0:
            return NetworkStep(LIMIT, name, {"LIMIT": ends[1]})
    scaled = attributes.get("alpha", 1.0) != 1.0 or attributes.get("beta", 1.0) != 1.0
    if kind in ("Gemm", "MatMul") and forward and not scaled and not attributes.get("transA"):
        weights = known[0] if attributes.get("transB") else known[0].T
        biases = np.ravel(known[1]) if len(known) > 1 else np.zeros(weights.shape[:1])
        return NetworkStep(DENSE, name, {"WEIGHTS": weights, "BIASES": biases})
    raise PolicyError(f"{name}: a policy consists of {NODES}")


def _read_safetensors(path: Path) -> Policy:
    from safetensors import SafetensorError, safe_open

    try:
        with safe_open(path, framework="numpy") as file:
            metadata: dict[str, str] = file.metadata() or {}
            tensors = {name: np.asarray(file.get_tensor(name), float) for name in file.keys()}  # noqa: SIM118
    except (SafetensorError, TypeError, ValueError) as error:
        raise PolicyError(f"not a valid safetensors file: {error}") from None
    steps = _checked(_steps_of(tensors, metadata))
    return Policy(steps, lambda observations: answer_of(steps, observations))


def _steps_of(tensors: Mapping[str, NDArray[Any]], metadata: Mapping[str, str]) -> Iterator[NetworkStep]:
    names, activation, output = _layers_of(tensors, metadata)
    for kind in (activation, output):
        if kind not in (TANH, RELU, "none"):
            raise PolicyError(f"activation = {kind}: expected tanh, relu or none")
    if tensors.keys() & set(OBSERVED):
        mean, std = tensors.get(OBSERVED[0], np.array(0)), tensors.get(OBSERVED[1], np.array(1))
        yield NetworkStep(SCALE, "observation.mean", {"FACTORS": np.ones(1), "SUMMANDS": -mean})
        yield NetworkStep(SCALE, "observation.std", {"FACTORS": 1 / std, "SUMMANDS": np.zeros(1)})
    if "limit" in metadata:
        if not re.fullmatch(r"\d+(\.\d*)?", metadata["limit"]):
            raise PolicyError(f"metadata limit = {metadata['limit']}: expected a positive number")
        yield NetworkStep(LIMIT, "metadata limit", {"LIMIT": np.array([float(metadata["limit"])])})
    for name in names:
        if f"{name}.bias" not in tensors:
            raise PolicyError(f"{name}.weight has no {name}.bias")
        yield NetworkStep(
            DENSE, name, {"WEIGHTS": tensors[f"{name}.weight"], "BIASES": tensors[f"{name}.bias"]}
        )
        kind = output if name == names[-1] else activation
        if kind != "none":
            yield NetworkStep(kind, name)


def _layers_of(tensors: Mapping[str, Any], metadata: Mapping[str, str]) -> tuple[list[str], str, str]:
    """Return the names of the layers in their order, the activation between them, and that of the output."""
    for prefix, last, usual, output in KNOWN:
        if f"{last}.weight" in tensors:
            hidden = [name for name in tensors if name.startswith(prefix)]
            return [*_in_order(hidden), last], metadata.get("activation", usual), output
    others = [name for name in tensors if name not in OBSERVED]
    unknown = [name for name in others if not re.fullmatch(r"(.*\.)?\d+\.(weight|bias)", name)]
    if unknown or len({name.rpartition(".")[0].rpartition(".")[0] for name in others}) > 1:
        name = (unknown or others)[-1]
        raise PolicyError(f"tensor {name}: expected 0.weight, 0.bias, 2.weight …, {' and '.join(OBSERVED)}")
    if "activation" not in metadata:
        raise PolicyError("the metadata has no activation: expected tanh or relu")
    return _in_order(others), metadata["activation"], metadata.get("output", "none")


def _in_order(names: list[str]) -> list[str]:
    """Return the layers among tensors, by their number."""
    layers = {name.rpartition(".")[0] for name in names if name.endswith(".weight")}
    return sorted(layers, key=lambda name: int(name.rpartition(".")[2]))
