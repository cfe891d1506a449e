"""Random bodies of kernels from every operator, comparison and statement of the translators' two languages.

Numbers stay so small that nothing overflows and no NaN appears: whatever differs between Python and C is the translator's.
"""

import ast
from dataclasses import dataclass
from random import Random
from textwrap import indent

SMALL = 50.0  # what a local or a place in memory holds at most


@dataclass(frozen=True)
class Language:
    """How one of the two languages spells what both have; a body reads these places and may write to `places`."""

    reals: tuple[str, ...]  # within 10
    wholes: tuple[str, ...]  # within 10
    places: tuple[tuple[str, bool], ...]  # whether they are whole
    real: str  # a literal
    of_whole: str
    whole_of: str
    root: str
    truth: str
    live: bool  # the laboratory's: mixed numbers, `while`, choices and tuples


class Programs:
    """Writes bodies; equal seeds give equal bodies."""

    def __init__(self, language: Language, seed: int) -> None:
        self.language, self.random = language, Random(seed)
        self.loops = 0

    def body(self) -> str:
        """Return a body that returns nothing, and leaves its locals in x, y, n, m and is_far."""
        first = [
            "x = " + self.language.real.format(0.5),
            "y = " + self.language.real.format(-2.25),
            "n = 3",
            "m = -2",
        ]
        first.append("is_far = " + self.language.truth.format("n > m"))
        text = "\n".join(first + [self.statement(2) for _ in range(4)])
        return ast.unparse(ast.parse(text))  # without the parentheses that Python does not need

    def statement(self, depth: int) -> str:
        kinds = ["whole", "real", "truth", "write", "augment"] + 2 * ["if", "for"] * (depth > 0)
        match self.random.choice(kinds + ["while", "swap", "choice"] * self.language.live):
            case "whole":
                return self.assigned(self.random.choice("nm"), self.held(*self.whole(3), True))
            case "real":
                return self.assigned(self.random.choice("xy"), self.held(*self.number(3), False))
            case "truth":
                return self.assigned("is_far", self.language.truth.format(self.condition(2)))
            case "write":
                place, whole = self.random.choice(self.language.places)
                return f"{place} = {self.held(*(self.whole if whole else self.number)(2), whole)}"
            case "augment":
                return self.augmented()
            case "if":
                other = f"\nelse:\n{self.block(depth)}" * self.random.randrange(2)
                second = f"\nelif {self.condition(1)}:\n{self.block(depth)}" * self.random.randrange(2)
                return f"if {self.condition(2)}:\n{self.block(depth)}{second}{other}"
            case "for":
                return self.loop(depth)
            case "while":
                return (
                    f"while n > {self.random.randrange(-20, 20)}:\n    n = n - {self.random.randrange(1, 9)}"
                )
            case "swap":
                return self.random.choice(["x, y = y, x", "n, m = m, n", "x, y, n = y + 1.0, x, n // 2"])
            case _:
                (yes, first), (no, second) = self.number(2), self.number(2)
                return f"x = {self.held(f'(({yes}) if {self.condition(1)} else ({no}))', max(first, second), False)}"

    def assigned(self, name: str, text: str) -> str:
        negation = "not " if name == "is_far" else "-"  # compilers complain of x = x
        return f"{name} = {negation}{name}" if text == name else f"{name} = {text}"

    def block(self, depth: int) -> str:
        return indent(
            "\n".join(self.statement(depth - 1) for _ in range(self.random.randrange(1, 3))), "    "
        )

    def augmented(self) -> str:
        whole = self.random.random() < 0.4
        sign = self.random.choice(["+", "-", "*", "//", "%"] if whole else ["+", "-", "*", "/"])
        name = self.random.choice("nm" if whole else "xy")
        if sign in ("//", "%"):
            return f"{name} {sign}= {self.random.randrange(1, 9)}"
        text, most = (self.whole if whole else self.number)(1)
        after = f"\n{name} = {self.held(name, SMALL * max(most, 2) + 1, whole)}"
        return f"{name} {sign}= {self.divisor(text) if sign == '/' else text}{after}"

    def loop(self, depth: int) -> str:
        self.loops += 1
        name, pick = f"k{self.loops}", self.random.randrange
        limits = (str(pick(5)), f"{pick(-3, 3)}, {pick(-1, 5)}", f"{pick(3, 6)}, {pick(-2, 2)}, {-pick(1, 4)}",
                  f"{pick(-4, 2)}, {pick(3, 7)}, {pick(2, 4)}", "n", f"m, {self.random.choice('nm')} + 1")  # fmt: skip
        inside = f"n = n + {name}\n{self.held_line('n')}\n{self.statement(depth - 1)}"
        if pick(3) == 0:
            inside = f"if {self.condition(1)}:\n    {self.random.choice(['break', 'continue'])}\n{inside}"
        return f"for {name} in range({self.random.choice(limits)}):\n{indent(inside, '    ')}"

    def held_line(self, name: str) -> str:
        return f"{name} = {self.held(name, SMALL + 10, True)}"

    def held(self, text: str, most: float, whole: bool) -> str:
        """Return an expression whose value a local or a place can hold."""
        if most <= SMALL:
            return text
        if whole:
            return self.random.choice([f"({text}) % 97 - 48", f"{self.cast(f'({text}) % 41')} - 20"])
        low, high = (self.language.real.format(end) for end in (-SMALL, SMALL))
        return f"min(max({text}, {low}), {high})"

    def cast(self, text: str) -> str:
        return f"i32({text})"

    def whole(self, depth: int) -> tuple[str, float]:
        """Return an expression of whole numbers and its greatest size."""
        if depth == 0 or self.random.random() < 0.2:
            name = self.random.choice("nm")
            number = self.random.randrange(-9, 10)
            return self.random.choice(
                [(self.random.choice(self.language.wholes), 10.0), (name, SMALL), (str(number), abs(number))]
            )
        one, most = self.whole(depth - 1)
        match self.random.choice(["-", "//", "%", "min", "i32", *3 * ["two"]]):
            case "-":
                return f"-({one})", most
            case "//" | "%" as sign:
                by = self.random.randrange(1, 9)
                return f"({one}) {sign} {by}", float(by) if sign == "%" else most + 1
            case "min" if not self.language.live:
                other, size = self.whole(depth - 1)
                return f"{self.random.choice(['min', 'max'])}({one}, {other})", max(most, size)
            case "i32":
                return self.language.whole_of.format(self.held(*self.number(depth - 1), False)), SMALL
        other, size = self.whole(depth - 1)
        sign = self.random.choice("+-*")
        size = most * size if sign == "*" else most + size
        return (f"({one}) {sign} ({other})", size) if size < 1e6 else (one, most)

    def number(self, depth: int) -> tuple[str, float]:
        """Return an expression of floats and its greatest size."""
        literal = round(self.random.uniform(-9, 9), 3)
        if depth == 0 or self.random.random() < 0.15:
            return self.random.choice([(self.random.choice(self.language.reals), 10.0), (self.random.choice("xy"), SMALL),
                                       (self.language.real.format(literal), 9.0)])  # fmt: skip
        one, most = self.number(depth - 1)
        other, size = self.number(depth - 1)
        match self.random.choice(["-", "abs", "root", "of", "min", "/", *3 * ["two"]]):
            case "-":
                return f"-({one})", most
            case "abs":
                return f"abs({one})", most
            case "root":
                return f"{self.language.root}(abs({one}))", max(most, 1.0)
            case "of":
                whole, most = self.whole(depth - 1)
                return self.language.of_whole.format(whole), most
            case "min":
                return f"{self.random.choice(['min', 'max'])}({one}, {other})", max(most, size)
            case "/":
                return f"({one}) / {self.divisor(other)}", 2 * most
        sign = self.random.choice("+-*")
        if self.language.live and self.random.random() < 0.3:
            other, size = self.whole(depth - 1)  # becomes a float
        return f"({one}) {sign} ({other})", max(most, 2) * max(size, 2)

    def divisor(self, text: str) -> str:
        return f"(abs({text}) + {self.language.real.format(0.5)})"

    def condition(self, depth: int) -> str:
        """Return an expression of truth."""
        match self.random.choice(["whole", "real", "real", *["and", "or", "not", "local"] * (depth > 0)]):
            case "and" | "or" as sign:
                parts = [f"({self.condition(depth - 1)})" for _ in range(self.random.randrange(2, 4))]
                return f" {sign} ".join(parts)
            case "not":
                return f"not ({self.condition(depth - 1)})"
            case "local":
                return "is_far"
            case kind:
                of = self.whole if kind == "whole" else self.number
                sign = self.random.choice(["<", "<=", ">", ">=", "==", "!="])
                one, other = of(1)[0], of(1)[0]
                if self.random.random() < 0.2:
                    other = one  # the edge
                return f"({one}) {sign} ({other})"
