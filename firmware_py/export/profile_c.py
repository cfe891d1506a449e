"""A profile's parameters as C: `floaty_core_init`, which writes the values that the emulator flies with."""

import hashlib

import numpy as np

from firmware_py.config import FirmwareConfig, parameters_of
from firmware_py.core.structs import Parameters
from firmware_py.export.app_logic import own_bytes, own_memory
from firmware_py.export.literals import literal

TEMPLATE = """\
/* The parameters of a profile. Written by `floaty deploy`; edit the profile, not this file. */
#include "floaty_core.h"

const char floaty_profile_hash[] = "{hash}";

void floaty_core_init(FloatyParameters *parameters) {{
{lines}
}}
"""


def profile_hash(config: FirmwareConfig) -> str:
    """Return a short hash of the parameters' bytes, as they lie in memory on board."""
    return hashlib.sha256(parameters_of(config).bytes() + own_bytes(config.logic)).hexdigest()[:12]


def profile_source(config: FirmwareConfig) -> str:
    """Return the C file that writes a configuration's parameters; every value has the emulator's bits."""
    memory = parameters_of(config).memory
    names = Parameters.dtype.names
    assert names is not None
    lines = []
    for name in names:
        values = memory[name][0]
        if np.ndim(values) == 0:
            lines.append(f"    parameters->{name} = {literal(values)};")
        else:
            lines += [f"    parameters->{name}[{i}] = {literal(value)};" for i, value in enumerate(values)]
    return TEMPLATE.format(hash=profile_hash(config), lines="\n".join(lines)) + own_memory(config.logic)
