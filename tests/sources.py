"""What sources say of themselves: what they import, what they show, how they call."""

import ast
from collections.abc import Collection, Iterator, Mapping, Sequence
from graphlib import CycleError, TopologicalSorter
from importlib.util import resolve_name
from pathlib import Path


def module_name(path: str) -> str:
    """The dotted name of a file: ``calib/effects/__init__.py`` is ``calib.effects``."""
    return path.removesuffix(".py").removesuffix("/__init__").replace("/", ".")


def imports(path: str, body: Iterator[ast.AST], modules: set[str]) -> Iterator[str]:
    """The modules that the nodes import; of ``from a import b``, a.b where that is a module."""
    package = module_name(f"{Path(path).parent}/__init__.py")
    for node in body:
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            source = resolve_name("." * node.level + (node.module or ""), package)
            for alias in node.names:
                inner = f"{source}.{alias.name}"
                yield inner if inner in modules else source


def imported(sources: dict[str, ast.AST]) -> dict[str, set[str]]:
    """Module -> those of the sources that it imports anywhere, functions included."""
    modules = {module_name(path) for path in sources}
    return {
        module_name(path): set(imports(path, ast.walk(tree), modules)) & modules
        for path, tree in sources.items()
    }


def import_cycle(sources: dict[str, ast.AST]) -> list[str]:
    """The modules of one circle of imports, or nothing."""
    try:
        TopologicalSorter(imported(sources)).prepare()
    except CycleError as error:
        return error.args[1]
    return []


def storey(package: str, rooms: Sequence[str], module: str) -> int:
    """How high above the ground of a package a module of it stands: 0 is the ground."""
    if module == package:
        return len(rooms) + 1
    room = module.removeprefix(f"{package}.").split(".")[0]
    return rooms.index(room) + 1 if room in rooms else 0


def upward(sources: dict[str, ast.AST], order: Mapping[str, Sequence[str]]) -> Iterator[str]:
    """A line for each room that imports one above it; `order` is of each package's, from below."""
    for package, rooms in order.items():
        depth = package.count(".") + 2
        for module, others in imported(sources).items():
            for other in others:
                inside = all(f"{name}.".startswith(f"{package}.") for name in (module, other))
                if inside and storey(package, rooms, module) < storey(package, rooms, other):
                    room, above = (".".join(n.split(".")[:depth]) for n in (module, other))
                    yield f"{room} imports {above}"


def dataclasses(sources: dict[str, ast.AST]) -> set[str]:
    """Dotted names of the dataclasses of the sources."""
    return {
        f"{module_name(path)}.{node.name}"
        for path, tree in sources.items()
        for node in ast.walk(tree)
        if isinstance(node, ast.ClassDef)
        if any("dataclass" in ast.unparse(decorator) for decorator in node.decorator_list)
    }


def wide_calls(path: str, tree: ast.AST, classes: set[str], most: int) -> Iterator[str]:
    """Line and class of each call of a dataclass with more than `most` fields by position."""
    module = module_name(path)
    homes = {name.rpartition(".")[2]: module for name in classes}
    for node in ast.walk(tree):
        if isinstance(node, ast.ImportFrom):
            (home, *_) = imports(path, iter([node]), set())
            homes |= {alias.asname or alias.name: f"{home} {alias.name}" for alias in node.names}
    for node in ast.walk(tree):
        if isinstance(node, ast.Call) and isinstance(node.func, ast.Name):
            home, _, name = homes.get(node.func.id, "").partition(" ")
            ends = f".{name or node.func.id}"  # a package may hand on what a module of it defines
            ours = home and any(c.startswith(f"{home}.") and c.endswith(ends) for c in classes)
            if ours and len(node.args) > most:
                yield f"{node.lineno} {node.func.id}"


def is_property(node: ast.AST) -> bool:
    """Whether a method reads as an attribute, whose name says what it is."""
    decorators = {ast.unparse(decorator) for decorator in node.decorator_list}
    return bool(decorators & {"property", "cached_property"})


def public(body: list[ast.stmt], prefix: str) -> Iterator[tuple[str, ast.AST]]:
    """Public functions, classes, and the methods of classes that inherit no docstring."""
    for node in body:
        if not isinstance(node, ast.FunctionDef | ast.ClassDef) or node.name.startswith("_"):
            continue
        if not is_property(node):
            yield f"{prefix}.{node.name}", node
        if isinstance(node, ast.ClassDef) and not node.bases:
            yield from public(node.body, f"{prefix}.{node.name}")


def every_argument(function: ast.FunctionDef) -> list[ast.arg]:
    """By position, by keyword and all others."""
    given = function.args
    rest = filter(None, (given.vararg, given.kwarg))
    return [*given.posonlyargs, *given.args, *given.kwonlyargs, *rest]


ORDERING = {"list", "tuple", "fromkeys", "array", "join", "enumerate", "zip", "iter", "next", "map"}


def walks_over_sets(tree: ast.AST) -> Iterator[str]:
    """Line and text of each loop, list or text that is made in the order of a set.

    That order is another each time Python starts, where the set holds texts. Known as sets are
    displays, calls of ``set``, and what is made of these, and of keys, by operators.
    """
    walked = (each for node in ast.walk(tree) for each in _walked(node))
    yield from (f"{each.lineno} {ast.unparse(each)}" for each in walked if _is_set(each))


def _walked(node: ast.AST) -> Sequence[ast.expr]:
    if isinstance(node, ast.For):
        return [node.iter]
    if isinstance(node, ast.ListComp | ast.DictComp | ast.GeneratorExp):
        return [generator.iter for generator in node.generators]
    return node.args if isinstance(node, ast.Call) and _called(node) in ORDERING else []


def _is_set(node: ast.AST) -> bool:
    if isinstance(node, ast.Call):
        return _called(node) in {"set", "frozenset", "union", "intersection", "difference"}
    if isinstance(node, ast.BinOp) and isinstance(node.op, ast.BitAnd | ast.BitOr | ast.Sub):
        sides = (node.left, node.right)
        keys = isinstance(node.op, ast.BitAnd) and any(".keys()" in ast.unparse(s) for s in sides)
        return keys or any(map(_is_set, sides))
    return isinstance(node, ast.Set | ast.SetComp)


def _called(node: ast.Call) -> str:
    return getattr(node.func, "id", getattr(node.func, "attr", ""))


TAKES_APART = {"startswith", "endswith", "removeprefix", "removesuffix"}
TAKES_APART |= {"partition", "rpartition", "rsplit"}  # no `split`: numpy's takes arrays apart


def calls(tree: ast.Module, names: Collection[str]) -> Iterator[int]:
    """Lines that call a function or method of one of these names."""
    for node in (n for n in ast.walk(tree) if isinstance(n, ast.Call)):
        name = getattr(node.func, "attr", getattr(node.func, "id", ""))
        if name in names:
            yield node.lineno
