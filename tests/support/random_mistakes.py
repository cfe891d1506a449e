"""Random mistakes in random bodies of kernels: what a user writes who has not read the language's page."""

import ast
from random import Random
from typing import Any

OPERATORS = ("+", "-", "*", "/", "//", "%", "**", "<<", ">>", "|", "&", "^", "@")
COMPARISONS = ("<", "<=", ">", ">=", "==", "!=", "is", "is not", "in", "not in")
SIGNS = ("-", "+", "~", "not ")
CALLS = ("abs", "min", "max", "round", "int", "float", "bool", "len", "sum", "sqrt", "i32", "f32", "f64", "pow", "print",
         "math.sin", "np.abs", "unknown", "x", "random_3", "law_3")  # fmt: skip
LITERALS = ("3", "2.5", "-0.0", "1e50", "2**40", "1e-50", "True", "None", "'text'", "2j", "f32(0.1)", "[1, 2]", "(1, 2)",
            "{}", "lambda: 1", "x if is_far else y", "(z := 2)", "*x", "x < y < 2", "DT", "TABLE", "own")  # fmt: skip
STATEMENTS = (
    "while x > y:\n    x = x - DT", "while True:\n    pass", "return", "return n", "return x", "return True", "pass",
    "break", "continue", "try:\n    x = y\nexcept Exception:\n    pass", "with x:\n    pass", "del x", "global x",
    "assert n > 0", "raise ValueError", "import math", "def f():\n    pass", "class A:\n    pass", "x: f32 = y", "x = n = 2",
    "x, n = y, m", "x, y = y, x", "[x, y] = y, x", "x += n", "n += x", "n /= 2", "n **= 2", "n <<= 1", "is_far = n",
    "n = is_far", "x = n", "n = x", "x = is_far", "x", "abs(x)", "'text'", "print(x)", "yield x",
    "for i in [1, 2]:\n    n = i", "for i in range(2):\n    n = i\nelse:\n    n = 3", "for n in range(3):\n    m = n",
    "for i in range(3):\n    m = i\nn = i", "for i in range(0.5):\n    m = i", "for i in range(1, 2, 0):\n    m = i",
    "for i in range(1, 9, n):\n    m = i", "for i in range():\n    m = i", "for i in n:\n    m = i",
    "for x in range(2):\n    m = x", "for i in range(3):\n    i = i + 1", "for i in range(10000000):\n    x = x + DT",
    "memory.integral = n", "memory.ticks = x", "memory.unknown = x", "memory = own", "own.gain_z = x", "TABLE[0] = x",
    "memory.errors = x", "memory.errors[4] = x", "memory.errors[-1] = x", "memory.errors[x] = x", "memory.errors[n] = x",
    "memory.errors[1:2] = x", "memory.errors[0, 1] = x", "x = memory.errors", "x = memory.errors[0][0]", "x = TABLE[n]",
    "x = estimator", "x = estimator.unknown", "x = estimator.now[99]", "x = np.pi", "x = self.x", "numbers = x",
    "numbers[9] = x", "numbers[n] = n", "counts[0] = x", "x = numbers", "x = numbers[0, 0]", "x = COEFFICIENTS[9]",
    "if x:\n    n = 1", "if n:\n    n = 1", "if n == x:\n    n = 1", "if not n:\n    n = 1",
    "if (n > 1) & (m > 1):\n    n = 1", "for i in range(1, m, 2):\n    m = i",
    "if n in (1, 2):\n    m = 1", "if n is None:\n    m = 1", "if is_far == True:\n    n = 1", "if n > 3:\n    k = 1\nn = k",
    "x = f'{n}'", "x = x.real", "x = clamp(x)", "x = clamp(x, y, n)", "x = min(x)", "x = max(x, y, x)", "x = f32(n, m)",
    "x = f32(is_far)", "n = i32(is_far)", "n = i32(n)", "x = f32(x)", "x = f32()", "x = sqrt(n)", "x = abs(n)", "n = abs(x)",
)  # fmt: skip


def mistaken(body: str, seed: int) -> tuple[str, str]:
    """Return a body with one mistake, which may be none, and the mistake."""
    random, tree = Random(seed), ast.parse(body)
    kind = random.choice([Statements, Statements, Expressions])
    mistake = kind(random, sum(isinstance(node, kind.KINDS) for node in ast.walk(tree)))
    mistake.visit(tree)
    return ast.unparse(ast.fix_missing_locations(tree)), mistake.said


class _One(ast.NodeTransformer):
    """Changes one node of some kinds, drawn from all."""

    KINDS: tuple[type[ast.AST], ...] = ()

    def __init__(self, random: Random, count: int) -> None:
        self.random, self.left, self.said = random, random.randrange(count), "nothing"

    def visit(self, node: ast.AST) -> Any:
        if isinstance(node, self.KINDS):
            self.left -= 1
            if self.left == -1:
                text = self.other(node)
                self.said = text.replace("\n", "; ")
                return self.parsed(text)
        return self.generic_visit(node)

    def other(self, node: ast.AST) -> str:
        raise NotImplementedError

    def parsed(self, text: str) -> Any:
        raise NotImplementedError


class Statements(_One):
    """Puts a statement of a user's in the place of one."""

    KINDS = (ast.Assign, ast.AugAssign)

    def other(self, node: ast.AST) -> str:
        return self.random.choice(STATEMENTS)

    def parsed(self, text: str) -> list[ast.stmt]:
        return ast.parse(text).body


class Expressions(_One):
    """Changes an operator, a comparison, a call, a name or a number."""

    KINDS = (ast.BinOp, ast.UnaryOp, ast.Compare, ast.Call, ast.Constant)

    def other(self, node: ast.AST) -> str:
        choose = self.random.choice
        match node:
            case ast.BinOp():
                return f"({ast.unparse(node.left)}) {choose(OPERATORS)} ({ast.unparse(node.right)})"
            case ast.UnaryOp():
                return f"{choose(SIGNS)}({ast.unparse(node.operand)})"
            case ast.Compare():
                return (
                    f"({ast.unparse(node.left)}) {choose(COMPARISONS)} ({ast.unparse(node.comparators[0])})"
                )
            case ast.Call():
                given = [ast.unparse(one) for one in node.args]
                return f"{choose(CALLS)}({', '.join(choose([given, given[:-1], [*given, 'n']]))})"
        return choose(LITERALS)

    def parsed(self, text: str) -> ast.AST:
        return ast.parse(f"[{text}]" if text.startswith("*") else f"({text})", mode="eval").body
