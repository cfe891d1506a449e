"""`floaty policy`: the law that it writes answers as the file's framework does, on every target, and flies."""

import sys
from pathlib import Path

import numpy as np
import pytest

from firmware_py.config import parameters_of
from firmware_py.core.structs import MODE_FLY
from firmware_py.core_runner import CoreBlocks, default_runner
from firmware_py.logic.loading import load_logic
from firmware_py.policy.reading import read_policy
from hil.board.cores.boards import runner_of
from hil.config import load_config
from hil.laboratory.files.result import read_result
from support.command import Cli
from support.installed_wheel import run
from support.policies import network, write_onnx

pytest.importorskip("onnx")
pytestmark = pytest.mark.usefixtures("empty_folder")

FILES = ["README.md", "conftest.py", "controller.py", "profile.toml", "tests/test_policy.py"]


def files_in(folder: Path) -> list[str]:
    return sorted(path.relative_to(folder).as_posix() for path in folder.rglob("*") if path.is_file())


@pytest.mark.long
def test_a_policy_becomes_a_law_with_the_answers_of_its_framework(cli: Cli) -> None:
    file = write_onnx(Path("hover.onnx"), network(), before=("Sub", "Div", "Clip"))
    assert cli("policy", file, "--out", "law") == 0, cli.err
    assert files_in(Path("law")) == FILES
    first, second, _ = cli.out.splitlines()
    assert first.startswith("20-64-40-4, 4269 constants: ")
    assert "us of a Cortex-M4), 11% of its control slot of 672000; flash 1" in first
    assert second.startswith("largest difference from hover.onnx: ")
    assert first.partition(": ")[2] in (Path("law") / FILES[0]).read_text(encoding="utf-8")

    config, answer = load_config("law/profile.toml"), read_policy(file).answer
    logic = load_logic(config.logic)
    runners = (default_runner, runner_of("c", config.logic), runner_of("cortex-m4", config.logic))
    targets = [CoreBlocks(parameters_of(config), runner, logic) for runner in runners]
    rng = np.random.default_rng(1)
    for _ in range(30):
        state, target = rng.normal(0, 0.3, 16), rng.normal(0, 0.1, 4)
        for blocks in targets:
            blocks.data.fields.mode = MODE_FLY
            blocks.estimator.fields.now[:], blocks.parameters.fields.target[:] = state, target
            blocks.run.call("control")
        memories = {blocks.named["controller_memory"].bytes() for blocks in targets}
        assert len(memories) == 1
        memory = targets[0].named["controller_memory"].memory
        expected = np.clip(answer(memory["observation"])[0], -1, 1)
        assert np.abs(memory["action"][0] - expected).max() < 1e-5
        assert np.abs(expected).max() > 0.01


@pytest.mark.long
def test_forty_thousand_weights_exceed_the_control_slot(cli: Cli) -> None:
    file = write_onnx(Path("large.onnx"), network(sizes=(180, 201)))
    assert "; at most 90% of the slot are allowed\n" in cli.refusal("policy", file, "--out", "law")
    assert "20-180-201-4: 6" in cli.err
    assert " of its control slot of 672000; flash 16" in cli.err
    assert not Path("law").exists()


def test_more_numbers_than_the_flash_has_room_for_are_one_line(
    cli: Cli, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("firmware_py.export.reading.MOST_NUMBERS", 4187)
    file = write_onnx(Path("huge.onnx"), network())
    reason = "4188 numbers in the constant arrays of this file: at most 4187"
    assert reason in cli.refusal("policy", file, "--out", "law")
    assert cli.err.startswith("floaty: policy huge.onnx: controller.py:")


def test_an_unusable_file_or_folder_is_one_line(cli: Cli) -> None:
    file = write_onnx(Path("bad.onnx"), network(), "Sigmoid")
    assert "bad.onnx: Sigmoid /Sigmoid_1: a policy consists of " in cli.refusal(
        "policy", file, "--out", "law"
    )
    Path("taken").mkdir()
    Path("taken/work").touch()
    assert "policy --out taken: it exists and is not empty" in cli.refusal("policy", file, "--out", "taken")
    assert not Path("law").exists()


@pytest.mark.long
def test_a_policy_as_good_as_the_built_in_law_flies_and_its_tests_pass(cli: Cli) -> None:
    file = write_onnx(Path("hover.onnx"), network("relu"), "Relu")
    assert cli("policy", file, "--out", "law") == 0
    assert cli("fly", "hover", "--profile", "law/profile.toml", "--duration", "3") == 0
    assert read_result(Path("runs/hover-1")).program.logic
    assert "2 passed" in run(Path.cwd(), sys.executable, "-m", "pytest", "law").stdout
