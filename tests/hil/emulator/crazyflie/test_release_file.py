"""A release's zip gives the STM32's firmware, and says what it took; anything else is refused in one line."""

import json
import zipfile
from collections.abc import Mapping
from contextlib import nullcontext, suppress
from io import BytesIO
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from hil.emulator.crazyflie.release_file import is_release, released_firmware
from hil.errors import LabError

PATH = Path("firmware-cf2-2025.09.zip")
STM32 = {"platform": "cf2", "target": "stm32", "type": "fw", "release": "2025.09"}
NRF51 = {"platform": "cf2", "target": "nrf51", "type": "fw", "release": "2024.2", "requires": ["sd-s130"]}
DECK = {"platform": "deck", "target": ["bcAI:esp", "bcAI:gap8"], "type": "fw", "release": "2024.1"}
FILES = {"cf2_nrf.bin": NRF51, "cf2.bin": STM32, "aideck.bin": DECK}
CODE = bytes(range(256)) * 40


def zipped(manifest: Any, contents: Mapping[str, bytes]) -> bytes:
    """Return a release's zip; a manifest that is no text is written as JSON."""
    with zipfile.ZipFile(buffer := BytesIO(), "w", zipfile.ZIP_DEFLATED) as file:
        file.writestr("manifest.json", manifest if isinstance(manifest, str) else json.dumps(manifest))
        for name, content in contents.items():
            file.writestr(name, content)
    return buffer.getvalue()


def release(version: Any = 2, files: Any = FILES, **more: Any) -> bytes:
    contents = dict.fromkeys(files, CODE) if isinstance(files, dict) else {}
    return zipped({"version": version, "files": files, **more}, contents)


@pytest.mark.parametrize("version", [1, 2])
def test_the_firmware_of_the_stm32_is_taken_and_the_rest_is_named(version: int) -> None:
    content = release(version, fw_platform="cf2", release="2025.09")
    assert is_release(PATH, content)
    found = released_firmware(PATH, content)
    assert (found.content, found.name) == (CODE, "cf2.bin")
    assert found.note == (
        f"{PATH}: took cf2.bin, release 2025.09 for platform cf2; left cf2_nrf.bin (nrf51 fw), "
        "aideck.bin (bcAI:esp+bcAI:gap8 fw)"
    )


@pytest.mark.parametrize(("name_size", "size", "fits"), [(100, 1 << 20, True), (100, 1 + (1 << 20), False),
                                                         (101, 1, False)])  # fmt: skip
def test_a_firmware_may_fill_the_flash_and_its_name_a_line(name_size: int, size: int, fits: bool) -> None:
    name = "cf2.bin".rjust(name_size, "x")
    content = zipped({"version": 2, "files": {name: STM32}}, {name: bytes(size)})
    with nullcontext() if fits else pytest.raises(LabError):
        assert released_firmware(PATH, content).content == bytes(size)


def test_a_zip_is_known_by_content_or_name() -> None:
    assert is_release(Path("firmware"), release())
    assert is_release(Path("firmware.ZIP"), b"")
    assert not is_release(Path("cf2.bin"), b"\x00\x00\x02\x20")


def with_wrong_sum() -> bytes:
    content = bytearray(zipped({"version": 2, "files": {"cf2.bin": STM32}}, {"cf2.bin": CODE}))
    content[content.index(b"cf2.bin") + 20] ^= 0xFF  # in its compressed data
    return bytes(content)


def doubled() -> bytes:
    """A zip with two files of one name: the second was written as another one."""
    content = zipped({"version": 2, "files": {"cf2.bin": STM32}}, {"cf2.bin": CODE, "cf3.bin": CODE[::-1]})
    return content.replace(b"cf3.bin", b"cf2.bin")


@pytest.mark.parametrize(
    ("content", "expected"),
    [
        (b"", "damaged zip"),
        (release()[:-30], "damaged zip"),
        (with_wrong_sum(), "damaged zip"),
        (zipped({"version": 2, "files": FILES}, {}), "cf2.bin is in it 0 times: expected once"),
        (doubled(), "cf2.bin is in it 2 times: expected once"),
        (zipped("{", {}), "manifest.json: Expecting property name"),
        (zipped("[" * 30_000, {}), "manifest.json: "),
        (zipped(" " * 70_000, {}), "manifest.json: larger than 65536 bytes"),
        (zipped('{"version": 2, "version": 1}', {}), "manifest.json: version stands there twice"),
        (zipped([], {}), "manifest.json: expected a table"),
        (release(3), "manifest.json: version = 3: expected 1 or 2"),
        (release("2"), "manifest.json: version = 2: expected 1 or 2"),
        (release(2, ["cf2.bin"]), "manifest.json: files: expected a table of tables"),
        (release(2, {"cf2.bin": {"target": 7, "type": "fw"}}), "cf2.bin: target and type: expected text"),
        (release(2, {"../cf2.bin": STM32}), "file ../cf2.bin: expected a plain name"),
        (release(2, {"/etc/cf2.bin": STM32}), "file /etc/cf2.bin: expected a plain name"),
        (release(2, {}), "no firmware for the STM32 in it: its manifest lists no files"),
        (release(2, {"nrf.bin": NRF51}), "no firmware for the STM32 in it: nrf.bin (nrf51 fw)"),
        (release(2, {"a.bin": STM32, "b.bin": STM32}), "2 firmwares for the STM32 in it: a.bin, b.bin; unpack one"),
        (release(2, {"a.bin": {**STM32, "platform": "cf1"}}), "a.bin: platform cf1: expected cf2, cf21bl, bolt"),
        (release(fw_platform="ai"), "cf2.bin: platform ai: expected cf2"),
        (zipped({"version": 2, "files": FILES}, {"cf2.bin": bytes(50 << 20)}), "cf2.bin: larger than 1048576 bytes"),
    ],
)  # fmt: skip
def test_another_zip_is_refused_in_one_line(content: bytes, expected: str) -> None:
    with pytest.raises(LabError) as caught:
        released_firmware(PATH, content)
    assert str(caught.value).startswith(f"{PATH}: ")
    assert expected in str(caught.value)
    assert "\n" not in str(caught.value)


@pytest.mark.long
@settings(max_examples=200)
@given(damage=st.lists(st.tuples(st.integers(0, 2000), st.integers(0, 255)), min_size=1, max_size=4))
def test_a_damaged_zip_is_read_or_refused(damage: list[tuple[int, int]]) -> None:
    content = bytearray(release())
    for place, byte in damage:
        content[place % len(content)] = byte
    with suppress(LabError):
        assert released_firmware(PATH, bytes(content)).content == CODE
