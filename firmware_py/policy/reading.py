"""Reads a policy from an ONNX file, with the answers of onnx's own evaluator, or from a safetensors file.

Of an ONNX graph the chain of nodes from its input to its first output is the policy; other outputs are left out. A
safetensors file has the tensors of a `torch.nn.Sequential`, "0.weight" (outputs, inputs) and "0.bias" and so on, perhaps
behind a common prefix, "observation.mean" and "observation.std" (20,), and the metadata "activation", "output" (none) and
"limit" (of the normalised observation); or those of a stable-baselines3 policy, PPO's or SAC's `state_dict`.
"""

import re
from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from firmware_py.core.observation import OBSERVATIONS
from firmware_py.policy.network import NONE, RELU, TANH, Layer, Policy, PolicyError

Answer: TypeAlias = Callable[[NDArray[np.float32]], NDArray[Any]]  # observations (n, 20) to actions (n, 4)
LIBRARIES: Mapping[str, str] = {".onnx": "onnx", ".safetensors": "safetensors"}  # by suffix
NODES = (
    "Gemm, MatMul, Add, Tanh and Relu, before them Sub, Div, Mul, Add and Clip, and Clip to -1..1 at the end"
)
OBSERVED = ("observation.mean", "observation.std")
# Of stable-baselines3: the prefix of the hidden layers, the last layer, the usual activation, that of the output.
KNOWN = (
    ("mlp_extractor.policy_net.", "action_net", TANH, NONE),
    ("actor.latent_pi.", "actor.mu", RELU, TANH),
)


def read_policy(path: Path) -> tuple[Policy, Answer]:
    """Return a policy, and what its framework answers to observations. Raises `PolicyError`."""
    if path.suffix not in LIBRARIES:
        raise PolicyError(f"{path.suffix or 'no suffix'}: expected a file {' or '.join(LIBRARIES)}")
    try:
        with np.errstate(all="ignore"):  # what is not finite is refused
            if path.suffix == ".onnx":
                return _read_onnx(path)
            policy = _read_safetensors(path)
    except OSError as error:
        raise PolicyError(error.strerror or str(error)) from None
    return policy, policy.answer


def _read_onnx(path: Path) -> tuple[Policy, Answer]:
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
    chain = _Chain()
    for node in _nodes_to(graph.output[0].name, graph, constants):
        given = [constants.get(name) for name in node.input]
        attributes = {one.name: onnx.helper.get_attribute_value(one) for one in node.attribute}
        chain.add(node.op_type, f"{node.op_type} {node.name}".strip(), given, attributes)
    kind = graph.input[0].type.tensor_type
    number = onnx.helper.tensor_dtype_to_np_dtype(kind.elem_type)

    def answer(observations: NDArray[np.float32]) -> NDArray[Any]:
        rows = observations if len(kind.shape.dim) == 1 else observations[:, None, :]
        inputs: list[dict[str, Any]] = [{graph.input[0].name: row.astype(number)} for row in rows]
        return np.stack([np.ravel(evaluator.run(None, given)[0]) for given in inputs])

    return chain.policy(), answer


def _nodes_to(output: str, graph: Any, constants: Mapping[str, Any]) -> list[Any]:
    """Return the nodes that lead from the graph's input to an output, in their order."""
    makers = {name: node for node in graph.node for name in node.output}
    nodes: list[Any] = []
    while output in makers:
        nodes.insert(0, makers[output])
        before = [name for name in nodes[0].input if name and name not in constants]
        if len(before) != 1:
            raise PolicyError(
                f"{nodes[0].op_type} {nodes[0].name}: {len(before)} inputs that are not constant: expected 1"
            )
        output = before[0]
    return nodes


class _Chain:
    """Collects the layers of an ONNX graph, node by node."""

    def __init__(self) -> None:
        self._scale, self._offset = np.ones(OBSERVATIONS), np.zeros(OBSERVATIONS)
        self._limit = np.inf
        self._layers: list[Layer] = []
        self._closed = False  # an action has been limited: nothing follows

    def policy(self) -> Policy:
        """Return what the nodes make."""
        scale, offset = self._scale.astype(np.float32), self._offset.astype(np.float32)
        return Policy(scale, offset, self._limit, tuple(self._layers))

    def add(
        self, kind: str, name: str, given: list[NDArray[Any] | None], attributes: Mapping[str, Any]
    ) -> None:
        """Add a node; `given` are its inputs that are constant."""
        if kind in ("Identity", "Flatten"):
            return
        if not self._closed:
            if kind == "Clip" and self._clip(given, attributes):
                return
            if kind in ("Gemm", "MatMul") and self._product(name, given, attributes):
                return
            if self._layers and kind in ("Tanh", "Relu") and self._layers[-1].activation == NONE:
                self._layers[-1] = replace(self._layers[-1], activation=kind.lower())
                return
            if kind in ("Sub", "Div", "Mul", "Add") and self._shift_or_scale(kind, given):
                return
        raise PolicyError(f"{name}: a policy consists of {NODES}")

    def _clip(self, given: list[NDArray[Any] | None], attributes: Mapping[str, Any]) -> bool:
        low, high = [*given[1:], attributes.get("min"), attributes.get("max")][:2]
        if low is None or high is None or float(low) != -float(high) or self._limit < np.inf:
            return False
        if not self._layers:
            self._limit = float(high)
        self._closed = bool(self._layers)
        return not self._layers or float(high) == 1.0

    def _product(self, name: str, given: list[NDArray[Any] | None], attributes: Mapping[str, Any]) -> bool:
        weights = given[1]
        plain = attributes.get("alpha", 1.0) == attributes.get("beta", 1.0) == 1.0
        if weights is None or not plain or attributes.get("transA") or given[0] is not None:
            return False
        weights = weights if attributes.get("transB") else weights.T
        biases = given[2] if len(given) > 2 else None
        biases = np.zeros(weights.shape[:1]) if biases is None else np.ravel(biases)
        self._layers.append(Layer(name, weights.astype(np.float32), biases.astype(np.float32)))
        return True

    def _shift_or_scale(self, kind: str, given: list[NDArray[Any] | None]) -> bool:
        """Take a sum or product with a constant: into the normalisation, or into the bias of a layer."""
        numbers = [np.ravel(one).astype(float) for one in given if one is not None]
        if len(numbers) != 1 or (kind in ("Sub", "Div") and given[0] is not None):
            return False
        if self._layers:
            layer = self._layers[-1]
            if (
                kind != "Add"
                or layer.activation != NONE
                or numbers[0].shape not in (layer.biases.shape, (1,))
            ):
                return False
            self._layers[-1] = replace(layer, biases=(layer.biases + numbers[0]).astype(np.float32))
            return True
        if self._limit < np.inf or len(numbers[0]) not in (1, OBSERVATIONS):
            return False
        factor = numbers[0] if kind == "Mul" else 1.0 / numbers[0] if kind == "Div" else 1.0
        self._scale = self._scale * factor
        self._offset = self._offset * factor
        if kind in ("Add", "Sub"):
            self._offset = self._offset + (numbers[0] if kind == "Add" else -numbers[0])
        return True


def _read_safetensors(path: Path) -> Policy:
    from safetensors import SafetensorError, safe_open

    try:
        with safe_open(path, framework="numpy") as file:
            metadata: dict[str, str] = file.metadata() or {}
            tensors = {name: np.asarray(file.get_tensor(name), np.float32) for name in file.keys()}  # noqa: SIM118
    except (SafetensorError, TypeError, ValueError) as error:
        raise PolicyError(f"not a valid safetensors file: {error}") from None
    mean = tensors.get(OBSERVED[0], np.zeros(OBSERVATIONS, np.float32)).astype(float)
    std = tensors.get(OBSERVED[1], np.ones(OBSERVATIONS, np.float32)).astype(float)
    if mean.shape != std.shape or not (std > 0).all():
        raise PolicyError(
            f"{' and '.join(OBSERVED)}: expected {OBSERVATIONS} numbers each, the second positive"
        )
    names, activation, output = _layers_of(tensors, metadata)
    layers = []
    for name in names:
        if f"{name}.bias" not in tensors:
            raise PolicyError(f"{name}.weight has no {name}.bias")
        kind = output if name == names[-1] else activation
        layers.append(Layer(name, tensors[f"{name}.weight"], tensors[f"{name}.bias"], kind))
    try:
        limit = float(metadata.get("limit", "inf"))
    except ValueError:
        raise PolicyError(f"metadata limit = {metadata['limit']}: expected a number") from None
    scale, offset = (1.0 / std).astype(np.float32), (-mean / std).astype(np.float32)
    return Policy(scale, offset, limit, tuple(layers))


def _layers_of(
    tensors: Mapping[str, NDArray[np.float32]], metadata: Mapping[str, str]
) -> tuple[list[str], str, str]:
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
    return _in_order(others), metadata["activation"], metadata.get("output", NONE)


def _in_order(names: list[str]) -> list[str]:
    """Return the layers among tensors, by their number."""
    layers = {name.rpartition(".")[0] for name in names if name.endswith(".weight")}
    return sorted(layers, key=lambda name: int(name.rpartition(".")[2]))
