"""The documentation is true: its commands run, its links lead somewhere, its pictures are made, its words are explained."""

import ast
import importlib.util
import re
import shutil
import subprocess
import tomllib
from pathlib import Path
from types import ModuleType

import pytest

from ground_station.unused import Reason
from support import stm32_firmware
from support.documentation import (
    NOT_RUN,
    commands_in_blocks,
    floaty_commands,
    name_of,
    pages,
    parse,
    why_not_run,
)
from support.examples import blocks, commands_of, matches, run_examples
from support.firmware_bench import FirmwareBench
from support.paths import ROOT

DOCS = ROOT / "docs"
GLOSSARY = DOCS / "reference" / "glossary.md"
# Their examples belong together with more than a console can show: tests/hil/test_api.py, tests/hil/testing/test_plugin.py.
RUN_ELSEWHERE = {"docs/howto/python.md", "docs/howto/tests.md"}
GENERATED = {
    f"docs/reference/{name}.md"
    for name in [
        "cli", "cli-studies", "cli-programs", "cli-boards", "profile", "profile-board", "profile-world",
        "profile-devices", "parameters", "variables", "log", "faults",
    ]
}  # fmt: skip
PUBLISHED = ("https://arxiv.org/",)
FRONT = ("README.md", "CONTRIBUTING.md", "pyproject.toml", "mkdocs.yml", "Makefile")
PACKAGES = ("firmware_py", "ground_station", "hil", "profiles", "tools", "tests")
IMAGE = re.compile(r"!\[[^\]]*\]\(([^)]+)\)|<img src=\"([^\"]+)\"")
RUN = [page for page in pages() if name_of(page) not in RUN_ELSEWHERE and commands_in_blocks(page)]


def tool(name: str) -> ModuleType:
    spec = importlib.util.spec_from_file_location(name, ROOT / "tools" / f"{name}.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def links_of(page: Path) -> set[str]:
    text = re.sub(r"^```.*?^```$", "", page.read_text(encoding="utf-8"), flags=re.MULTILINE | re.DOTALL)
    return set(re.findall(r"(?<!!)\[[^\]\n]+\]\(([^)\s]+)\)", text))


def anchors_of(page: Path) -> set[str]:
    headings = re.findall(r"^#+ (.+)$", page.read_text(encoding="utf-8"), re.MULTILINE)
    return {re.sub(r"[^\w -]", "", heading.lower()).strip().replace(" ", "-") for heading in headings}


# Commands


@pytest.mark.parametrize("page", pages(), ids=name_of)
def test_every_command_exists_with_its_options_and_values(page: Path) -> None:
    code = " ".join(text for language, text in blocks(page) if language == "python")
    own = set(re.findall(r"\"([\w.-]+)\"", code))  # what the page itself declares, like a kind of fault
    wrong = [found for command in floaty_commands(page) if (found := parse(command))]
    assert [found for found in wrong if found.split()[-1] not in own] == []


@pytest.mark.parametrize(
    ("command", "wrong"),
    [
        ("floaty fyl hover", "no command 'fyl'"),
        ("floaty fly hover --sed 3", "No such option"),
        ("floaty fly howver", "unknown: howver"),
        ("floaty fly hover --profile flaoty", "no profile flaoty"),
        ("floaty fly hover --fault psh.y@2", "no kind of fault psh.y"),
        ("floaty fly hover --set predictor.enabeld=true", "no key predictor.enabeld=true"),
        ("floaty docs pyhton", "unknown: pyhton"),
        ("floaty deploy chekc", "no command 'chekc'"),
    ],
)
def test_a_command_that_does_not_exist_is_found(command: str, wrong: str) -> None:
    assert wrong in parse(command)


def commands_named(text: str) -> list[str]:
    """Return every `floaty …` that a source names in comments, docstrings and messages, also over several lines."""
    joined = re.sub(r"\"\s*\n\s*f?\"|\s*\n\s*(?:#|//|\*)?\s*", " ", text)
    return [re.sub(r"\s+", " ", command) for command in re.findall(r"`(floaty [^`]+)`", joined)]


def test_every_command_that_a_source_names_exists_with_its_options_and_values() -> None:
    sources = [path for path in tracked() if path.suffix != ".md" and path != Path(__file__)]
    named = {command for path in sources for command in commands_named(path.read_text(encoding="utf-8"))}
    assert {"floaty board doctor", "floaty deploy check"} <= named
    assert [wrong for command in sorted(named) if (wrong := parse(command))] == []


def test_a_command_that_a_comment_names_is_found_across_lines() -> None:
    text = 'x = 1  # as `floaty board\n       # serve` did\ny = "see `floaty "\n    f"list`"'
    assert commands_named(text) == ["floaty board serve", "floaty list"]
    assert parse("floaty board serve") == "'floaty board serve': no command 'serve'"


def test_every_make_target_and_tool_that_a_page_names_exists() -> None:
    targets = set(re.findall(r"^([a-z-]+):", (ROOT / "Makefile").read_text(), re.MULTILINE))
    for page in pages():
        text = page.read_text(encoding="utf-8")
        for words in re.findall(r"(?:`|^    |\$ )make ([a-z][a-z -]*)", text, re.MULTILINE):
            named = words.split("  ")[0].split()
            assert set(named) <= targets, f"{name_of(page)}: make {words}"
        for path in re.findall(r"python ((?:tools|tests)/\S+\.py)", text):
            assert (ROOT / path).is_file(), f"{name_of(page)}: {path}"


def test_every_reason_why_a_command_is_not_run_is_needed() -> None:
    shown = [command for page in pages() for command in commands_in_blocks(page)]
    assert [
        pattern for pattern, _ in NOT_RUN if not any(re.match(pattern, command) for command in shown)
    ] == []


@pytest.mark.long
@pytest.mark.parametrize("page", RUN, ids=name_of)
def test_commands_print_what_pages_show(page: Path, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.chdir(tmp_path)
    if "--board firmware.elf" in page.read_text(encoding="utf-8"):
        shutil.copy(stm32_firmware.build(flags=("-g", "-DCALM")), "firmware.elf")
    run_examples(page, monkeypatch, why_not_run)


def test_outputs_are_compared_by_words_and_numbers_except_widths_and_speeds() -> None:
    printed = (
        "first run on this machine: compiling\n┏━━━┓\n┃ metric ┃ value ┃\n│ rms_x  │  1.717 cm │\n"
        "completed; 12 times real time; 7.2 s from start to end; hash 548635c0b434aedb\n"
    )
    table = "│ metric │ value │\n│ rms_x │ 1.717 cm │\n"
    assert matches(
        table + "completed; 9 times real time; 8.1 s from start to end; hash 548635c0b434aedb\n", printed
    )
    assert not matches(
        table + "completed; 12 times real time; 7.2 s from start to end; hash 548635c0b434aedc\n", printed
    )
    assert matches("…\n│ rms_x │ … │\n…\n", printed)
    assert matches("…\n│ rms_x │ 1.717 cm │\n…\n", printed)
    assert not matches("…\n│ rms_x │ 1.718 cm │\n…\n", printed)
    assert not matches("…\n│ rms_y │ … │\n…\n", printed)
    assert not matches("…\n│ rms_x │ 1.717 mm │\n…\n", printed)
    assert not matches("│ metric │ value │\n", printed)
    assert matches("=== 4 passed in 1.00s ===\n", "===== 4 passed in 10.1s ====\n")
    assert not matches("=== 4 passed in 1.00s ===\n", "===== 12 passed in 1.00s ====\n")
    assert not matches("=== 4 passed in 1.00s ===\n", "=== 4 failed in 1.00s ===\n")
    compiled = "  cortex-m4 control 400 calls, 778 instructions (853 at most), 9.9 us (10.9)\n"
    assert matches(compiled.replace("778", "780").replace("10.9", "11.0"), compiled)
    assert not matches(compiled.replace("control", "estimate"), compiled)


def test_a_console_block_is_its_commands_each_with_its_output() -> None:
    assert commands_of("$ floaty list   # all\none\ntwo\n$ make test\n") == [
        ("floaty list", "one\ntwo\n"),
        ("make test", ""),
    ]


# Links and references


@pytest.mark.parametrize("page", pages(), ids=name_of)
def test_every_link_leads_to_a_page_or_to_a_published_source(page: Path) -> None:
    for link in links_of(page):
        if ":" in link:
            assert link.startswith(PUBLISHED), f"{link}: neither in the repository nor a published source"
            continue
        place, _, anchor = link.partition("#")
        target = (page.parent / place).resolve() if place else page
        if target.relative_to(ROOT).as_posix() in GENERATED:
            continue
        assert target.is_file(), f"{link}: no such file"
        if anchor:
            assert anchor in anchors_of(target), f"{link}: no such heading"


def tracked() -> list[Path]:
    names = subprocess.run(
        ["git", "ls-files", "--cached", "--others", "--exclude-standard", *PACKAGES, "docs", *FRONT],
        cwd=ROOT, capture_output=True, text=True, check=True,
    ).stdout.split("\n")  # fmt: skip
    texts = {".py", ".yml", ".toml", ".md", ".in", ".c", ".h", ".html", ".js", ".css", ".ld", ""}
    return [ROOT / name for name in names if name and Path(name).suffix in texts and (ROOT / name).is_file()]


def dead_references(text: str, file: Path) -> set[str]:
    """Return the Markdown files that a text names and that are not there, and folders outside the repository."""
    named = set(re.findall(r"(?<![\w/.-])((?:[\w-]+/|\.\./)*[\w-]+\.md)\b", text))
    there = [
        ROOT, file.parent, ROOT / "hil" / "commands" / "project", ROOT / "firmware_py" / "export", DOCS,
        *DOCS.iterdir(),
    ]  # fmt: skip
    dead = {
        name
        for name in named - GENERATED
        if not any((folder / name).exists() or (folder / f"{name}.in").exists() for folder in there)
        and not any((folder / name).resolve() in {ROOT / page for page in GENERATED} for folder in there)
    }
    return dead | set(re.findall(r"\.\./shared\b|/work/\w+", text))


def test_no_file_refers_to_what_is_not_in_the_repository() -> None:
    dead = {
        path.relative_to(ROOT).as_posix(): names
        for path in tracked()
        if path != Path(__file__) and (names := dead_references(path.read_text(encoding="utf-8"), path))
    }
    assert dead == {}


def test_a_reference_to_notes_that_are_not_here_is_found() -> None:
    here = ROOT / "hil" / "api.py"
    assert dead_references("see physics.md section 3 and ../shared/links", here) == {
        "physics.md",
        "../shared",
    }
    assert dead_references("see docs/howto/python.md, README.md", here) == set()


@pytest.mark.parametrize("page", pages(), ids=name_of)
def test_every_source_file_that_a_page_names_exists(page: Path) -> None:
    text = page.read_text(encoding="utf-8")
    named = set(re.findall(rf"`((?:{'|'.join(PACKAGES)})/[\w./-]*)`", text))
    assert {name for name in named if not (ROOT / name).exists()} == set()


# Installation


def test_the_table_of_extras_is_that_of_the_project_and_other_pages_lead_there() -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    declared = {
        extra: {re.split(r"[<>=]", package)[0] for package in packages}
        for extra, packages in project["optional-dependencies"].items()
        if extra not in ("bench", "docs", "test", "clients")  # what `make` targets of the clone install
    }
    page = DOCS / "howto" / "installation.md"
    rows = re.findall(r"^\| `([a-z]+)` \|.*\| ([^|]+) \|$", page.read_text(encoding="utf-8"), re.MULTILINE)
    assert {extra: set(re.findall(r"`([^`]+)`", packages)) for extra, packages in rows} == declared
    assert [name_of(one) for one in pages() if "pip install -e" in one.read_text("utf-8")] == [name_of(page)]
    wheels = {
        version
        for one in pages()
        for version in re.findall(r"floaty_hil-([\d.]+)-py3", one.read_text(encoding="utf-8"))
    }
    assert wheels == {project["version"]}


def test_the_licence_is_the_whole_text() -> None:
    text = (ROOT / "LICENSE").read_text(encoding="utf-8")
    assert "GNU GENERAL PUBLIC LICENSE\n                       Version 3, 29 June 2007" in text
    assert [int(number) for number in re.findall(r"^  (\d+)\. [A-Z]", text, re.MULTILINE)] == list(range(18))
    assert "END OF TERMS AND CONDITIONS" in text


# Pictures


def pictures_shown() -> set[Path]:
    return {
        (page.parent / (image[0] or image[1])).resolve()
        for page in pages()
        for image in IMAGE.findall(page.read_text(encoding="utf-8"))
    }


def test_every_picture_is_shown_and_every_picture_shown_is_there() -> None:
    assert pictures_shown() == {*DOCS.rglob("*.png"), *DOCS.rglob("*.gif")}


def test_make_pictures_makes_every_picture() -> None:
    made = tool("pictures").PICTURES
    assert set(made) == {path.name for path in pictures_shown()}


# Words


def terms() -> list[str]:
    return re.findall(r"^\| ([^|]+?) \| [^|]+ \|$", GLOSSARY.read_text(encoding="utf-8"), re.MULTILINE)[1:]


def test_the_glossary_is_in_alphabetical_order_and_explains_each_term_once() -> None:
    names = [term.lower() for term in terms()]
    assert names == sorted(set(names))


def test_every_term_of_the_glossary_is_used_on_another_page() -> None:
    text = " ".join(page.read_text(encoding="utf-8") for page in pages() if page != GLOSSARY).lower()
    words = re.sub(r"\s+", " ", text)
    unused = {
        term
        for term in terms()
        if not re.search(rf"\b{re.escape(term.split(',')[0].lower().split('..')[0])}", words)
    }
    assert unused == set()


def test_the_glossary_explains_frames_and_states_of_the_code() -> None:
    explained = GLOSSARY.read_text(encoding="utf-8")
    firsts = {term.split(",")[0] for term in terms()}
    assert {
        "W", "B", "G", "S", "F1..F4", "correction", "release", "lockstep", "paced", "innovation", "mailbox",
    } <= firsts  # fmt: skip
    from firmware_py.wire.supervisor import State

    assert {state.name.lower() for state in State if state.name.lower() not in explained} == set()


# Why poses are not used


def lines_on_board() -> set[str]:
    """The lines about poses in the code of the board, with … for values."""
    found = set()
    for file in ("firmware_py/firmware.py", "firmware_py/wire/mavlink.py", "firmware_py/wire/crtp.py"):
        for node in ast.walk(ast.parse((ROOT / file).read_text(encoding="utf-8"))):
            if isinstance(node, ast.JoinedStr):
                parts = [one.value if isinstance(one, ast.Constant) else "…" for one in node.values]
                found.add("".join(map(str, parts)))
            elif isinstance(node, ast.Constant):
                found.add(str(node.value))
    found = {line for line in found if not line.endswith(" ")}  # the pieces between values are constants, too
    return {line for line in found if re.match(r"poses? |quaternion …|position … m|odometry (in|of)", line)}


def test_the_table_of_unused_poses_is_that_of_the_code() -> None:
    text = (DOCS / "reference" / "poses.md").read_text(encoding="utf-8")
    station, board = text.split("## At the station")[1].split("## On board")
    station, _ = station.split("Some poses")
    row = re.compile(r"^\| ([^|]+?) \| [^|]+ \| ([^|]+?) \|$", re.MULTILINE)
    reasons = [(one.word, re.sub(r"\{[^}]*\}", "…", one.line) or "none") for one in Reason]
    assert row.findall(station) == [("counter", "line"), *reasons]
    on_board = row.findall(board)[1:]
    assert {line for _, line in on_board} - {"none"} == lines_on_board()
    firmware = FirmwareBench().firmware
    counters = {variable.name for variable in firmware.variables} | {"mavlink.refused"}
    assert {counter for counter, _ in on_board} <= counters
