"""The layouts of `firmware_py.wire.core_port` and other facts of the wire as a C header: board and host have one source."""

from enum import IntEnum

from firmware_py.wire import core_port, crtp, localisation
from firmware_py.wire.core_port import HEALTH, LAYOUTS, LOOP, Call, Hil, Message, PacketLayout, Refusal
from firmware_py.wire.supervisor import Cause, State

C_TYPES = {
    "B": "uint8_t",
    "?": "uint8_t",
    "b": "int8_t",
    "H": "uint16_t",
    "h": "int16_t",
    "I": "uint32_t",
    "i": "int32_t",
}

OF_CORE = {  # fields of layouts that show the core's memory
    "state": "supervisor.state", "cause": "supervisor.cause", "calibrated": "sampling.calibrated",
    "fused": "estimator.fused", "refused": "estimator.refused", "age": "report.age",
    **{f"m{servo + 1}": f"control.count[{servo}]" for servo in range(4)},
}  # fmt: skip


def wire_header() -> str:
    constants = (
        "CHANNEL_GENERIC", "EXT_POSE", "EXT_POSE_PACKED", "AGE_UNIT_US", "AGE_UNKNOWN_CODE", "EMERGENCY_STOP",
        "EMERGENCY_STOP_WATCHDOG",
        "PORT_CORE", "CHANNEL_CALLS", "CHANNEL_LOOP", "HIL_WAITING", "HIL_HOLD", "NARROW", "WIDE", "NARROW_BITS",
        "VERSION", "NAME_SIZE", "READ_MAX",
    )  # fmt: skip
    facts = vars(localisation) | vars(crtp) | vars(core_port)
    return "\n\n".join((
        "/* The packets of the core's port, as in firmware_py/wire/core_port.py. Written by `floaty deploy`. */\n"
        "#pragma once\n\n#include <stdint.h>",
        "\n".join(f"#define FLOATY_{name} {facts[name]}" for name in constants),
        f"#define FLOATY_STATE_TEXTS {_texts('', *State)}",
        f"#define FLOATY_CAUSE_TEXTS {_texts(', ', *Cause)}",
        *(f"#define FLOATY_{one.name.upper()}_OF_CORE {_of_core(one)}" for one in (HEALTH, LOOP)),
        *(_enumeration(kind) for kind in (Message, Refusal, Call, Hil)),
        f"#define FLOATY_CALLS {len(Call)}",
        *(_struct(layout) for layout in LAYOUTS),
    )) + "\n"  # fmt: skip


def _enumeration(kind: type[IntEnum]) -> str:
    prefix = f"FLOATY_{kind.__name__.upper()}_"
    return "\n".join(("enum {", *(f"  {prefix}{one.name} = {one.value}," for one in kind), "};"))


def _texts(before: str, *values: State | Cause) -> str:
    """Return the initialiser of the console's words for states or causes, empty for no cause."""
    words = (before + one.name.lower().replace("_", " ") if one is not Cause.NONE else "" for one in values)
    listed = ", ".join(f'"{word}"' for word in words)
    return f"{{{listed}}}"


def _of_core(layout: PacketLayout) -> str:
    """Return the initialisers of the fields that the core's memory has."""
    codes = ((name, code) for name, code in layout.fields if name in OF_CORE)
    return ", ".join(f".{name} = ({C_TYPES[code]})floaty_{OF_CORE[name]}" for name, code in codes)


def _struct(layout: PacketLayout) -> str:
    lines = [f"  {_member(name, code)};" for name, code in layout.fields]
    return "\n".join(("typedef struct {", *lines, f"}} __attribute__((packed)) FloatyWire{layout.name};"))


def _member(name: str, code: str) -> str:
    return f"char {name}[{code[:-1]}]" if code.endswith("s") else f"{C_TYPES[code]} {name}"
