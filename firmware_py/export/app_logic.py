"""The user's own logic in the exported app: memory, and the app's calls into the core.

The default core has none; then only the calls remain.
"""

from collections.abc import Iterable, Mapping
from math import isfinite
from typing import Any

import numpy as np

from firmware_py.config import LogicConfig
from firmware_py.export.literals import literal
from firmware_py.logic.entry import own_blocks
from firmware_py.logic.loading import Logic, load_logic, sensed_by
from firmware_py.logic.plugs import ANSWERING, BLOCKS, CALLS, OWN, SENSED

CALLS_HEADER = """\
/* How the app enters the core: every call with the memory that it takes. Written by `floaty deploy`. */
#pragma once

#include "floaty_app.h"
#include "floaty_wire.h"

{memory}
{calls}
/* Let own logic see what the robot's own sensors measure: own_sensors.c. */
{prototypes}static inline void call_sense(void) {{
{sense}}}

/* The counts of the hover angles, on memory of its own: for any task. */
static inline void call_hover(FloatyControl *control) {{
  static const FloatyInput input; /* mode 0 */
{scratch}  floaty_core_control({hover});
}}

/* The memory of a core that does not fly. */
typedef struct {{
{members}}} FloatyMemory;

static inline int32_t call_on(FloatyMemory *on, uint8_t entry) {{
  switch (entry) {{
{on}    default: return 0;
  }}
}}
"""
CALL = """\
static inline {result} call_{name}(void) {{
  {returns}floaty_core_{name}({arguments});
}}
"""
SENSORS = """\
/* Reads the robot's own sensors, before each control step, 100 times a second. This file is yours: it is written once. A
 * field stays as it is until you set it, NAN at the start; set it to NAN when there is no sample. Do not
 * wait for a sensor here: a step takes at most 10 ms. Read slow sensors in a separate task. */
#include <math.h>

#include "floaty_calls.h"
{functions}"""
SENSE = """
void floaty_sense_{name}({kind} *sensed) {{
  /* sensed->{field} = ..; */
  (void)sensed;
}}
"""
CORE_TYPES = {name: f"Floaty{struct}" for name, struct in BLOCKS.items()}


def own_types(logic: Logic | None) -> dict[str, str]:
    """Return the C types of the blocks that own logic adds to the core's, by name."""
    blocks = own_blocks(logic.loaded.plugs) if logic else {}
    return {name: f"Floaty{struct}" for name, struct in blocks.items()}


def sensed_types(logic: Logic | None) -> dict[str, str]:
    """Return the C types of the blocks with what own logic reads of the robot's own sensors, by name."""
    return {name: kind for name, kind in own_types(logic).items() if name.endswith(f"_{SENSED}")}


def sensors_source(config: LogicConfig) -> str:
    """Return the C file in which the user reads sensors; empty when own logic has none."""
    logic = load_logic(config)
    fields = {field.block: field.name for field in sensed_by(logic)}
    functions = (
        SENSE.format(name=_point(name), kind=kind, field=fields[name])
        for name, kind in sensed_types(logic).items()
    )
    return SENSORS.format(functions="".join(functions)) if fields else ""


def _point(block: str) -> str:
    return block.removesuffix(f"_{SENSED}")


def calls_header(config: LogicConfig) -> str:
    """Return the header with the app's calls into the core."""
    logic = load_logic(config)
    types = own_types(logic)
    places = {"data": "&floaty_input"} | {
        name: f"&floaty_{name}" for name in (*BLOCKS, *types) if name != "data"
    }
    sensed = sensed_types(logic)
    calls = CALLS if logic is None else logic.loaded.calls
    scratch = [name for name in calls["control"] if name in types and not name.endswith(f"_{OWN}")]
    alone = places | {"data": "&input", "control": "control"} | {name: f"&{name}" for name in scratch}
    return CALLS_HEADER.format(
        memory="".join(f"extern {kind} floaty_{name};\n" for name, kind in types.items()),
        prototypes="".join(
            f"void floaty_sense_{_point(name)}({kind} *sensed);\n\n" for name, kind in sensed.items()
        ),
        sense="".join(f"  floaty_sense_{_point(name)}(&floaty_{name});\n" for name in sensed),
        scratch="".join(f"  static {types[name]} {name};\n" for name in scratch),
        hover=_listed(calls["control"], alone),
        members="".join(f"  {kind} {name};\n" for name, kind in {**CORE_TYPES, **types}.items()),
        calls="\n".join(_call(name, _listed(taken, places)) for name, taken in calls.items()),
        on="".join(_call_on(name, taken) for name, taken in calls.items()),
    )


def _call(name: str, arguments: str) -> str:
    result, returns = ("int32_t", "return ") if name in ANSWERING else ("void", "")
    return CALL.format(name=name, result=result, returns=returns, arguments=arguments)


def _call_on(name: str, taken: Iterable[str]) -> str:
    """Return the case of an entry point on memory that does not fly."""
    call = f"floaty_core_{name}({', '.join(f'&on->{block}' for block in taken)});"
    case = f"    case FLOATY_CALL_{name.upper()}: "
    return f"{case}return {call}\n" if name in ANSWERING else f"{case}{call} return 0;\n"


def own_memory(config: LogicConfig) -> str:
    """Return the definitions of the memory, with the profile's values of the parameters; empty for the default core."""
    logic = load_logic(config)
    if logic is None:
        return ""
    lines = []
    blocks = logic.allocate()
    for name, kind in own_types(logic).items():
        if not name.endswith((f"_{OWN}", f"_{SENSED}")):
            lines.append(f"{kind} floaty_{name};")
            continue
        memory = blocks[name].memory
        values = [f"    .{field} = {_initial(memory[field][0])}," for field in memory.dtype.names or ()]
        lines.append("\n".join((f"{kind} floaty_{name} = {{", *values, "};")))
    return "\n/* What own logic needs. */\n" + "\n".join(lines) + "\n"


def _initial(value: Any) -> str:
    """Return the initialiser of a parameter; of sensors, which have no sample yet."""
    numbers = [
        literal(number) if isfinite(number) else '__builtin_nanf("")' for number in np.atleast_1d(value)
    ]
    return numbers[0] if np.ndim(value) == 0 else f"{{{', '.join(numbers)}}}"


def own_bytes(config: LogicConfig) -> bytes:
    """Return the bytes of the parameters, as they lie in memory on board."""
    logic = load_logic(config)
    blocks = {} if logic is None else logic.allocate()
    return b"".join(block.bytes() for name, block in blocks.items() if name.endswith(f"_{OWN}"))


def _listed(names: Iterable[str], places: Mapping[str, str]) -> str:
    return ", ".join(places[name] for name in names)
