"""The layouts of `firmware_py.wire.core_port` as a C header, so that board and host read the same bytes."""

from enum import IntEnum

from firmware_py.wire import core_port
from firmware_py.wire.core_port import LAYOUTS, Call, Hil, Kind, Layout, Refusal

C_TYPES = {"B": "uint8_t", "b": "int8_t", "H": "uint16_t", "h": "int16_t", "I": "uint32_t"}


def wire_header() -> str:
    constants = (
        "PORT_CORE",
        "CHANNEL_CALLS",
        "CHANNEL_LOOP",
        "HIL_WAITING",
        "HIL_HOLD",
        "NARROW",
        "WIDE",
        "NARROW_BITS",
        "VERSION",
        "NAME_SIZE",
        "READ_MAX",
    )
    return "\n\n".join((
        "/* The packets of the core's port, as in firmware_py/wire/core_port.py. Written by `floaty deploy`. */\n"
        "#pragma once\n\n#include <stdint.h>",
        "\n".join(f"#define FLOATY_{name} {getattr(core_port, name)}" for name in constants),
        *(_enumeration(kind) for kind in (Kind, Refusal, Call, Hil)),
        f"#define FLOATY_CALLS {len(Call)}",
        *(_struct(layout) for layout in LAYOUTS),
    )) + "\n"  # fmt: skip


def _enumeration(kind: type[IntEnum]) -> str:
    prefix = f"FLOATY_{kind.__name__.upper()}_"
    return "\n".join(("enum {", *(f"  {prefix}{one.name} = {one.value}," for one in kind), "};"))


def _struct(layout: Layout) -> str:
    lines = [f"  {_member(name, code)};" for name, code in layout.fields]
    return "\n".join(("typedef struct {", *lines, f"}} __attribute__((packed)) FloatyWire{layout.name};"))


def _member(name: str, code: str) -> str:
    return f"char {name}[{code[:-1]}]" if code.endswith("s") else f"{C_TYPES[code]} {name}"
