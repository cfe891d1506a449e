"""Policies from files: what is read answers as onnx's own evaluator and onnxruntime do; all else is refused in one line."""

import re
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from firmware_py.core.observation import OBSERVATIONS
from firmware_py.policy.reading import PolicyError, answer_of, read_policy
from support.policies import Layers, write_onnx

onnx = pytest.importorskip("onnx")
safetensors = pytest.importorskip("safetensors.numpy")

RNG = np.random.default_rng(2)
SEEN = RNG.normal(0, 1, (50, OBSERVATIONS)).astype(np.float32)


def random_network(*sizes: int) -> Layers:
    pairs = pairwise(sizes)
    return [
        (RNG.normal(0, a**-0.5, (b, a)).astype(np.float32), RNG.normal(0, 0.1, b).astype(np.float32))
        for a, b in pairs
    ]


BEFORE = [(), ("Sub", "Div"), ("Mul", "Add"), ("Sub", "Div", "Clip"), ("Clip",)]


@pytest.mark.parametrize("before", BEFORE, ids="-".join)
@pytest.mark.parametrize("activation", ["Tanh", "Relu"])
def test_a_network_answers_as_onnx_does(tmp_path: Path, activation: str, before: tuple[str, ...]) -> None:
    layers = random_network(20, 16, 12, 8, 4)
    policy = read_policy(write_onnx(tmp_path / "net.onnx", layers, activation, before))
    assert policy.shape == "20-16-12-8-4"
    assert np.abs(answer_of(policy.steps, SEEN) - policy.answer(SEEN)).max() < 1e-5


def test_the_answer_is_that_of_onnxruntime(tmp_path: Path) -> None:
    runtime = pytest.importorskip("onnxruntime")
    path = write_onnx(tmp_path / "net.onnx", random_network(20, 16, 12, 4), before=("Sub", "Div", "Clip"))
    [expected] = runtime.InferenceSession(path).run(None, {"observation": SEEN})
    policy = read_policy(path)
    assert np.abs(policy.answer(SEEN) - expected).max() < 1e-5
    assert np.abs(answer_of(policy.steps, SEEN) - expected).max() < 1e-5


def with_nodes(path: Path, *nodes: tuple[str, list[float]]) -> Path:
    """Append nodes with constants to the graph of a file."""
    model = onnx.load(path)
    for kind, values in nodes:
        names = [f"{kind}{index}" for index in range(len(values))]
        for name, value in zip(names, values, strict=True):
            array = np.array(value, np.float32)
            model.graph.initializer.append(onnx.numpy_helper.from_array(array, name))
        last = model.graph.output[0].name
        model.graph.node.append(onnx.helper.make_node(kind, [last, *names], [f"{last}{kind}"], name="end"))
        model.graph.output[0].name = f"{last}{kind}"
    onnx.save(model, path)
    return path


def test_an_action_that_the_graph_itself_limits_is_taken(tmp_path: Path) -> None:
    layers = random_network(20, 8, 4)
    path = with_nodes(
        write_onnx(tmp_path / "net.onnx", layers), ("Identity", []), ("Tanh", []), ("Clip", [-1, 1])
    )
    policy = read_policy(path)
    assert [step.kind for step in policy.steps] == ["dense", "tanh", "dense", "scale", "tanh", "limit"]
    assert np.abs(answer_of(policy.steps, SEEN) - policy.answer(SEEN)).max() < 1e-5


@pytest.mark.parametrize(
    "nodes",
    [
        [("Sigmoid", [])],
        [("Tanh", []), ("Softmax", [])],
        [("Clip", [-1.0, 2.0])],
        [("Clip", [-1.0])],
        [("Clip", [1.0, -1.0])],
        [("Clip", [0.0, 0.0])],
        [("Pow", [2.0])],
    ],
    ids=str,
)
def test_a_node_that_no_perceptron_has_is_named(tmp_path: Path, nodes: Any) -> None:
    path = with_nodes(write_onnx(tmp_path / "net.onnx", random_network(20, 8, 4)), *nodes)
    with pytest.raises(PolicyError, match=rf"^{nodes[-1][0]} end: a policy consists of Gemm, MatMul, "):
        read_policy(path)


@pytest.mark.parametrize(
    ("kind", "allowed"), [("Add", True), ("Mul", True), ("Sub", False), ("Div", False), ("MatMul", False)]
)
def test_a_constant_ahead_of_the_observation_is_one_of_a_commutative_node(
    tmp_path: Path, kind: str, allowed: bool
) -> None:
    path = with_nodes(write_onnx(tmp_path / "net.onnx", random_network(20, 8, 4)), (kind, [2.0]))
    model = onnx.load(path)
    value, constant = model.graph.node[-1].input
    model.graph.node[-1].input[:] = [constant, value]
    onnx.save(model, path)
    if allowed:
        policy = read_policy(path)
        assert np.abs(answer_of(policy.steps, SEEN) - policy.answer(SEEN)).max() < 1e-5
    else:
        with pytest.raises(PolicyError, match=rf"^{kind} end: a policy consists of "):
            read_policy(path)


def test_a_node_of_two_paths_is_named(tmp_path: Path) -> None:
    path = write_onnx(tmp_path / "net.onnx", random_network(20, 20, 4))
    model = onnx.load(path)
    model.graph.node[1].op_type = "Add"
    model.graph.node[1].input.append("observation")
    onnx.save(model, path)
    with pytest.raises(PolicyError, match=r"^Add /Tanh_1: 2 inputs that are not constant: expected 1$"):
        read_policy(path)


def test_a_graph_of_two_inputs_is_refused(tmp_path: Path) -> None:
    path = write_onnx(tmp_path / "net.onnx", random_network(20, 20, 4))
    model = onnx.load(path)
    model.graph.input.append(onnx.helper.make_tensor_value_info("goal", onnx.TensorProto.FLOAT, [3]))
    onnx.save(model, path)
    with pytest.raises(
        PolicyError, match=r"^2 inputs and 1 outputs: expected the observation and the action$"
    ):
        read_policy(path)


def stored(path: Path, layers: Layers, names: tuple[str, ...], metadata: Any = None, **others: Any) -> Path:
    """Write a network to a safetensors file; `others` are tensors with _ in place of the point."""
    tensors = {name.replace("_", ".", 1): np.asarray(value, np.float32) for name, value in others.items()}
    for name, (weights, biases) in zip(names, layers, strict=True):
        tensors |= {f"{name}.weight": weights, f"{name}.bias": biases}
    safetensors.save_file(tensors, path, metadata)
    return path


def by_hand(layers: Layers, x: Any, hidden: Any, output: Any) -> Any:
    for weights, biases in layers[:-1]:
        x = hidden(x @ weights.T.astype(float) + biases)
    return output(x @ layers[-1][0].T.astype(float) + layers[-1][1])


def relu(x: Any) -> Any:
    return np.maximum(x, 0)


def same(x: Any) -> Any:
    return x


PPO = ("mlp_extractor.policy_net.0", "mlp_extractor.policy_net.2", "action_net")
SAC = ("actor.latent_pi.0", "actor.latent_pi.2", "actor.mu")
LAYOUTS = [
    (("0", "2", "10"), {"activation": "relu"}, {}, relu, same),
    (("net.0", "net.2", "net.4"), {"activation": "tanh", "output": "tanh"}, {}, np.tanh, np.tanh),
    (PPO, {}, {"value_net.weight": np.ones((1, 9))}, np.tanh, same),
    (PPO, {"activation": "relu"}, {"log_std": np.ones(4)}, relu, same),
    (SAC, {}, {}, relu, np.tanh),
]


@pytest.mark.parametrize(("names", "metadata", "others", "hidden", "output"), LAYOUTS)
def test_a_safetensors_file_has_the_names_of_torch_or_stable_baselines(
    tmp_path: Path, names: Any, metadata: Any, others: Any, hidden: Any, output: Any
) -> None:
    layers, mean, std = random_network(20, 16, 12, 4), RNG.normal(0, 1, 20), RNG.uniform(0.5, 2, 20)
    others = {**others, "observation.mean": mean, "observation.std": std}
    path = stored(tmp_path / "net.safetensors", layers, names, {**metadata, "limit": "1.5"}, **others)
    policy = read_policy(path)
    expected = by_hand(layers, np.clip((SEEN - mean) / std, -1.5, 1.5), hidden, output)
    assert np.abs(policy.answer(SEEN) - expected).max() < 1e-5
    assert policy.shape == "20-16-12-4"


def broken(layer: int, part: int, place: Any, value: float) -> Layers:
    layers = random_network(20, 8, 4)
    layers[layer][part][place] = value
    return layers


NAMES = ("0", "2")
TANH = {"activation": "tanh"}
REFUSED: list[tuple[Any, ...]] = [
    (random_network(19, 8, 4), NAMES, TANH, {}, "weights of 0: 8 x 19; expected 8 x 20"),
    (random_network(20, 8, 3), NAMES, TANH, {}, "3 outputs: an action has 4"),
    (random_network(20, 8, 4)[:1] + random_network(9, 4), NAMES, TANH, {}, "weights of 2: 4 x 9; expected 4 x 8"),
    ([(np.ones(20), np.ones(1))], ("0",), TANH, {}, "weights of 0: 20; expected 20 x 20"),
    ([(np.ones((4, 20)), np.ones(3))], ("0",), TANH, {}, "biases of 0: 3; expected 4"),
    (broken(0, 0, (7, 3), np.nan), NAMES, TANH, {}, "weights of 0: element [7, 3] is nan: expected finite numbers"),
    (broken(1, 1, 2, np.inf), NAMES, TANH, {}, "biases of 2: element [2] is inf: expected finite numbers"),
    (random_network(20, 8, 4), NAMES, {}, {}, "the metadata has no activation: expected tanh or relu"),
    (random_network(20, 8, 4), NAMES, {"activation": "elu"}, {},
     "activation = elu: expected tanh, relu or none"),
    (random_network(20, 8, 4), NAMES, TANH | {"limit": "ten"}, {}, "metadata limit = ten: expected a positive number"),
    (random_network(20, 8, 4), NAMES, TANH | {"limit": "-1"}, {}, "metadata limit = -1: expected a positive number"),
    (random_network(20, 8, 4), NAMES, TANH, {"observation_std": np.zeros(20)},
     "factors of observation.std: element [0] is inf"),
    (random_network(20, 8, 4), NAMES, TANH, {"observation_mean": np.zeros(19)},
     "summands of observation.mean: 19; expected 20"),
    (random_network(20, 8, 4), NAMES, TANH, {"observation_mean": np.full(20, np.nan)},
     "summands of observation.mean: element [0] is nan"),
    (random_network(20, 8, 4), NAMES, TANH, {"conv": np.zeros(3)}, "tensor conv: expected 0.weight, 0.bias, 2.weight"),
    (random_network(20, 8, 4), ("pi.0", "vf.0"), TANH, {}, "tensor vf.0.weight: expected 0.weight"),
    ([], (), TANH, {}, "no outputs: an action has 4"),
    ([], (), TANH, {"0_weight": np.ones((4, 20))}, "0.weight has no 0.bias"),
]  # fmt: skip


@pytest.mark.parametrize(
    ("layers", "names", "metadata", "others", "reason"), REFUSED, ids=[case[4] for case in REFUSED]
)
def test_what_is_no_policy_is_refused(
    tmp_path: Path, layers: Layers, names: Any, metadata: Any, others: Any, reason: str
) -> None:
    path = stored(tmp_path / "net.safetensors", layers, names, metadata, **others)
    with pytest.raises(PolicyError, match=f"^{re.escape(reason)}") as error:
        read_policy(path)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize(
    ("name", "reason"),
    [
        ("net.onnx", "not a valid ONNX file: "),
        ("net.safetensors", "not a valid safetensors file: "),
        ("net.pt", ".pt: expected a file .onnx or .safetensors"),
        ("none/net.onnx", "No such file or directory"),
        ("none/net.safetensors", "No such file or directory"),
    ],
)
def test_a_file_of_another_kind_is_refused(tmp_path: Path, name: str, reason: str) -> None:
    if "/" not in name:
        (tmp_path / name).write_bytes(b"years of work")
    with pytest.raises(PolicyError, match=f"^{re.escape(reason)}") as error:
        read_policy(tmp_path / name)
    assert "\n" not in str(error.value)


def test_nan_in_an_onnx_file_is_refused(tmp_path: Path) -> None:
    with pytest.raises(PolicyError, match=r"weights of Gemm /Gemm_0: element \[7, 3\] is nan"):
        read_policy(write_onnx(tmp_path / "net.onnx", broken(0, 0, (7, 3), np.nan)))
