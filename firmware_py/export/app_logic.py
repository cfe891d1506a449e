"""The user's own logic in the exported app: memory, parameters, log variables, and how the app enters the core.

The default core has none; then only the calls remain.
"""

from collections.abc import Iterable, Mapping

from firmware_py.config import LogicConfig
from firmware_py.export.reading import literal
from firmware_py.logic.loading import Logic, load_logic
from firmware_py.logic.plugs import CALLS, CORE_STRUCTS, GROUP, OWN

CALLS_HEADER = """\
/* How the app enters the core: every call with the memory that it takes. Written by `floaty deploy`. */
#pragma once

#include "floaty_app.h"
#include "floaty_wire.h"

{memory}
static inline void call_reset(void) {{
  floaty_core_reset({reset});
}}

static inline int32_t call_file_pose(void) {{
  return floaty_core_file_pose({file_pose});
}}

static inline void call_estimate(void) {{
  floaty_core_estimate({estimate});
}}

static inline void call_control(void) {{
  floaty_core_control({control});
}}

/* The counts of the hover angles, on memory of its own: for any task. */
static inline void call_hover(FloatyControl *control) {{
  static const FloatyInput input; /* mode 0 */
{scratch}  floaty_core_control({hover});
}}

/* Reports to the supervisor whether own logic has returned NaN or infinity. */
static inline void call_guard(void) {{
{guard}}}

/* The memory of a core that does not fly. */
typedef struct {{
{members}}} FloatyMemory;

static inline int32_t call_on(FloatyMemory *on, uint8_t entry) {{
  switch (entry) {{
    case FLOATY_CALL_RESET: floaty_core_reset({on_reset}); return 0;
    case FLOATY_CALL_FILE_POSE: return floaty_core_file_pose({on_file_pose});
    case FLOATY_CALL_ESTIMATE: floaty_core_estimate({on_estimate}); return 0;
    default: floaty_core_control({on_control}); return 0;
  }}
}}
"""
CORE_TYPES = {name: f"Floaty{struct}" for name, struct in CORE_STRUCTS.items()}
LOG_TYPES = {"f32": "LOG_FLOAT", "i32": "LOG_INT32"}


def own_types(logic: Logic | None) -> dict[str, str]:
    """Return the C types of the blocks that own logic adds to the core's, by name."""
    if logic is None:
        return {}
    types = {"guard": "FloatyGuard"}
    for plug in logic.loaded.plugs:
        types |= {plug.block(argument): f"Floaty{struct.name}" for argument, struct in plug.structs.items()}
    return types


def calls_header(config: LogicConfig) -> str:
    """Return the header by which the app enters the core."""
    logic = load_logic(config)
    types = own_types(logic)
    places = {"data": "&floaty_input"} | {
        name: f"&floaty_{name}" for name in (*CORE_STRUCTS, *types) if name != "data"
    }
    calls = CALLS if logic is None else logic.loaded.calls
    scratch = [name for name in calls["control"] if name in types and not name.endswith(f"_{OWN}")]
    alone = places | {"data": "&input", "control": "control"} | {name: f"&{name}" for name in scratch}
    guard = (
        "  floaty_supervisor_see_logic(&floaty_supervisor, floaty_guard.controller_faults, "
        "floaty_guard.estimator_faults);\n"
    )
    return CALLS_HEADER.format(
        memory="".join(f"extern {kind} floaty_{name};\n" for name, kind in types.items()),
        scratch="".join(f"  static {types[name]} {name};\n" for name in scratch),
        hover=_listed(calls["control"], alone),
        guard=guard if types else "",
        members="".join(f"  {kind} {name};\n" for name, kind in {**CORE_TYPES, **types}.items()),
        **{call: _listed(names, places) for call, names in calls.items()},
        **{f"on_{call}": ", ".join(f"&on->{name}" for name in names) for call, names in calls.items()},
    )


def own_memory(config: LogicConfig) -> str:
    """Return the definitions of the memory, with the profile's values of the parameters; empty for the default core."""
    logic = load_logic(config)
    if logic is None:
        return ""
    lines = []
    blocks = logic.allocate()
    for name, kind in own_types(logic).items():
        if not name.endswith(f"_{OWN}"):
            lines.append(f"{kind} floaty_{name};")
            continue
        memory = blocks[name].memory
        values = [f"    .{field} = {literal(memory[field][0])}," for field in memory.dtype.names or ()]
        lines.append("\n".join((f"{kind} floaty_{name} = {{", *values, "};")))
    return "\n/* What own logic needs. */\n" + "\n".join(lines) + "\n"


def own_bytes(config: LogicConfig) -> bytes:
    """Return the bytes of the parameters, as they lie in memory on board."""
    logic = load_logic(config)
    blocks = {} if logic is None else logic.allocate()
    return b"".join(block.bytes() for name, block in blocks.items() if name.endswith(f"_{OWN}"))


def own_logs(config: LogicConfig) -> str:
    """Return the group of log variables; empty when nothing is logged."""
    logic = load_logic(config)
    variables = () if logic is None else logic.loaded.variables
    lines = [
        f"LOG_ADD({LOG_TYPES[one.base]}, {one.name}, &floaty_{one.block}.{one.field}"
        + ("" if one.index is None else f"[{one.index}]")
        + ")"
        for one in variables
    ]
    return "\n".join((f"LOG_GROUP_START({GROUP})", *lines, f"LOG_GROUP_STOP({GROUP})")) if lines else ""


def _listed(names: Iterable[str], places: Mapping[str, str]) -> str:
    return ", ".join(places[name] for name in names)
