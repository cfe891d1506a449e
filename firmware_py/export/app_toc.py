"""The app's tables of contents in C: the table of variables, with the values of a profile.

A client writes a variable of that file; a value inside the limits is passed to the core, any other is put back.
Names that the Crazyflie firmware already has are left out; Floaty's own are then in the group `floaty` or `FloatyKalm`.
"""

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, fields

from firmware_py.config import FirmwareConfig
from firmware_py.export.app_wire import C_TYPES
from firmware_py.export.literals import float_literal
from firmware_py.logic.loading import load_logic
from firmware_py.table import CORE_PARAMETERS, CORE_VARIABLES, CoreParameter, Place, value_in
from firmware_py.wire.parameters import ABSOLUTE
from firmware_py.wire.scalars import Scalar

TYPES = {"f": "float"} | C_TYPES  # by the code of a `Scalar`
OBSERVED = (  # counted by the app itself
    ("floaty.malformed", Scalar.U32, "floaty_observed.malformed"),
    ("floaty.overflows", Scalar.U32, "floaty_observed.overflows"),
    ("floaty.staleHovers", Scalar.U32, "floaty_observed.stale_hovers"),
)


@dataclass(frozen=True, slots=True, kw_only=True)
class AppParameter(CoreParameter):
    """A parameter in the app: `target` is its scale times the value that a client sees."""

    target: str  # in C
    initial: float  # as the client sees it


TEMPLATE = r"""
/* Parameters and log variables of the board. Written by `floaty deploy`; their fields declare them. */
#define DEBUG_MODULE "FLOATY"

#include "floaty_calls.h"

#include <stdbool.h>

#include "debug.h"
#include "log.h"
#include "param.h"

#include "floaty_settings.h"

typedef enum { KIND_F32, KIND_I32, KIND_U16, KIND_I16, KIND_U8 } Kind;

typedef struct {
  const char *name;
  void *seen;      /* what clients read and write */
  void *memory;    /* the core's field: memory = scale * seen */
  float scale;
  float low, high; /* inclusive, of `seen` */
  float initial;   /* of `seen`: from the profile */
  uint8_t seen_kind, memory_kind;
} Parameter;

@seen

static const Parameter PARAMETERS[] = {
@parameters
};

#define COUNT (sizeof PARAMETERS / sizeof PARAMETERS[0])

static float in_force[COUNT]; /* of `seen`, as last applied */
static bool stored[COUNT];    /* the EEPROM had another value than the profile */
static bool other[COUNT];     /* floaty_profile.c had, which is of another profile than this file */

static float get(const void *variable, uint8_t kind) {
  switch (kind) {
    case KIND_F32: return *(const float *)variable;
    case KIND_I32: return (float)*(const int32_t *)variable;
    case KIND_U16: return (float)*(const uint16_t *)variable;
    case KIND_I16: return (float)*(const int16_t *)variable;
    default: return (float)*(const uint8_t *)variable;
  }
}

static void put(void *variable, uint8_t kind, float value) {
  switch (kind) {
    case KIND_F32: *(float *)variable = value; break;
    case KIND_I32: *(int32_t *)variable = (int32_t)value; break;
    case KIND_U16: *(uint16_t *)variable = (uint16_t)value; break;
    case KIND_I16: *(int16_t *)variable = (int16_t)value; break;
    default: *(uint8_t *)variable = (uint8_t)value; break;
  }
}

/* In the task that writes parameters. Two names may stand for the same memory: the one that changed wins. */
void floaty_toc_apply(void) {
  static bool started;
  for (unsigned i = 0; i < COUNT; i++) {
    const Parameter *p = &PARAMETERS[i];
    const float value = get(p->seen, p->seen_kind);
    if (!started) {
      in_force[i] = p->initial;
      stored[i] = value != p->initial;
      other[i] = get(p->memory, p->memory_kind) / p->scale != p->initial;
    }
    if (value == in_force[i]) {
      continue;
    }
    if (value >= p->low && value <= p->high) {
      put(p->memory, p->memory_kind, p->scale * value);
    } else {
      DEBUG_PRINT("%s refused: outside its limits\n", p->name);
    }
  }
  started = true;
  for (unsigned i = 0; i < COUNT; i++) {
    const Parameter *p = &PARAMETERS[i];
    put(p->seen, p->seen_kind, get(p->memory, p->memory_kind) / p->scale);
    in_force[i] = get(p->seen, p->seen_kind);
  }
}

static void name_those(const bool which[COUNT], const char *what) {
  int different = 0;
  for (unsigned i = 0; i < COUNT; i++) {
    different += which[i] && in_force[i] != PARAMETERS[i].initial;
  }
  if (different == 0) {
    return;
  }
  DEBUG_PRINT("%d parameters %s, not from profile %s:", different, what, FLOATY_PROFILE_NAME);
  for (unsigned i = 0; i < COUNT; i++) {
    if (which[i] && in_force[i] != PARAMETERS[i].initial) {
      eprintf(consolePutchar, " %s", PARAMETERS[i].name);
    }
  }
  eprintf(consolePutchar, "\n");
}

void floaty_toc_report(void) {
  name_those(stored, "from the EEPROM");
  name_those(other, "from floaty_profile.c");
}

static uint8_t stop_wanted, armed_wanted = 1, reset_wanted;

/* Hands a switch on as one of two requests; what is neither 0 nor 1 is put back. */
static void switch_written(uint8_t *wanted, uint8_t *before, volatile bool *on, volatile bool *off) {
  if (*wanted > 1) {
    *wanted = *before;
    return;
  }
  *before = *wanted;
  *(*wanted ? on : off) = true;
}

static void stop_written(void) {
  static uint8_t before;
  switch_written(&stop_wanted, &before, &floaty_requests[FLOATY_REQUEST_STOP],
                 &floaty_requests[FLOATY_REQUEST_RECOVER]);
}

static void armed_written(void) {
  static uint8_t before = 1;
  switch_written(&armed_wanted, &before, &floaty_requests[FLOATY_REQUEST_ARM],
                 &floaty_requests[FLOATY_REQUEST_DISARM]);
}

static void reset_written(void) {
  if (reset_wanted) {
    floaty_requests[FLOATY_RESET] = true;
  }
  reset_wanted = 0;
}

PARAM_GROUP_START(floaty)
/* 1: emergency stop. 0: leave it. */
PARAM_ADD_WITH_CALLBACK(PARAM_UINT8, stop, &stop_wanted, stop_written)
/* 0: flaps to hover until 1 is written. */
PARAM_ADD_WITH_CALLBACK(PARAM_UINT8, armed, &armed_wanted, armed_written)
/* 1: start the estimator afresh. */
PARAM_ADD_WITH_CALLBACK(PARAM_UINT8, reset, &reset_wanted, reset_written)
PARAM_GROUP_STOP(floaty)

@groups
"""


def app_parameters(config: FirmwareConfig) -> tuple[AppParameter, ...]:
    """Return the parameters of the app with a profile's values, without names of the Crazyflie firmware."""
    logic = load_logic(config.logic)
    own = (
        {} if logic is None else {one.name: logic.values[one.place.field] for one in logic.loaded.parameters}
    )
    parameters = (*CORE_PARAMETERS, *(() if logic is None else logic.loaded.parameters))
    found = []
    for one in parameters:
        if one.name == ABSOLUTE:
            initial = 1.0  # as Bitcraze's programs send poses
        elif one.name in own:
            initial = own[one.name]
        else:
            initial = value_in(config, one.key) / one.scale if one.key else 0.0
        if not one.stock:
            declared = {field.name: getattr(one, field.name) for field in fields(one)}
            found.append(AppParameter(**declared, target=_in_c(one.place), initial=initial))
    return tuple(found)


def toc_source(config: FirmwareConfig) -> str:
    logic = load_logic(config.logic)
    table = app_parameters(config)
    variables = (*CORE_VARIABLES, *(() if logic is None else logic.loaded.variables))
    logged = [(one.name, one.scalar, _in_c(one.place)) for one in variables if not one.stock]
    params = [(one.name, _added(one)) for one in table]
    logs = [(name, f"LOG_ADD(LOG_{_macro(scalar)}, NAME, &{c})") for name, scalar, c in (*logged, *OBSERVED)]
    groups = (*_groups("PARAM", params), *_groups("LOG", logs))
    parts = {
        "@seen": "\n".join(map(_variable, table)),
        "@parameters": "\n".join(map(_row, table)),
        "@groups": "\n\n".join(groups),
    }
    text = TEMPLATE.lstrip()
    for marker, part in parts.items():
        text = text.replace(marker, part)
    return text


def _in_c(place: Place) -> str:
    """Return the C expression of a variable in the app."""
    block = {"data": "input"}.get(place.block, place.block)
    return f"floaty_{block}.{place.field}" + "".join(f"[{number}]" for number in place.index)


def _row(parameter: AppParameter) -> str:
    """Return a parameter as a row of the table in C."""
    cells = (
        f'"{parameter.name}"', f"&{_seen(parameter)}", f"&{parameter.target}",
        *map(float_literal, (parameter.scale, parameter.low, parameter.high, parameter.initial)),
        f"KIND_{parameter.scalar.name}", f"KIND_{parameter.place.scalar.name}",
    )  # fmt: skip
    return f"  {{{', '.join(cells)}}},"


def _variable(parameter: AppParameter) -> str:
    """Return the definition of the variable that clients read and write."""
    initial = float_literal(parameter.initial) if parameter.scalar.is_float else str(int(parameter.initial))
    return f"static {TYPES[parameter.scalar.format]} {_seen(parameter)} = {initial};"


def _seen(parameter: CoreParameter) -> str:
    """Return the variable that clients read and write."""
    return f"seen_{parameter.name.replace('.', '_')}"


def _added(parameter: CoreParameter) -> str:
    flags = f"PARAM_{_macro(parameter.scalar)}" + (" | PARAM_PERSISTENT" if parameter.persistent else "")
    return f"PARAM_ADD_WITH_CALLBACK({flags}, NAME, &{_seen(parameter)}, floaty_toc_apply)"


def _groups(kind: str, lines: Iterable[tuple[str, str]]) -> Iterator[str]:
    """Yield the groups of a table of contents; `lines` by whole name, with NAME for its end."""
    groups: dict[str, list[str]] = {}
    for whole, line in lines:
        group, name = whole.split(".")
        groups.setdefault(group, []).append(line.replace("NAME", name, 1))
    for group, added in groups.items():
        yield "\n".join((f"{kind}_GROUP_START({group})", *added, f"{kind}_GROUP_STOP({group})"))


def _macro(scalar: Scalar) -> str:
    """Return what the firmware's macros call a type."""
    return TYPES[scalar.format].removesuffix("_t").upper()
