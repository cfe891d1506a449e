"""Where the tests' own files lie."""

from pathlib import Path

SUPPORT = Path(__file__).parent
TESTS = SUPPORT.parent
ROOT = TESTS.parent
VECTORS = TESTS / "vectors"
STUBS = TESTS / "stubs"
