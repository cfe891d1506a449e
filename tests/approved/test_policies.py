"""Random files of trained policies, half of them with a mistake, are read or refused as they were.

If a change is meant: make approve.
"""

from itertools import pairwise
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import pytest

from firmware_py.policy.reading import PolicyError, answer_of, read_policy
from support.approved import approve, judge
from support.random_use import Random

READ = Path(__file__).with_name("policies.json")
FILES = 120
PACKAGES = ("numpy", "onnx", "protobuf", "safetensors")
onnx = pytest.importorskip("onnx")
save_file = pytest.importorskip("safetensors.numpy").save_file


class Policies(Random):
    """Writes a policy's file and returns how it was read."""

    def array(self, *shape: int) -> Any:
        """Return small numbers; one of them is seldom not finite."""
        array = (self.rng.integers(-99, 100, shape) / 64).astype(np.float32)
        if self.below(60) == 0 and array.size:
            array.ravel()[self.below(array.size)] = self.pick(np.nan, np.inf)
        return array

    def sizes(self) -> list[int]:
        """Return the numbers of a network's inputs and outputs; an end is seldom another than that of the robot."""
        hidden = [1 + self.below(5) for _ in range(self.below(4))]
        return [self.pick(*[20] * 20, 19), *hidden, self.pick(*[4] * 20, 3)]

    def safetensors(self, path: Path) -> None:
        sizes, tensors = self.sizes(), {}
        way = self.below(3)
        before = self.pick("", "net.") if way == 0 else ""
        names = [f"{before}{2 * n}" for n in range(len(sizes) - 1)]
        if way:
            prefix, last = (("mlp_extractor.policy_net.", "action_net"), ("actor.latent_pi.", "actor.mu"))[
                way - 1
            ]
            names = [*(prefix + name for name in names[:-1]), last]
        order = self.rng.permutation(len(names)).tolist()
        for n in order:
            wrong = self.below(40) == 0
            tensors[f"{names[n]}.weight"] = self.array(sizes[n + 1], sizes[n] + wrong)
            if self.below(50):
                tensors[f"{names[n]}.bias"] = self.array(sizes[n + 1])
        if self.below(3) == 0:
            tensors["observation.mean"] = self.array(self.pick(20, 20, 20, 1, 7))
        if self.below(3) == 0:
            tensors["observation.std"] = 1.0 + np.abs(self.array(20))
        if self.below(20) == 0:
            tensors[self.pick("log_std", "value.0.weight")] = self.array(4)
        metadata = {"limit": self.pick("2", "0.5", "-1", "x", "1.")} if self.below(3) == 0 else {}
        if way == 0 or self.below(2):
            metadata["activation"] = self.pick(
                "tanh", "relu", "relu", "tanh", "elu" if self.below(5) == 0 else "tanh"
            )
        if self.below(2):
            metadata["output"] = self.pick("none", "tanh", "softmax" if self.below(5) == 0 else "none")
        if way == 0 and self.below(15) == 0:
            metadata.pop("activation")
        save_file(tensors, path, metadata)

    def onnx(self, path: Path) -> None:
        made, kinds, width, sizes = onnx.helper, [], 0, self.sizes()
        nodes: list[Any] = []
        constants: list[Any] = []

        def add(kind: str, *arrays: Any, first: bool = True, **attributes: Any) -> None:
            names = [f"c{len(nodes)}_{n}" for n in range(len(arrays))]
            for name, array in zip(names, arrays, strict=True):
                constants.append(onnx.numpy_helper.from_array(np.asarray(array, np.float32), name))
            given = [f"x{len(nodes)}"]
            inputs = [*given, *names] if first else [*names, *given]
            name = self.pick("", f"node{len(nodes)}")
            nodes.append(made.make_node(kind, inputs, [f"x{len(nodes) + 1}"], name, **attributes))

        for width, outputs in pairwise(sizes):
            before = self.pick("Sub", "Div", "Add", "Mul", "none")
            for kind in (before, self.pick("Clip", "none", "none", "Identity", "Flatten")):
                if kind == "Clip":
                    end = self.pick(1.0, 2.5)
                    add(kind, np.float32(-end if self.below(9) else -2.0 * end), np.float32(end))
                elif kind in ("Identity", "Flatten"):
                    add(kind)
                elif kind != "none":
                    values = np.abs(self.array(self.pick(width, 1))) + 1.0
                    add(kind, values, first=kind in ("Add", "Sub", "Mul") or self.below(9) > 0)
            wide = width + (self.below(40) == 0)
            if self.below(2):
                turned = self.below(2)
                bias = [self.array(outputs)] if self.below(3) else []
                more = {"alpha": self.pick(1.0, 2.0)} if self.below(12) == 0 else {}
                add(
                    "Gemm",
                    self.array(*((outputs, wide) if turned else (wide, outputs))),
                    *bias,
                    transB=turned,
                    **more,
                )
            else:
                add("MatMul", self.array(wide, outputs))
            kinds = [self.pick("Tanh", "Relu", "none", "Sigmoid" if self.below(9) == 0 else "Tanh")]
            for kind in kinds:
                if kind != "none":
                    add(kind)
        kind = onnx.TensorProto.FLOAT
        given = made.make_tensor_value_info("x0", kind, [1, sizes[0]])
        made_of = made.make_tensor_value_info(f"x{len(nodes)}", kind, [1, None])
        graph = made.make_graph(nodes, "policy", [given], [made_of], constants)
        onnx.save(made.make_model(graph, opset_imports=[made.make_opsetid("", 17)], ir_version=8), path)

    def told(self, folder: Path) -> str:
        path = folder / self.pick("policy.onnx", "policy.safetensors")
        (self.onnx if path.suffix == ".onnx" else self.safetensors)(path)
        if self.below(25) == 0:
            path.write_bytes(path.read_bytes()[: self.below(60)])
        try:
            policy = read_policy(path)
        except PolicyError as error:
            return f"{path.suffix}: {error}"
        steps = [f"{one.kind} {one.name} {one.layer} {one.inputs}-{one.outputs}" for one in policy.steps]
        sums = [f"{float(array.sum()):.4g}" for one in policy.steps for array in one.arrays.values()]
        seen = (self.rng.integers(-99, 100, (2, 20)) / 64).astype(np.float32)
        answers = [np.asarray(one, float) for one in (answer_of(policy.steps, seen), policy.answer(seen))]
        assert answers[0] == pytest.approx(answers[1], abs=1e-3, rel=1e-3)
        told = f"{path.suffix}: {policy.shape} {policy.numbers} {', '.join(steps)}; {' '.join(sums)}"
        return f"{told}; {answers[0].round(2).tolist()}"


def read() -> list[str]:
    """Return how each file was read."""
    with TemporaryDirectory() as folder:
        return [Policies(seed).told(Path(folder)) for seed in range(FILES)]


def test_random_policies_are_read_as_they_were() -> None:
    judge(READ, "policies", read(), *PACKAGES)


if __name__ == "__main__":
    approve(READ, {"policies": read}, *PACKAGES)
