"""`floaty new`: a small project for the user's own control law, with profile, experiments and tests, ready to fly."""

import re
from pathlib import Path

import click

from hil.commands.options import console
from hil.errors import LabError

TEMPLATES = Path(__file__).parent / "project"  # NAME.in
NAMED = {"gitignore": ".gitignore"}  # files that would act on the template itself


@click.command()
@click.argument("folder", metavar="DIR", type=click.Path(path_type=Path))
def new(folder: Path) -> None:
    """Make a project in DIR, which is new or empty: controller.py, profile.toml, experiments.py, tests, README.md."""
    name = re.sub(r"[^a-z0-9]+", "-", folder.resolve().name.lower()).strip("-")
    if not name:
        raise LabError(f"new {folder}: a project's name, its folder's, has letters a to z or digits")
    try:
        if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
            raise LabError(f"new {folder}: it exists and is not empty; choose a folder that is new or empty")
        for template in sorted(TEMPLATES.rglob("*.in")):
            place = template.relative_to(TEMPLATES).with_suffix("")
            path = folder / NAMED.get(str(place), place)
            path.parent.mkdir(parents=True, exist_ok=True)
            text = template.read_text(encoding="utf-8").replace("{{ name }}", name)
            path.write_text(text, encoding="utf-8")
    except OSError as error:
        raise LabError(f"new {folder}: {error.strerror or error}") from None
    console.print(
        f"cd {folder}; floaty fly hover --profile profile.toml; pytest; see README.md for more",
        soft_wrap=True, markup=False,
    )  # fmt: skip
