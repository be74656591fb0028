"""Arithmetic on columns, as users write it: parsed, never evaluated as Python."""

from __future__ import annotations

import ast
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from chains.errors import InputError
from sensors.documents import nearest

ALIASES = {
    "range": "range_m",
    "incidence": "incidence_rad",
    "azimuth": "azimuth_rad",
    "elevation": "elevation_rad",
    "time": "time_s",
    "elapsed": "elapsed_s",
    "temperature": "temperature_c",
}
CONSTANTS = {"pi": np.pi}
FUNCTIONS: dict[str, tuple[int, Callable]] = {
    "sin": (1, np.sin),
    "cos": (1, np.cos),
    "tan": (1, np.tan),
    "exp": (1, np.exp),
    "log": (1, np.log),
    "sqrt": (1, np.sqrt),
    "abs": (1, np.abs),
    "minimum": (2, np.minimum),
    "maximum": (2, np.maximum),
    "floor": (1, np.floor),
    "mod": (2, np.mod),
    "where": (3, lambda condition, yes, no: np.where(condition != 0, yes, no)),
}
OPERATORS: dict[type, Callable] = {
    ast.Add: np.add,
    ast.Sub: np.subtract,
    ast.Mult: np.multiply,
    ast.Div: np.divide,
    ast.Pow: np.power,
    ast.UAdd: np.positive,
    ast.USub: np.negative,
    ast.Lt: np.less,
    ast.LtE: np.less_equal,
    ast.Gt: np.greater,
    ast.GtE: np.greater_equal,
    ast.Eq: np.equal,
    ast.NotEq: np.not_equal,
}
# Characters, and brackets within each other. A choice: more than anybody reads, far less than what
# Python's own parser bears.
LONGEST_FORMULA, DEEPEST_FORMULA = 2000, 50


@dataclass(frozen=True)
class Expression:
    """One formula: ``+ - * / **``, comparisons, numbers, pi, columns and `FUNCTIONS`.

    A column goes by its name, or by one of `ALIASES`; a comparison is 1 or 0.

    Args:
        text: the formula.
        owner: what has it, for messages.
    """

    text: str
    owner: str

    def __post_init__(self) -> None:
        """Refuse what cannot be calculated, whatever the recording."""
        self._check(self._tree, 0)
        if not self.names and not np.isfinite(self.value(lambda name: np.nan)):
            raise self.wrong("is no finite number")

    @cached_property
    def names(self) -> tuple[str, ...]:
        """The columns that it looks at, each once, in order."""
        return tuple(dict.fromkeys(ALIASES.get(n, n) for n in self._names(self._tree)))

    def value(self, column: Callable[[str], np.ndarray]) -> np.ndarray:
        """Its value, of the shape that its columns have together.

        Args:
            column: gives a column by its full name.
        """
        with np.errstate(all="ignore"):
            return np.asarray(self._value(self._tree, column), float)

    def wrong(self, what: str, node: ast.AST | None = None) -> InputError:
        """That something is wrong with it, and where."""
        at = "" if node is None else f" at position {node.col_offset + 1}"
        return InputError(f"formula '{self.text}' of {self.owner}{at}: {what}")

    @cached_property
    def _tree(self) -> ast.expr:
        if len(self.text) > LONGEST_FORMULA:
            raise InputError(
                f"a formula of {self.owner} is longer than {LONGEST_FORMULA} characters"
            )
        try:
            return ast.parse(self.text.strip(), mode="eval").body
        except SyntaxError as error:
            where = f" at position {error.offset}" if error.offset else ""
            raise InputError(
                f"formula '{self.text}' of {self.owner}{where}: is no arithmetic; write it like "
                f"(humidity - 0.45) * range"
            ) from None
        except (ValueError, RecursionError, MemoryError):
            raise self.wrong("is no arithmetic that can be read") from None

    def _check(self, node: ast.expr, depth: int) -> None:
        if depth > DEEPEST_FORMULA:
            raise self.wrong(f"is nested more than {DEEPEST_FORMULA} deep", node)
        match node:
            case ast.Constant(value=bool() | str() | bytes() | complex() | None):
                raise self.wrong(f"{node.value!r} is no number", node)
            case ast.Constant(value=int() | float()):
                if abs(node.value) > 1e300:
                    raise self.wrong("a number is larger than 1e300", node)
            case ast.Name() | ast.Attribute():
                self._check_name(node)
            case ast.UnaryOp(op=ast.UAdd() | ast.USub(), operand=inner):
                self._check(inner, depth + 1)
            case ast.BinOp(op=op, left=left, right=right) if type(op) in OPERATORS:
                self._check(left, depth + 1)
                self._check(right, depth + 1)
            case ast.Compare(left=left, ops=[op], comparators=[right]) if type(op) in OPERATORS:
                self._check(left, depth + 1)
                self._check(right, depth + 1)
            case ast.Call():
                self._check_call(node)
                for inner in node.args:
                    self._check(inner, depth + 1)
            case _:
                what = type(node).__name__
                raise self.wrong(f"{what} is no arithmetic; + - * / ** and one < or > are", node)

    def _check_name(self, node: ast.Name | ast.Attribute) -> None:
        name = _dotted(node)
        if name is None:
            raise self.wrong("a name is letters, digits, _ and dots", node)
        if name in FUNCTIONS:
            raise self.wrong(f"{name} is a function; write {name}(...)", node)

    def _check_call(self, node: ast.Call) -> None:
        name = _dotted(node.func) or "this"
        if name not in FUNCTIONS:
            raise self.wrong(f"{name} is no function here{nearest(name, FUNCTIONS)}", node)
        count = FUNCTIONS[name][0]
        if len(node.args) != count or node.keywords:
            wanted = "1 value" if count == 1 else f"{count} values with commas between"
            raise self.wrong(f"{name} takes {wanted}", node)

    def _names(self, node: ast.expr) -> Iterator[str]:
        if isinstance(node, ast.Name | ast.Attribute):
            if (name := _dotted(node)) not in CONSTANTS:
                yield name
        else:
            inner = node.args if isinstance(node, ast.Call) else ast.iter_child_nodes(node)
            for child in inner:
                yield from self._names(child)

    def _value(self, node: ast.expr, column: Callable[[str], np.ndarray]) -> np.ndarray:
        match node:
            case ast.Constant(value=value):
                return np.float64(value)
            case ast.Name() | ast.Attribute():
                name = _dotted(node)
                if name in CONSTANTS:
                    return np.float64(CONSTANTS[name])
                return column(ALIASES.get(name, name))
            case ast.UnaryOp(op=op, operand=inner):
                return OPERATORS[type(op)](self._value(inner, column))
            case ast.BinOp(op=op, left=left, right=right):
                pass
            case ast.Compare(left=left, ops=[op], comparators=[right]):
                pass
            case ast.Call(func=func, args=args):
                return FUNCTIONS[_dotted(func)][1](*(self._value(a, column) for a in args))
        return OPERATORS[type(op)](
            np.asarray(self._value(left, column), float),
            np.asarray(self._value(right, column), float),
        )


def _dotted(node: ast.expr) -> str | None:
    """``a.b`` of a name, or None of anything else."""
    if isinstance(node, ast.Name):
        return node.id
    if isinstance(node, ast.Attribute) and (owner := _dotted(node.value)):
        return f"{owner}.{node.attr}"
    return None
