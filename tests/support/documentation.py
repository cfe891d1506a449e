"""The pages of the documentation, what they show, and what of it cannot be run in the tests."""

import re
import shlex
from collections.abc import Iterable, Iterator, Mapping
from functools import cache
from pathlib import Path

import click

from hil.commands.app import app
from hil.commands.listing import pages_of
from hil.config import LabConfig, profile_names
from hil.laboratory.experiments import EXPERIMENTS
from hil.laboratory.fault_kinds import KINDS
from hil.research.studies.catalogue import STUDIES
from support.examples import blocks, commands_of
from support.paths import ROOT

BOARD = "a board, a Crazyradio or another program must be there"
SERVER = "runs until Ctrl-C, or needs what does; tests/realtime/ drives it"
IMAGE = (
    "needs a built image of the Crazyflie firmware, whose sources are not here; tests fly one of their own"
)
PACED = "paced to the wall clock; tests/realtime/ drives it"
DEAR = "takes more than a minute: a measurement, not an example"
MAKE = "sets up an environment or runs the tests themselves"

# Every command that is shown in a console block and not run there, with the reason: a pattern for its beginning.
NOT_RUN = (
    (r"make (fly|test|test-all|docs|CRAZYFLIE_BASE=\S+)\b", MAKE),
    (r"(git clone|make -C) ", IMAGE),
    (r"export PATH=", MAKE),
    (r"cd \$\(mktemp", MAKE),
    (r"floaty serve\b", SERVER),
    (r"floaty station\b", SERVER),
    (r"floaty param\b", BOARD),
    (r"floaty compare runs/lab-1", BOARD),
    (r"floaty board doctor\b", BOARD),
    (r"floaty fly .*--board (radio|usb|udp):", BOARD),
    (r"floaty (fly|deploy check) .*(build/cf2(1bl)?\.elf|cf2\.bin|firmware-cf2-.*\.zip)", IMAGE),
    (r"(gdb-multiarch|floaty debug) ", IMAGE),
    (r"genhtml ", BOARD),
    (r"floaty fly .*--link (radio|udp|mavlink):", PACED),
    (r"env PYTHONPATH=\S+ FLOATY_DONGLE=", SERVER),
    (r"(mavproxy\.py|python tests/support/mavsdk_(client|offboard)\.py) ", SERVER),
    (r"floaty deploy check$", DEAR),
    (r"floaty (campaign|tune)\b", DEAR),
    (r"floaty fly hover --profile tuned\.toml", DEAR),
)  # fmt: skip

TOPICS = pages_of(ROOT / "docs")
PLACEHOLDER = re.compile(r"[A-Z][A-Z_]*\d?(\.\w+)?|.*…")


@cache
def pages() -> list[Path]:
    """Return every page: front page, contributions, and all of docs/."""
    return [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *sorted((ROOT / "docs").rglob("*.md"))]


def name_of(page: Path) -> str:
    return page.relative_to(ROOT).as_posix()


def why_not_run(command: str) -> str:
    """Return why a command is not run; empty: it is."""
    return next((reason for pattern, reason in NOT_RUN if re.match(pattern, command)), "")


def commands_in_blocks(page: Path) -> list[str]:
    """Return the commands of the page's console blocks, without comments."""
    return [
        command
        for language, text in blocks(page)
        if language == "console"
        for command, _ in commands_of(text)
    ]


def floaty_commands(page: Path) -> list[str]:
    """Return every `floaty …` that the page shows: in console blocks, in indented blocks, and within a sentence."""
    text = page.read_text(encoding="utf-8")
    prose = re.sub(r"^```.*?^```$", "", text, flags=re.MULTILINE | re.DOTALL)
    shown = list(re.findall(r"`(floaty [^`]+)`", prose))
    shown += re.findall(r"^    (floaty [^#\n]+)", prose, re.MULTILINE)
    shown += [part.strip() for line in commands_in_blocks(page) for part in line.split(";")]
    return [command.strip() for command in shown if command.startswith("floaty ")]


def parse(command: str) -> str:
    """Return what is wrong with a `floaty` command as far as can be known without running it; empty: nothing."""
    words = [re.sub(r"^\[|\]$|…$", "", word) for word in shlex.split(command)[1:]]
    words = [word for word in words if word]
    group: click.Command = app
    while isinstance(group, click.Group) and words and not words[0].startswith("-"):
        found = group.get_command(click.Context(group), words[0])
        if found is None:
            if group.invoke_without_command or PLACEHOLDER.fullmatch(words[0]):
                break
            return f"{command!r}: no command {words[0]!r}"
        group, words = found, words[1:]
    try:
        options, _, _ = group.make_parser(click.Context(group)).parse_args(list(words))
    except click.UsageError as error:
        return (
            "" if words[-1:] and _lacks_its_value(words, error) else f"{command!r}: {error.format_message()}"
        )
    shown = {
        parameter.opts[0]: [
            value for value in _listed(options.get(parameter.name or "")) if isinstance(value, str)
        ]
        for parameter in group.params
    }
    return next((f"{command!r}: {wrong}" for wrong in _wrong(group.name or "", shown)), "")


def _listed(value: object) -> Iterable[object]:
    return value if isinstance(value, list | tuple) else (value,)


def _lacks_its_value(words: list[str], error: click.UsageError) -> bool:
    """Whether the command is cut short in a sentence: `--seeds` alone, which names an option that exists."""
    return isinstance(error, click.BadOptionUsage) and "requires an argument" in error.format_message()


def _wrong(command: str, shown: Mapping[str, list[str]]) -> Iterator[str]:
    """Yield what is no experiment, study, profile, kind of fault or key."""
    known = {"docs": TOPICS, "fly": EXPERIMENTS, "study": STUDIES, "check": EXPERIMENTS}.get(command)
    for name in [*shown.get("experiment", []), *shown.get("name", []), *shown.get("topic", [])]:
        if known is not None and name not in known and ".py:" not in name and not PLACEHOLDER.fullmatch(name):
            yield f"unknown: {name}"
    for profile in shown.get("--profile", []):
        if not (profile in profile_names() or profile.endswith(".toml") or PLACEHOLDER.fullmatch(profile)):
            yield f"no profile {profile}"
    for fault in shown.get("--fault", []):
        kind = fault.split("@")[0]
        if kind not in KINDS and not PLACEHOLDER.fullmatch(kind):
            yield f"no kind of fault {kind}"
    for override in shown.get("--set", []):
        key = override.split("=")[0]
        if not _is_key(key) and not PLACEHOLDER.fullmatch(key.split(".")[0]):
            yield f"no key {override}"


def _is_key(key: str) -> bool:
    model = LabConfig
    section, *rest = key.split(".")
    if section in ("logic", "limits", "sensors"):
        return True
    field = model.model_fields.get(section)
    fields = getattr(field.annotation, "model_fields", {}) if field is not None else {}
    return bool(rest) and rest[0] in fields
