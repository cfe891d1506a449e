"""The decorator of the kernel's functions: they depend on this package and on the subset."""

from pathlib import Path

from firmware_py import compiling
from firmware_py.core import subset

compiled = compiling.compiler(Path(__file__).parent, Path(subset.__file__))
