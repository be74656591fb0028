"""The shape of the house: who imports whom, one door per heavy library, short files, docstrings."""

import ast
import subprocess
import sys
from collections.abc import Iterator
from graphlib import CycleError, TopologicalSorter
from importlib.util import resolve_name
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
PACKAGES = ("chains", "sensors", "calib")  # each may import itself and those before it
DOORS = {
    "PIL": "sensors/readers/packets/osf.py",
    "gtsam": "calib/solve/graph.py",
    "laspy": "sensors/readers/clouds/las.py",
    "matplotlib": "calib/report/plots.py",
    "open3d": "sensors/meshes.py",
    "pyarrow": "sensors/recording.py",
    "trimesh": "sensors/mesh_files.py",
    "pye57": "sensors/readers/clouds/e57.py",
    "rosbags": "sensors/readers/bags/ros.py",
    "viser": "calib/view/server.py",
    "xacrodoc": "chains/readers/xacro.py",
    "yaml": "sensors/documents.py",
}
NOT_AT_STARTUP = {"gtsam", "matplotlib", "open3d", "pyarrow", "pydantic", "scipy", "viser"}
LONGEST_FILE, LONGEST_FUNCTION = 400, 60

SOURCES = {
    path.relative_to(ROOT).as_posix(): ast.parse(path.read_text(encoding="utf-8"))
    for folder in (*PACKAGES, "examples", "tests")
    for path in sorted((ROOT / folder).rglob("*.py"))
}
PACKAGE_SOURCES = {path: tree for path, tree in SOURCES.items() if path.split("/")[0] in PACKAGES}


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


def outside_functions(node: ast.AST) -> Iterator[ast.AST]:
    """Every node that runs, or is type-checked, when the module is imported."""
    for child in ast.iter_child_nodes(node):
        if not isinstance(child, ast.FunctionDef | ast.AsyncFunctionDef | ast.Lambda):
            yield child
            yield from outside_functions(child)


def import_cycle(sources: dict[str, ast.AST]) -> list[str]:
    """The modules of one circle of imports at module level, or nothing."""
    modules = {module_name(path) for path in sources}
    graph = {
        module_name(path): set(imports(path, outside_functions(tree), modules)) & modules
        for path, tree in sources.items()
    }
    try:
        TopologicalSorter(graph).prepare()
    except CycleError as error:
        return error.args[1]
    return []


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


def none(offenders: list[str]) -> None:
    """Fail with one line for each offender."""
    assert not offenders, "\n" + "\n".join(offenders)


def test_packages_import_only_those_before_them():
    none(
        [
            f"{path} imports {name}"
            for path, tree in PACKAGE_SOURCES.items()
            for name in imports(path, ast.walk(tree), set())
            if name.split(".")[0] in PACKAGES[PACKAGES.index(path.split("/")[0]) + 1 :]
        ]
    )


def test_every_folder_of_code_is_a_package():
    """A folder without ``__init__.py`` works in a checkout and is missing from the wheel."""
    none(
        [
            f"{folder} has no __init__.py"
            for folder in sorted({Path(path).parent for path in PACKAGE_SOURCES})
            if not (ROOT / folder / "__init__.py").exists()
        ]
    )


def test_modules_import_each_other_in_no_circle():
    none(import_cycle(PACKAGE_SOURCES))


def test_a_circle_would_be_found():
    sources = {
        "calib/__init__.py": "",
        "calib/a.py": "from calib import b",
        "calib/b.py": "from .c import x",
        "calib/c.py": "import calib.a",
    }
    trees = {path: ast.parse(text) for path, text in sources.items()}
    assert set(import_cycle(trees)) == {"calib.a", "calib.b", "calib.c"}
    trees["calib/c.py"] = ast.parse("def later():\n    import calib.a")
    assert import_cycle(trees) == []


def test_each_heavy_library_has_one_door():
    none(
        [
            f"{path} imports {name}, whose door is {door}"
            for path, tree in PACKAGE_SOURCES.items()
            for name in imports(path, ast.walk(tree), set())
            if (door := DOORS.get(name.split(".")[0], path)) != path
        ]
    )


@pytest.mark.parametrize("arguments", [[], ["--help"]], ids=["import", "help"])
def test_the_command_line_starts_light(arguments):
    if not (ROOT / "calib/cli/__init__.py").exists():
        pytest.skip("calib/cli/__init__.py is not written yet")
    program = (
        "import atexit, sys\n"
        "atexit.register(lambda: print(*sys.modules, file=sys.stderr))\n"
        "from calib.cli import main\n"
        "if sys.argv[1:]: main()\n"
    )
    done = subprocess.run(
        [sys.executable, "-c", program, *arguments], cwd=ROOT, capture_output=True, text=True
    )
    assert done.returncode == 0, done.stderr
    loaded = set(done.stderr.split())
    assert "calib.cli" in loaded
    assert not NOT_AT_STARTUP & loaded


def test_files_are_short():
    lines = {path: len((ROOT / path).read_text().splitlines()) for path in SOURCES}
    none([f"{path}: {n} lines" for path, n in lines.items() if n > LONGEST_FILE])


def test_functions_are_short():
    none(
        [
            f"{path}:{node.lineno} {node.name}: {length} lines"
            for path, tree in SOURCES.items()
            for node in ast.walk(tree)
            if isinstance(node, ast.FunctionDef)
            and (length := node.end_lineno - node.lineno + 1) > LONGEST_FUNCTION
        ]
    )


def test_everything_public_has_a_docstring():
    none(
        [
            name
            for path, tree in PACKAGE_SOURCES.items()
            for name, node in public(tree.body, module_name(path))
            if not ast.get_docstring(node)
        ]
    )


def unannotated(function: ast.FunctionDef) -> list[str]:
    """What of a function has no type: arguments, and `return`."""
    given = function.args
    arguments = [*given.posonlyargs, *given.args, *given.kwonlyargs]
    arguments += filter(None, (given.vararg, given.kwarg))
    lacking = [a.arg for a in arguments if a.annotation is None and a.arg not in ("self", "cls")]
    return lacking + (["return"] if function.returns is None else [])


def test_everything_public_is_typed():
    """A type checker of a user sees the packages' types, as `py.typed` promises."""
    none(
        [
            f"{path}:{node.lineno} {node.name}: {', '.join(lacking)}"
            for path, tree in PACKAGE_SOURCES.items()
            for body in (tree, *(n for n in ast.walk(tree) if isinstance(n, ast.ClassDef)))
            for node in body.body
            if isinstance(node, ast.FunctionDef) and not node.name.startswith("_")
            if (lacking := unannotated(node))
        ]
    )
