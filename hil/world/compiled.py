"""The decorator of the plant's compiled functions."""

from pathlib import Path

from firmware_py import compiling, elementary

compiled = compiling.compiler(Path(__file__).parent, Path(elementary.__file__))
