"""`floaty new` and `floaty policy`: make folders with a control law, profile and tests, ready to fly; `floaty check`.

The first has a small control law with experiments, or a robot, for the user to change; the second has a trained network
as its law. The last one checks such laws without a flight.
"""

from __future__ import annotations

import re
import textwrap
from collections.abc import Iterable
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Any

import click

from firmware_py.errors import FirmwareError
from hil.commands.options import FILE, PATH, say, warn
from hil.errors import LabError, refusing, require, require_empty

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

TEMPLATES = Path(__file__).parent / "project"  # NAME.in
POLICY_TEMPLATES = Path(__file__).parent / "policy_project"
ROBOT_TEMPLATES = Path(__file__).parent / "robot_project"
TILT_ROTOR = Path(__file__).parent / "tilt_rotor_project"  # instead of the other's robot.py
ANY_TEMPLATES = Path(__file__).parent / "any_project"  # what each of them has as well
NAMED = {"gitignore": ".gitignore"}  # files that would affect the template itself
TOLERANCE = 1e-4  # of an action, -1..1
ROOM = 0.9  # of the control slot: the cycles are from one compiler, for some states


@click.command()
@click.argument("folder", metavar="DIR", type=PATH)
@click.option(
    "--robot", is_flag=True, help="A robot of your own: robot.py, its controller, profile and tests."
)
@click.option("--tilt-rotor", is_flag=True, help="The same with two rotors that tilt.")
def new(folder: Path, robot: bool, tilt_rotor: bool) -> None:
    """Make a project in DIR, a new or empty folder: controller.py, profile.toml, experiments.py, tests, README.md."""
    templates = (ROBOT_TEMPLATES, TILT_ROTOR) if tilt_rotor else (ROBOT_TEMPLATES if robot else TEMPLATES,)
    write_project("new", templates, folder, name=project_name("new", folder))
    say(f"cd {folder}; floaty fly hover --profile profile.toml; pytest; see README.md for more")  # fmt: skip


@click.command()
@click.argument("file", metavar="FILE", type=FILE)
@click.option(
    "--out", "folder", required=True, metavar="DIR", type=PATH,
    help="The folder to write, new or empty: controller.py, profile.toml, README.md, tests.",
)  # fmt: skip
def policy(file: Path, folder: Path) -> None:
    """Write the control law of a trained policy: FILE.onnx or FILE.safetensors, a perceptron with tanh or ReLU.

    Its input is the observation and its output the action of firmware_py/core/observation.py. The law is run as Cortex-M4
    machine code, compared with FILE, and refused when a call exceeds its control slot.
    """
    from firmware_py.policy.measuring import LawFigures, measure
    from firmware_py.policy.reading import LIBRARIES, read_policy
    from hil.board.cores.boards import CORTEX_M4, runner_of
    from hil.config import load_config

    if file.suffix in LIBRARIES:
        require(f"policy {file}", "policy", LIBRARIES[file.suffix])
    require_empty("policy --out", folder)
    values: dict[str, Any] = {
        "name": project_name("policy --out", folder),
        "source": file.name,
        "constant": _constant,
    }
    with TemporaryDirectory() as scratch:
        try:
            values["policy"] = network = read_policy(file)
            write_project(
                "policy", (POLICY_TEMPLATES,), Path(scratch), **values, figures=LawFigures(0, 0, 0, 0.0)
            )
            config = load_config(f"{scratch}/profile.toml")
            figures = measure(config, network, runner_of(CORTEX_M4, config.logic))
        except (FirmwareError, LabError) as error:
            raise LabError(f"policy {file}: {str(error).replace(f'{scratch}/', '')}") from None
    if figures.share > ROOM:
        raise LabError(
            f"policy {file}: {network.shape}: {figures}; at most {ROOM:.0%} of the slot are allowed"
        )
    if not figures.difference <= TOLERANCE:
        text = f"the law's actions differ by {figures.difference:.2g} from the file's: at most {TOLERANCE:g}"
        raise LabError(f"policy {file}: {text}")
    write_project("policy", (POLICY_TEMPLATES,), folder, **values, figures=figures)
    say(f"{network.shape}, {network.numbers} constants: {figures}")
    say(f"largest difference from {file.name}: {figures.difference:.1e} of an action")
    say(f"floaty fly hover --profile {folder / 'profile.toml'}")


def project_name(command: str, folder: Path) -> str:
    """Return the name of the project in a folder."""
    name = re.sub(r"[^a-z0-9]+", "-", folder.resolve().name.lower()).strip("-")
    if not name:
        raise LabError(f"{command} {folder}: a project's name, its folder's, has letters a to z or digits")
    return name


def write_project(command: str, templates: Iterable[Path], folder: Path, **values: object) -> None:
    """Write the templates of folders, the last one's of each name, filled with the values, into a new or empty folder."""
    from jinja2 import Environment, StrictUndefined

    environment = Environment(
        undefined=StrictUndefined, trim_blocks=True, lstrip_blocks=True, keep_trailing_newline=True
    )
    require_empty(command, folder)
    with refusing(f"{command} {folder}: ", OSError):
        folder.mkdir(parents=True, exist_ok=True)
        with TemporaryDirectory(dir=folder, prefix=".") as scratch:  # all files or none
            known = {
                path.relative_to(source): path
                for source in (ANY_TEMPLATES, *templates)
                for path in source.rglob("*.in")
            }
            for name, template in known.items():
                place = name.with_suffix("")
                path = Path(scratch) / NAMED.get(str(place), place)
                path.parent.mkdir(parents=True, exist_ok=True)
                text = environment.from_string(template.read_text(encoding="utf-8")).render(values)
                path.write_text(text, encoding="utf-8")
            for path in Path(scratch).iterdir():
                path.rename(folder / path.name)


def _constant(values: NDArray[np.float32]) -> str:
    """Return an array as a constant of the subset, each row on separate lines."""
    if values.ndim == 1:
        return f"constant({_wrapped(', '.join(map(str, values)))})"
    rows = (f"({', '.join(map(str, row))}{',' * (len(row) == 1)})," for row in values)
    return f"constant({''.join(map(_wrapped, rows))})"


def _wrapped(text: str) -> str:
    lines = textwrap.wrap(text, 116, break_on_hyphens=False, break_long_words=False)
    return "".join(f"\n    {line}" for line in lines) + "\n" * (not text.endswith(","))


@click.command()
@click.argument("files", nargs=-1, required=True, type=FILE, metavar="FILE...")
def check(files: tuple[Path, ...]) -> int:
    """Check own control laws and estimators without a flight.

    Print one line for each FILE that can fly. Otherwise print each refusal to standard error, as FILE:LINE: what: repair,
    and end with exit code 2. The hooks in a FILE show whether it is a controller or an estimator.
    """
    from firmware_py.logic.loading import check_file

    refused = 0
    for file in files:
        try:
            loaded = check_file(file)
        except FirmwareError as error:
            refused += 1
            for line in str(error).splitlines():
                warn(line)
            continue
        (plug,) = loaded.plugs
        hooks = ", ".join(plug.hooks)
        say(f"{file}: ok ({plug.point.name}: {hooks}; {_counted(len(plug.parameters), 'parameter')})")
    return 2 if refused else 0


def _counted(number: int, what: str) -> str:
    return f"{number} {what}{'' if number == 1 else 's'}"
