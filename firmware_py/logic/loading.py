"""From the profile's `[logic]` to code that flies: the modules are read, checked, joined with the core and translated."""

import builtins
import difflib
import hashlib
import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache
from math import nan
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any

from firmware_py.config import LogicConfig
from firmware_py.core.budget import CALL_CYCLES
from firmware_py.core.subset import Block, Sensed, Struct
from firmware_py.errors import LogicError
from firmware_py.export.c99 import Translation, check, core_texts, translate
from firmware_py.export.errors import ExportError, RefusalError
from firmware_py.export.reading import read_modules
from firmware_py.export.syntax import ENTRY, OWN
from firmware_py.logic.budget import ARGUMENT, budgeted
from firmware_py.logic.entry import compose, own_blocks
from firmware_py.logic.laws import SHIPPED_LAWS
from firmware_py.logic.plugs import GROUP, POINTS, SENSED, Plug, PlugPoint, read_plug
from firmware_py.table import CoreParameter, CoreVariable


@dataclass(frozen=True)
class Loaded:
    """Logic that is ready to fly, with the defaults that its modules declare."""

    plugs: tuple[Plug, ...]
    digest: str  # of the modules' texts
    calls: Mapping[str, tuple[str, ...]]
    entry: ModuleType  # the calls, as Python
    structs: Mapping[str, type[Struct]]  # of the blocks that own logic adds to the core's
    files: Mapping[str, str]  # by plug point
    texts: Mapping[str, str]  # as they fly, with the core's, by module

    @cached_property
    def translation(self) -> Translation:
        """Return the logic and the core as C."""
        return translate(self.texts, _paths(self.files))

    @property
    def parameters(self) -> tuple[CoreParameter, ...]:
        return tuple(parameter for plug in self.plugs for parameter in plug.parameters)

    @property
    def variables(self) -> tuple[CoreVariable, ...]:
        named: dict[str, CoreVariable] = {}  # both modules may read one sensor
        for plug in self.plugs:
            for variable in plug.variables:
                named.setdefault(variable.name, variable)
        return tuple(named.values())


@dataclass(frozen=True, slots=True)
class SensedField:
    """A field that own logic reads of a sensor: where it stands, its block and name, the array's shape, its unit."""

    place: str
    block: str
    name: str
    shape: tuple[int, ...]
    unit: str


@dataclass(frozen=True, slots=True)
class Logic:
    """The user's logic in a flight: the modules, and the profile's values of their parameters."""

    loaded: Loaded
    values: Mapping[str, float]  # of every parameter

    def overrun(self, blocks: Mapping[str, Block[Struct]]) -> str:
        """Return the first loop that exceeded the budget of its call, as one line; empty: none."""
        for plug in self.loaded.plugs:
            if plug.charged:
                budget: Any = blocks[plug.block(ARGUMENT)].fields
                if budget.line:
                    place = f"{_shown(self.loaded.files[plug.point.name])}:{budget.line}"
                    return f"{place}: the loop up to {budget.end} exceeds the {CALL_CYCLES} cycles of a call"
        return ""

    def allocate(self) -> dict[str, Block[Struct]]:
        """Return the memory, with the parameters in it; sensors have no sample yet."""
        blocks = {name: kind.allocate() for name, kind in self.loaded.structs.items()}
        for field in sensed_by(self):
            blocks[field.block].memory[field.name] = nan
        for parameter in self.loaded.parameters:
            place = parameter.place
            blocks[place.block].memory[place.field] = self.values[place.field]
        return blocks


def load_logic(config: LogicConfig) -> Logic | None:
    """Return the logic of a profile, None when the default core flies.

    Raises `LogicError` for a file or value that cannot be used, `ExportError` for text outside the subset.
    """
    files = {point.name: getattr(config, point.name) for point in POINTS if getattr(config, point.name)}
    if not files:
        if config.values:
            name = next(iter(config.values))
            raise LogicError(
                f"logic.{name}: neither a controller nor an estimator of your own is given in [logic]"
            )
        return None
    texts = []
    for name, file in files.items():
        try:
            texts.append((name, file, Path(file).read_text(encoding="utf-8-sig")))
        except (OSError, UnicodeDecodeError) as error:
            reason = getattr(error, "strerror", None) or error
            near = "" if file.endswith(".py") else f"; laws that ship: {', '.join(SHIPPED_LAWS)}"
            raise LogicError(f"logic.{name} = {file}: {reason}{near}") from None
    loaded = _load(tuple(texts))
    return Logic(loaded, _values(config.values, loaded.parameters))


def sensed_by(logic: Logic | None) -> Iterator[SensedField]:
    """Yield what own logic reads of the robot's own sensors."""
    for plug in () if logic is None else logic.loaded.plugs:
        for field in plug.structs[SENSED].fields.values() if SENSED in plug.structs else ():
            assert isinstance(field.mark, Sensed)
            assert logic is not None
            place = f"{_shown(logic.loaded.files[plug.point.name])}:{field.line}"
            yield SensedField(place, plug.block(SENSED), field.name, field.kind.shape, field.mark.unit)


def check_file(file: Path) -> Loaded:
    """Return a controller or an estimator that is ready to fly; its hooks show which of both it is.

    Raises `LogicError` for a file that cannot be used, `ExportError` with a line for each refusal.
    """
    try:
        text = file.read_text(encoding="utf-8-sig")
    except (OSError, UnicodeDecodeError) as error:
        raise LogicError(f"{file}: {getattr(error, 'strerror', None) or error}") from None
    functions = set(re.findall(r"^def (\w+)", text, re.MULTILINE))
    if "@kernel" not in text:
        raise LogicError(f"{file}:1: no control law and no estimator: write @kernel def control_law(..)")
    point = max(POINTS, key=lambda point: len(functions & point.hooks.keys()))
    return _load(((point.name, str(file), text),))


def translation_of(config: LogicConfig) -> Translation:
    """Return the core as C, with the logic of a profile in it. Raises as `load_logic` does."""
    logic = load_logic(config)
    return translate() if logic is None else logic.loaded.translation


def digest_of(config: LogicConfig) -> str:
    """Return a hash of the modules' texts; empty when the default core flies. Raises as `load_logic` does."""
    logic = load_logic(config)
    return "" if logic is None else logic.loaded.digest


def _values(given: Mapping[str, float], parameters: tuple[CoreParameter, ...]) -> dict[str, float]:
    """Return the value of every parameter: the profile's, or the default."""
    known = {parameter.place.field: parameter for parameter in parameters}
    for name, value in given.items():
        if name not in known:
            near = difflib.get_close_matches(name, known, 1, 0.5)
            hint = f"did you mean {near[0]}?" if near else f"there are {', '.join(known) or 'none'}"
            raise LogicError(f"logic.{name}: no parameter of that name; {hint}")
        if not known[name].low <= value <= known[name].high:
            bounds = f"{known[name].low:g}..{known[name].high:g} {known[name].unit}".rstrip()
            raise LogicError(f"logic.{name} = {value:g}: outside {bounds}")
        if not known[name].scalar.is_float and value != int(value):
            raise LogicError(f"logic.{name} = {value:g}: expected a whole number")
    return {name: given.get(name, parameter.default) for name, parameter in known.items()}


@lru_cache(maxsize=64)
def _load(modules: tuple[tuple[str, str, str], ...]) -> Loaded:
    """Load modules, each given as plug point, file and text."""
    texts = core_texts() | {f"own_{name}": text for name, _, text in modules}
    files = {name: file for name, file, _ in modules}
    shown = _paths(files)
    lines: list[str] = []
    checked = [_checked(point, texts, shown, lines) for point in POINTS if f"own_{point.name}" in texts]
    if lines:
        raise ExportError("\n".join(lines))
    plugs = tuple(plug for plug, _ in checked)
    _check_names(plugs, shown)
    digest = hashlib.sha256(repr([(name, text) for name, _, text in modules]).encode()).hexdigest()
    entry = compose(plugs)
    texts |= {f"own_{plug.point.name}": text for plug, text in checked} | {"entry": entry.text}
    own = SimpleNamespace()
    for plug in plugs:
        name = f"own_{plug.point.name}"
        try:
            module = _run(name, texts[name], files[plug.point.name], own)
        except Exception as error:
            raise LogicError(f"{shown[name]}: {type(error).__name__}: {error}") from error
        setattr(own, name, module)
    run = _run(ENTRY, entry.text, f"{ENTRY}.py", own)
    structs = {block: getattr(run, struct) for block, struct in own_blocks(plugs).items()}
    return Loaded(plugs, digest, entry.calls, run, structs, files, texts)


def _checked(
    point: PlugPoint, texts: Mapping[str, str], shown: Mapping[str, str], lines: list[str]
) -> tuple[Plug, str]:
    """Return what a module provides, with its text as it flies: loops whose length depends on data are charged.

    Its refusals are added to the lines.
    """
    name, empty = f"own_{point.name}", (Plug(point, {}, {}, (), (), {}), "")
    try:
        modules = read_modules(texts, shown, name)
        plug = read_plug(point, modules[-1])
        check(modules, plug.hooks)
        flown = None if modules[-1].refusals.found else budgeted(texts[name], modules)
    except RefusalError as error:  # no Python, or no part of the core
        lines.append(str(error))
        return empty
    lines += modules[-1].refusals.lines()
    if flown is None:
        return empty
    hooks = {
        hook: (ARGUMENT, *arguments) if hook in flown.charged else arguments
        for hook, arguments in plug.hooks.items()
    }
    charged = {hook: cycles for hook, cycles in flown.charged.items() if hook in hooks}
    return replace(plug, hooks=hooks, charged=charged), flown.text


def _run(name: str, text: str, file: str, own: SimpleNamespace) -> ModuleType:
    """Execute a module from its text, as of a file where a debugger stops; `own` has the user's modules."""

    def import_(imported: str, *rest: Any) -> Any:
        return own if imported == OWN else __import__(imported, *rest)

    module = ModuleType(name)
    module.__dict__["__builtins__"] = vars(builtins) | {"__import__": import_}
    exec(compile(text, file, "exec"), module.__dict__)
    return module


def _check_names(plugs: tuple[Plug, ...], shown: Mapping[str, str]) -> None:
    """Refuse names that clients could not distinguish."""
    for kind in ("parameters", "variables"):
        seen: dict[str, str] = {}
        for plug in plugs:
            path = shown[f"own_{plug.point.name}"]
            for thing in getattr(plug, kind):
                name = thing.name.removeprefix(f"{GROUP}.")
                key = name.upper()  # MAVLink has no small letters
                if key in seen and not (
                    thing.place.block.endswith(SENSED) and seen[key].startswith(f"{SENSED}.")
                ):
                    raise LogicError(f"{path}: {name}: this name exists already: {seen[key]}")
                of_sensor = f"{SENSED}." if thing.place.block.endswith(SENSED) else ""
                seen[key] = f"{of_sensor}{name} in {path}"


def _paths(files: Mapping[str, str]) -> dict[str, str]:
    """Return the files of own modules, given by plug point, as shown to the user, by module."""
    return {f"own_{name}": _shown(file) for name, file in files.items()}


def _shown(file: str) -> str:
    """Return a file's path for the user: relative to the working folder where that is shorter."""
    path = Path(file)
    return str(path.relative_to(Path.cwd())) if path.is_relative_to(Path.cwd()) else file
