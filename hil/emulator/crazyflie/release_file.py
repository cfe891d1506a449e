"""Bitcraze's release files: a zip of binaries with a manifest, of which the firmware of the STM32 is taken.

The format is that of cflib's boot loader (manifest versions 1 and 2). Nothing is unpacked to disk; sizes are bounded.
"""

import json
import lzma
import zipfile
import zlib
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from io import BytesIO
from pathlib import Path
from typing import Any

from hil.errors import LabError

MANIFEST, MANIFEST_SIZE, ZIP_SIZE, LONGEST_NAME = "manifest.json", 1 << 16, 1 << 26, 100
PART_SIZE = 1 << 20  # the flash of an STM32F405
VERSIONS = (1, 2)
TARGET, FIRMWARE = "stm32", "fw"
# Those of the STM32F405. cflib asks for cf2 in all its files; which robot it is for, the manifest says in `fw_platform`.
PLATFORMS = ("cf2", "cf21bl", "bolt", "tag", "flapper")
MAGIC = b"PK\x03\x04", b"PK\x05\x06"
DAMAGE = (
    zipfile.BadZipFile, zlib.error, lzma.LZMAError, NotImplementedError, RuntimeError, EOFError, OSError, ValueError,
    KeyError, RecursionError,
)  # fmt: skip


@dataclass(frozen=True, slots=True)
class ReleasedFirmware:
    """The STM32's firmware of a release."""

    content: bytes
    name: str  # its file's, in the zip
    note: str  # what was taken, and what was left


def is_release(path: Path, content: bytes) -> bool:
    """Return whether a file is a zip, by its content or its name."""
    return content.startswith(MAGIC) or path.suffix.lower() == ".zip"


def released_firmware(path: Path, content: bytes) -> ReleasedFirmware:
    """Return the firmware in a release's zip. Raises `LabError` with one line."""
    if len(content) > ZIP_SIZE:
        raise LabError(f"{path}: {len(content)} bytes: a release's zip has at most {ZIP_SIZE}")
    try:
        with zipfile.ZipFile(BytesIO(content)) as file:
            return _taken(path, file)
    except DAMAGE as error:
        raise LabError(f"{path}: damaged zip: {' '.join(str(error).split())[:200]}") from None


def _taken(path: Path, file: zipfile.ZipFile) -> ReleasedFirmware:
    manifest = _manifest(path, file)
    parts = {name: _part(path, name, part) for name, part in manifest["files"].items()}
    found = [name for name, (targets, kind) in parts.items() if TARGET in targets and kind == FIRMWARE]
    others = [
        f"{_shown(name)} ({'+'.join(targets)} {kind})"
        for name, (targets, kind) in parts.items()
        if name not in found
    ]
    if not found:
        raise LabError(
            f"{path}: no firmware for the STM32 in it: {', '.join(others) or 'its manifest lists no files'}"
        )
    if len(found) > 1:
        raise LabError(
            f"{path}: {len(found)} firmwares for the STM32 in it: {', '.join(map(_shown, found))}; unpack one"
        )
    (name,) = found
    part = manifest["files"][name]
    platform = manifest.get("fw_platform", part.get("platform"))
    for value in (platform, part.get("platform")):
        if value not in PLATFORMS:
            raise LabError(
                f"{path}: {name}: platform {_shown(value)}: expected {', '.join(PLATFORMS)}, whose processor is an STM32F405"
            )
    release = part.get("release", manifest.get("release", "unknown"))
    left = f"; left {', '.join(others)}" if others else ""
    note = f"{path}: took {name}, release {_shown(release)} for platform {platform}{left}"
    return ReleasedFirmware(_read(path, file, name, PART_SIZE), name, note)


def _manifest(path: Path, file: zipfile.ZipFile) -> dict[str, Any]:
    """Return the manifest, whose files are tables."""
    if MANIFEST not in file.namelist():
        raise LabError(
            f"{path}: no {MANIFEST} in it; expected a release's zip, firmware-PLATFORM-RELEASE.zip"
        )
    text = _read(path, file, MANIFEST, MANIFEST_SIZE)
    try:
        manifest = json.loads(text.decode(), object_pairs_hook=_without_doubles)
    except (ValueError, RecursionError) as error:
        raise LabError(f"{path}: {MANIFEST}: {' '.join(str(error).split())[:200]}") from None
    if not isinstance(manifest, dict):
        raise LabError(f"{path}: {MANIFEST}: expected a table")
    version, files = manifest.get("version"), manifest.get("files")
    if version not in VERSIONS:
        raise LabError(f"{path}: {MANIFEST}: version = {_shown(version)}: expected 1 or 2")
    if not isinstance(files, dict) or not all(isinstance(part, dict) for part in files.values()):
        raise LabError(f"{path}: {MANIFEST}: files: expected a table of tables")
    return manifest


def _without_doubles(pairs: Iterable[tuple[str, Any]]) -> dict[str, Any]:
    table: dict[str, Any] = {}
    for name, value in pairs:
        if name in table:
            raise ValueError(f"{_shown(name)} stands there twice")
        table[name] = value
    return table


def _part(path: Path, name: str, part: Mapping[str, Any]) -> tuple[list[str], str]:
    """Return targets and type of a file."""
    if (
        not name.isprintable()
        or "/" in name
        or "\\" in name
        or name.startswith(".")
        or len(name) > LONGEST_NAME
    ):
        raise LabError(f"{path}: {MANIFEST}: file {_shown(name)}: expected a plain name")
    target, kind = part.get("target"), part.get("type")
    listed = target if isinstance(target, list) else [target]
    targets = [one for one in listed if isinstance(one, str)]
    if len(targets) < max(len(listed), 1) or not isinstance(kind, str):
        raise LabError(f"{path}: {MANIFEST}: {name}: target and type: expected text")
    return targets, kind


def _read(path: Path, file: zipfile.ZipFile, name: str, size: int) -> bytes:
    """Return a file's content; refuse one that is larger than `size`, whatever its header says."""
    there = file.namelist().count(name)
    if there != 1:
        raise LabError(f"{path}: {name} is in it {there} times: expected once")
    with file.open(name) as part:
        content = part.read(size + 1)
        if len(content) > size:
            raise LabError(f"{path}: {name}: larger than {size} bytes")
    return content


def _shown(value: object) -> str:
    """Return a value of a manifest in a line."""
    return (
        value
        if isinstance(value, str) and value.isprintable() and len(value) < LONGEST_NAME
        else repr(value)[:LONGEST_NAME]
    )
