"""Expressions of xacro, calculated without Python's eval.

xacro evaluates ``${...}`` as Python with few names in reach, from which all of Python can be
reached still. Here an expression is parsed, and each kind of it that robots' files need is
calculated; whatever else there is, and whatever grows beyond reason, is refused.
"""

from __future__ import annotations

import ast
import math
import operator
import re
from collections.abc import Callable, Mapping
from typing import Any

LONGEST_VALUE = 100_000  # characters or items of a value: more than a whole robot's file has
_BITS = 4096  # of a whole number
_DEEPEST = 100  # a choice: people nest a few; Python's own limit of 1000 calls is far
_METHODS = {
    str: {"split", "lower", "upper", "strip", "replace", "startswith", "endswith", "join"},
    dict: {"get", "keys", "values", "items"},
    list: {"index", "count"},
}
_FUNCTIONS = {
    *("len", "str", "float", "int", "bool", "min", "max", "round", "abs", "all", "any", "sum"),
    *("list", "tuple", "dict", "range", "sorted", "reversed", "enumerate", "zip"),
    *("load_yaml", "named", "YamlDictWrapper", "tokenize", "fatal"),
    *("message", "warning", "error", "print_location"),
    *(n for n in vars(math) if n[0] != "_" and n not in ("factorial", "comb", "perm", "prod")),
}
_BINARY: dict[type, Callable[[Any, Any], Any]] = {
    ast.Add: operator.add, ast.Sub: operator.sub, ast.Mult: operator.mul,
    ast.Div: operator.truediv, ast.FloorDiv: operator.floordiv, ast.Mod: operator.mod,
    ast.Pow: operator.pow,
}  # fmt: skip
_UNARY = {ast.UAdd: operator.pos, ast.USub: operator.neg, ast.Not: operator.not_}
_COMPARED: dict[type, Callable[[Any, Any], Any]] = {
    ast.Eq: operator.eq, ast.NotEq: operator.ne, ast.Lt: operator.lt, ast.LtE: operator.le,
    ast.Gt: operator.gt, ast.GtE: operator.ge, ast.Is: operator.is_, ast.IsNot: operator.is_not,
    ast.In: lambda a, b: a in b, ast.NotIn: lambda a, b: a not in b,
}  # fmt: skip


def evaluate(text: str, names: Mapping[str, Any], *_: object) -> Any:
    """The value of an expression.

    Args:
        text: the expression, as stands between ``${`` and ``}``.
        names: what it may name.

    Raises:
        ValueError: it holds what is not calculated here, or its value is too large.
        NameError: it names what there is not.
    """
    if len(text) > LONGEST_VALUE:
        raise ValueError("an expression is too long")
    return _value(ast.parse(text.strip(), mode="eval").body, names, 0)


def _value(node: ast.expr, names: Mapping[str, Any], depth: int) -> Any:
    if depth > _DEEPEST:
        raise ValueError(f"an expression is nested more than {_DEEPEST} deep")

    def of(inner: ast.expr) -> Any:
        return _value(inner, names, depth + 1)

    match node:
        case ast.Constant(value=int() | float() | str() | None as value):
            return _bounded(value)
        case ast.Name(id=name):
            try:
                return names[name]
            except KeyError:
                raise NameError(f"name '{name}' is not defined") from None
        case ast.UnaryOp(op=op, operand=inner) if type(op) in _UNARY:
            return _UNARY[type(op)](of(inner))
        case ast.BinOp(op=op, left=left, right=right) if type(op) in _BINARY:
            return _binary(op, of(left), of(right))
        case ast.Compare(left=left, ops=ops, comparators=others):
            values = [of(each) for each in (left, *others)]
            pairs = zip(ops, values, values[1:], strict=False)
            return all(_COMPARED[type(op)](a, b) for op, a, b in pairs)
        case ast.BoolOp(op=op, values=values):
            return _either(isinstance(op, ast.Or), values, of)
        case ast.IfExp(test=test, body=yes, orelse=no):
            return of(yes) if of(test) else of(no)
        case ast.List(elts=items) | ast.Tuple(elts=items):
            return _bounded([of(item) for item in items])
        case ast.Dict(keys=keys, values=values) if None not in keys:
            return dict(zip(map(of, keys), map(of, values), strict=True))
        case ast.Subscript(value=inner, slice=ast.Slice(lower=low, upper=high, step=step)):
            ends = (None if end is None else of(end) for end in (low, high, step))
            return of(inner)[slice(*ends)]
        case ast.Subscript(value=inner, slice=at):
            return of(inner)[of(at)]
        case ast.Attribute(value=inner, attr=name) if not name.startswith("_"):
            return _member(of(inner), name)
        case ast.Call(func=func, args=args, keywords=[]):
            return _called(of(func), [of(each) for each in args])
    raise ValueError(f"{type(node).__name__} is not calculated here; write it out with xacro")


def _either(want: bool, values: list[ast.expr], of: Callable[[ast.expr], Any]) -> Any:
    """The first value that decides ``or`` (`want`) or ``and``, else the last."""
    for each in values:
        value = of(each)
        if bool(value) == want:
            break
    return value


def _binary(op: ast.operator, left: Any, right: Any) -> Any:
    if isinstance(op, ast.Pow):
        if not isinstance(left, int | float) or not isinstance(right, int | float):
            raise ValueError("** takes numbers")
        if isinstance(left, int) and left.bit_length() * abs(right) > _BITS:
            left = float(left)
    if isinstance(op, ast.Mod) and isinstance(left, str) and re.search(r"\d{3}|\*", left):
        raise ValueError("a text is formatted too wide")
    if isinstance(op, ast.Mult):
        sizes = [len(each) for each in (left, right) if isinstance(each, str | list | tuple)]
        times = [each for each in (left, right) if isinstance(each, int)]
        if sizes and times and sizes[0] * times[0] > LONGEST_VALUE:
            raise ValueError(f"a value has more than {LONGEST_VALUE} parts")
    return _bounded(_BINARY[type(op)](left, right))


def _member(owner: Any, name: str) -> Any:
    """A name of a name space or of YAML's data, or a harmless method."""
    if isinstance(owner, dict) and name in owner:
        return owner[name]
    for kind, methods in _METHODS.items():
        if isinstance(owner, kind) and name in methods:
            return getattr(owner, name)
    raise AttributeError(f"{type(owner).__name__} has no {name} here")


def _called(function: Any, arguments: list[Any]) -> Any:
    name = getattr(function, "__name__", "")
    owner = getattr(function, "__self__", None)
    of_value = any(isinstance(owner, k) and name in known for k, known in _METHODS.items())
    if name == "wrapper" and hasattr(function, "__closure__"):  # xacro's own, round a function
        held = (cell.cell_contents for cell in function.__closure__ or ())
        name = next((each.__name__ for each in held if callable(each)), name)
    if not (of_value or name in _FUNCTIONS or _is_lambda_of_xacro(function)):
        raise ValueError(f"{name or 'that'}() is not called here; write it out with xacro")
    if name in ("replace", "join", "split"):
        _bounded("".join(map(str, arguments)))
    if name == "replace" and len(owner) * len(str(arguments[-1])) > LONGEST_VALUE:
        raise ValueError(f"a value has more than {LONGEST_VALUE} parts")
    if (
        name == "join"
        and sum(map(len, arguments[0])) + len(owner) * len(arguments[0]) > LONGEST_VALUE
    ):
        raise ValueError(f"a value has more than {LONGEST_VALUE} parts")
    return _bounded(function(*arguments))


def _is_lambda_of_xacro(function: Any) -> bool:
    """xacro.arg is one; an expression of a file cannot make any."""
    named = getattr(function, "__name__", ""), getattr(function, "__module__", "")
    return named == ("<lambda>", "xacro")


def _bounded(value: Any) -> Any:
    """The value, unless it is larger than any file of a robot needs."""
    if isinstance(value, int) and value.bit_length() > _BITS:
        raise ValueError(f"a whole number has more than {_BITS} bits")
    if isinstance(value, str | list | tuple | dict | range) and len(value) > LONGEST_VALUE:
        raise ValueError(f"a value has more than {LONGEST_VALUE} parts")
    return value
