"""What sources say of themselves: what they import, what they show, how they call."""

import ast
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
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


def filled_classes(sources: dict[str, ast.AST]) -> dict[str, int]:
    """Dotted names of the dataclasses and named tuples of the sources, and how many fields each
    states."""
    return {
        f"{module_name(path)}.{node.name}": sum(isinstance(n, ast.AnnAssign) for n in node.body)
        for path, tree in sources.items()
        for node in ast.walk(tree)
        if isinstance(node, ast.ClassDef) and _is_filled(node)
    }


def _is_filled(node: ast.ClassDef) -> bool:
    """Whether a class gets its fields from its call: a dataclass or a named tuple."""
    decorated = any("dataclass" in ast.unparse(each) for each in node.decorator_list)
    return decorated or any(ast.unparse(base).endswith("NamedTuple") for base in node.bases)


def wide_calls(path: str, tree: ast.AST, classes: Mapping[str, int], most: int) -> Iterator[str]:
    """Line and class of each call of a dataclass or a named tuple with more than `most` fields by
    position; ``cls`` is the class around it, and a starred argument may fill all that are left."""
    module = module_name(path)
    homes = {name.rpartition(".")[2]: module for name in classes}
    for node in ast.walk(tree):
        if isinstance(node, ast.ImportFrom):
            (home, *_) = imports(path, iter([node]), set())
            homes |= {alias.asname or alias.name: f"{home} {alias.name}" for alias in node.names}
    for called, node in _calls(tree):
        home, _, name = homes.get(called, "").partition(" ")
        ends = f".{name or called}"  # a package may hand on what a module of it defines
        ours = [c for c in classes if home and c.startswith(f"{home}.") and c.endswith(ends)]
        if ours and _by_position(node, max(map(classes.__getitem__, ours))) > most:
            yield f"{node.lineno} {called}"


def _calls(body: ast.AST, around: str = "cls") -> Iterator[tuple[str, ast.Call]]:
    """Calls of names, and the names; of ``cls``, that of the class around them."""
    for node in ast.iter_child_nodes(body):
        if isinstance(node, ast.Call) and isinstance(node.func, ast.Name):
            yield (around if node.func.id == "cls" else node.func.id), node
        yield from _calls(node, node.name if isinstance(node, ast.ClassDef) else around)


def _by_position(call: ast.Call, fields: int) -> int:
    """How many of a class's fields a call may fill by position."""
    if not any(isinstance(each, ast.Starred) for each in call.args):
        return len(call.args)
    return max(len(call.args), fields - len(call.keywords))


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


def public_classes(tree: ast.Module) -> Iterator[str]:
    """Names of the classes of a module."""
    names = (node.name for node in tree.body if isinstance(node, ast.ClassDef))
    yield from (name for name in names if not name.startswith("_"))


def public_constants(tree: ast.Module) -> Iterator[str]:
    """Names in capitals to which a module itself gives a value; imported ones are others'."""
    for node in tree.body:
        if isinstance(node, ast.Assign | ast.AnnAssign):
            targets = node.targets if isinstance(node, ast.Assign) else [node.target]
            names = (each for target in targets for each in ast.walk(target))
            ids = (each.id for each in names if isinstance(each, ast.Name))
            yield from (i for i in ids if i.isupper() and len(i) > 1 and not i.startswith("_"))


def shared(
    sources: dict[str, ast.Module], names: Callable[[ast.Module], Iterator[str]]
) -> Iterator[str]:
    """A line for each name that more than one of the sources defines."""
    homes: dict[str, list[str]] = {}
    for path, tree in sources.items():
        for name in dict.fromkeys(names(tree)):
            homes.setdefault(name, []).append(path)
    yield from (f"{name}: {', '.join(at)}" for name, at in homes.items() if len(at) > 1)


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
