"""Judges what came out now by what was approved, where the libraries that shape it are those of then."""

from importlib.metadata import PackageNotFoundError, version

import pytest


def versions(*packages: str) -> str:
    """Return the versions of packages, a dash for one that is missing."""
    found = []
    for name in packages:
        try:
            found.append(f"{name} {version(name)}")
        except PackageNotFoundError:
            found.append(f"{name} -")
    return ", ".join(found)


def skip_unless(made_with: str, here: str) -> None:
    """Skip the test, whose outputs differ, if they were approved with other versions."""
    if made_with != here:
        pytest.skip(f"differs, but was approved with {made_with}; here are {here}")
