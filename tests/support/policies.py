"""Policies of the tests: networks that answer as the built-in law does, and their files."""

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from firmware_py.config import parameters_of
from hil.config import load_config

Layers = list[tuple[NDArray[np.float32], NDArray[np.float32]]]  # weights (outputs, inputs) and biases
SMALL = 0.02  # of the signals of a tanh network, which is nearly linear there


def built_in() -> NDArray[np.float64]:
    """Return the gains of the built-in law, without its integrator, as a matrix from observation to action."""
    law = parameters_of(load_config("floaty")).fields
    K = np.zeros((4, 20))
    K[0, [1, 4, 6, 9]] = law.gain_y, -law.gain_vy, -law.gain_roll, -law.gain_p
    K[1, [0, 3, 7, 10]] = law.gain_x, -law.gain_vx, -law.gain_pitch, -law.gain_q
    K[2, [8, 11]] = law.gain_yaw, -law.gain_r
    K[3, [2, 5]] = law.gain_z, -law.gain_vz
    return K / np.array([law.limit_u, law.limit_u, law.limit_u3, law.limit_u])[:, None]


def network(activation: str = "tanh", sizes: tuple[int, int] = (64, 40)) -> Layers:
    """Return two hidden layers and an output that answer as the built-in law; the units it leaves are random."""
    rng = np.random.default_rng(11)
    first, second = sizes
    W = [rng.normal(0, 0.1, shape) for shape in ((first, 20), (second, first), (4, second))]
    W[2][:] = 0.0
    if activation == "relu":  # x = relu(x) - relu(-x)
        W[0][:40], W[1][:8] = np.concatenate([np.eye(20), -np.eye(20)]), 0.0
        W[1][:8, :40] = np.block([[built_in(), -built_in()], [-built_in(), built_in()]])
        W[2][:, :8] = np.concatenate([np.eye(4), -np.eye(4)], axis=1)
    else:
        W[0][:20], W[1][:4] = SMALL * np.eye(20), 0.0
        W[1][:4, :20] = 0.1 * built_in()
        W[2][:, :4] = np.eye(4) / (0.1 * SMALL)
    return [(w.astype(np.float32), np.zeros(len(w), np.float32)) for w in W]


def write_onnx(path: Path, layers: Layers, activation: str = "Tanh", before: tuple[str, ...] = ()) -> Path:
    """Write a network as an exporter does; `before` names operations with a constant in front of it."""
    from onnx import TensorProto, helper, numpy_helper, save

    nodes, constants, value = [], [], "observation"

    def add(kind: str, *arrays: NDArray[np.float32], **attributes: object) -> None:
        nonlocal value
        names = [f"{kind}_{len(nodes)}_{index}" for index in range(len(arrays))]
        pairs = zip(arrays, names, strict=True)
        constants.extend(numpy_helper.from_array(array, name) for array, name in pairs)
        nodes.append(
            helper.make_node(
                kind, [value, *names], [f"{kind}_{len(nodes)}"], name=f"/{kind}_{len(nodes)}", **attributes
            )
        )
        value = nodes[-1].output[0]

    rng = np.random.default_rng(5)
    for kind in before:
        if kind == "Clip":
            add(kind, np.array(-1.5, np.float32), np.array(1.5, np.float32))
        else:
            add(kind, rng.uniform(0.5, 2.0, 20).astype(np.float32))
    for index, (weights, biases) in enumerate(layers):
        if index % 2:
            add("MatMul", weights.T.copy())
            add("Add", biases)
        else:
            add("Gemm", weights, biases, transB=1)
        if index + 1 < len(layers):
            add(activation)
    ends = [
        helper.make_tensor_value_info(name, TensorProto.FLOAT, ["batch", size])
        for name, size in (("observation", layers[0][0].shape[-1]), (value, len(layers[-1][0])))
    ]
    graph = helper.make_graph(nodes, "policy", ends[:1], ends[1:], constants)
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)], ir_version=8)
    save(model, path)
    return path
