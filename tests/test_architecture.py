"""The shape of the house: who imports whom, one door per heavy library, small files and calls."""

import ast
import subprocess
import sys
from collections import Counter
from functools import cache
from pathlib import Path

import pytest

from .sources import (
    TAKES_APART,
    calls,
    every_argument,
    filled_classes,
    import_cycle,
    imports,
    module_name,
    public,
    public_classes,
    public_constants,
    shared,
    upward,
    walks_over_sets,
    wide_calls,
)

ROOT = Path(__file__).resolve().parents[1]
PACKAGES = ("chains", "sensors", "calib")  # each may import itself and those before it
DOORS = {
    "PIL": "sensors/readers/packets/osf.py",
    "dask": "calib/linear/parallel/cluster.py",
    "distributed": "calib/linear/parallel/cluster.py",
    "fsspec": "chains/remote.py",
    "gtsam": "calib/solve/graph.py",
    "laspy": "sensors/readers/clouds/las.py",
    "matplotlib": "calib/report/plots.py",
    "numba": "calib/residuals/compiled.py",
    "open3d": "sensors/meshes.py",
    "pyarrow": "sensors/recording.py",
    "trimesh": "sensors/readers/meshes/mesh_files.py",
    "pye57": "sensors/readers/clouds/e57.py",
    "rosbags": "sensors/readers/bags/ros.py",
    "viser": "calib/view/server.py",
    "xacrodoc": "chains/readers/xacro.py",
    "yaml": "sensors/documents.py",
}
NOT_AT_STARTUP = {"distributed", "gtsam", "matplotlib", "numba", "open3d", "pyarrow", "pydantic"}
NOT_AT_STARTUP |= {"fsspec", "scipy", "viser"}
LONGEST_FILE, LONGEST_FUNCTION = 400, 60
MOST_FILES = 12  # a room, beside its __init__.py
MOST_PARAMETERS, MOST_POSITIONAL = 12, 4

# From the ground up: a room may import itself and those before it, in functions and for types too.
# What lies beside the rooms of a package is their ground; its __init__.py stands above them all.
ROOMS = {
    "chains": ("readers",),
    "sensors": ("readers",),
    "sensors.readers": ("tables", "clouds", "poses", "meshes", "arms", "packets", "bags"),
    "calib": (
        *("outputs", "rig", "effects", "forward", "residuals", "problem", "linear", "solve"),
        *("results", "blunders", "diagnosis", "recalibration"),
        *("runs", "planning"),
        *("show", "simulation", "evaluation", "intake", "exporters", "report", "view"),
        "cli",
    ),
}
# Rooms that know unknowns. What one is says its `Unknown`; its name is made, and not taken apart.
# Beside them what takes other texts apart: what users type, files, sentences, columns and units.
KNOWING_UNKNOWNS = ("forward", "residuals", "problem", "linear", "solve", "results", "blunders")
KNOWING_UNKNOWNS += ("diagnosis", "recalibration", "runs", "planning")
TEXTS = {
    "calib/blunders/told.py": "directions, in sentences",
    "calib/diagnosis/structure/empirical.py": "families of effects, for a formula",
    "calib/diagnosis/formulas/factors.py": "columns",
    "calib/diagnosis/formulas/found.py": "columns, sites and texts of formulas",
    "calib/diagnosis/formulas/seen.py": "sentences",
    "calib/diagnosis/rejects/found.py": "units of columns",
    "calib/diagnosis/suggest.py": "units of columns",
    "calib/diagnosis/verdict/sentences.py": "sentences",
    "calib/planning/purpose.py": "--for",
    "calib/planning/tolerance.py": "--until",
    "calib/problem/model.py": "--fix",
    "calib/problem/without.py": "--without",
    "calib/residuals/groups.py": "--without",
    "calib/results/outstanding.py": "keys of summary.json",
    "calib/results/stages.py": "what progress says",
    "calib/runs/calibrate.py": "effects that `add` names",
    "calib/runs/diagnose.py": "sentences",
    "calib/runs/estimates.py": "solution.yaml",
    "calib/runs/reopen.py": "state.npz",
    "calib/runs/run.py": "state.npz",
}
AT_THE_ROOT_OF_CALIB = {"__init__", "forward"}


@cache
def sources() -> dict[str, ast.Module]:
    """Every source by its path. No worker reads them but the one that runs these tests."""
    return {
        path.relative_to(ROOT).as_posix(): ast.parse(path.read_text(encoding="utf-8"))
        for folder in (*PACKAGES, "examples", "tests")
        for path in sorted((ROOT / folder).rglob("*.py"))
    }


@cache
def packages() -> dict[str, ast.Module]:
    """Those of the packages."""
    return {path: tree for path, tree in sources().items() if path.split("/")[0] in PACKAGES}


def none(offenders: list[str]) -> None:
    """Fail with one line for each offender."""
    assert not offenders, "\n" + "\n".join(offenders)


def test_packages_import_only_those_before_them():
    none(
        [
            f"{path} imports {name}"
            for path, tree in packages().items()
            for name in imports(path, ast.walk(tree), set())
            if name.split(".")[0] in PACKAGES[PACKAGES.index(path.split("/")[0]) + 1 :]
        ]
    )


def test_the_simulator_shares_nothing_of_the_fit():
    """A world that shares the model's surfaces and rows tests nothing."""
    none(
        [
            f"{path} imports {name}"
            for path, tree in packages().items()
            if path.startswith("calib/simulation/")
            for name in imports(path, ast.walk(tree), set())
            if name.startswith(("calib.residuals", "calib.linear", "calib.solve"))
        ]
    )


def test_an_unknown_is_born_among_the_problems():
    none(
        [
            f"{path}:{line}"
            for path, tree in packages().items()
            if not path.startswith("calib/problem/")
            for line in calls(tree, {"Unknown"})
        ]
    )


def test_no_name_of_an_unknown_is_taken_apart():
    rooms = {path: path.split("/")[1].removesuffix(".py") for path in packages()}
    mine = {p: t for p, t in packages().items() if rooms[p] in KNOWING_UNKNOWNS}
    found = {path: list(calls(tree, TAKES_APART)) for path, tree in mine.items()}
    none([f"{path}:{line}" for path, some in found.items() if path not in TEXTS for line in some])
    none([f"{path} takes no text apart" for path in TEXTS if not found[path]])


def test_a_name_that_is_taken_apart_would_be_found():
    bad = ("n.rpartition('.')[0]", "[n for n in x if n.startswith('a')]", "f(n).removesuffix(SD)")
    assert [list(calls(ast.parse(text), TAKES_APART)) for text in bad] == [[1]] * 3
    assert list(calls(ast.parse("np.split(a, 2)\nUnknown(x)"), {*TAKES_APART, "Unknown"})) == [2]


def test_every_folder_of_code_is_a_package():
    """A folder without ``__init__.py`` works in a checkout and is missing from the wheel."""
    none(
        [
            f"{folder} has no __init__.py"
            for folder in sorted({Path(path).parent for path in packages()})
            if not (ROOT / folder / "__init__.py").exists()
        ]
    )


def test_rooms_import_only_those_before_them():
    none(sorted(upward(packages(), ROOMS)))


def test_every_room_has_its_place():
    folders = {module_name(path).rpartition(".")[0] for path in packages()}
    for package, rooms in ROOMS.items():
        inner = (f.removeprefix(f"{package}.") for f in folders if f.startswith(f"{package}."))
        assert {name.split(".")[0] for name in inner} <= set(rooms)


def test_a_room_that_imports_one_above_it_would_be_found():
    sources = {
        "calib/solve/fit.py": "from calib.rig import x\ndef later():\n    from calib.runs import y",
        "calib/runs/__init__.py": "if TYPE_CHECKING:\n    from calib.solve.fit import z",
        "calib/rig/__init__.py": "",
        "sensors/stops.py": "import sensors.readers.base",
        "sensors/readers/base.py": "from sensors import stops",
    }
    trees = {path: ast.parse(text) for path, text in sources.items()}
    lines = {"calib.solve imports calib.runs", "sensors.stops imports sensors.readers"}
    assert set(upward(trees, ROOMS)) == lines


def test_modules_import_each_other_in_no_circle():
    none(import_cycle(packages()))


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
    assert set(import_cycle(trees)) == {"calib.a", "calib.b", "calib.c"}
    trees["calib/c.py"] = ast.parse("import calib")
    assert import_cycle(trees) == []


def test_each_heavy_library_has_one_door():
    none(
        [
            f"{path} imports {name}, whose door is {door}"
            for path, tree in packages().items()
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


def test_nothing_else_lies_at_the_root_of_calib():
    at_root = {Path(path).stem for path in packages() if Path(path).parent == Path("calib")}
    assert at_root == AT_THE_ROOT_OF_CALIB


def test_rooms_are_small():
    files = Counter(Path(p).parent.as_posix() for p in packages() if "__init__" not in p)
    none([room for room, count in files.items() if count > MOST_FILES])


def test_files_are_short():
    lines = {path: len((ROOT / path).read_text().splitlines()) for path in sources()}
    none([f"{path}: {n} lines" for path, n in lines.items() if n > LONGEST_FILE])


def test_functions_are_short():
    none(
        [
            f"{path}:{node.lineno} {node.name}: {length} lines"
            for path, tree in sources().items()
            for node in ast.walk(tree)
            if isinstance(node, ast.FunctionDef)
            and (length := node.end_lineno - node.lineno + 1) > LONGEST_FUNCTION
        ]
    )


def test_functions_take_few_parameters():
    """Commands, too: those with more options take the fields of a dataclass."""
    none(
        [
            f"{path}:{node.lineno} {node.name}: {count} parameters"
            for path, tree in sources().items()
            for node in ast.walk(tree)
            if isinstance(node, ast.FunctionDef)
            if (count := len(every_argument(node))) > MOST_PARAMETERS
        ]
    )


def test_fields_are_filled_by_keyword():
    """Where there are more than a few fields, a position says too little."""
    classes = filled_classes(sources())
    none(
        [
            f"{path}:{line}"
            for path, tree in sources().items()
            for line in wide_calls(path, tree, classes, MOST_POSITIONAL)
        ]
    )


def test_a_wide_call_would_be_found():
    made = "    @classmethod\n    def of(cls):\n        return cls(1, 2, 3, 4, 5)"
    fields = "; ".join(f"{name}: int" for name in "vwxyz")
    sources = {
        "calib/a.py": "@dataclass(frozen=True)\nclass A:\n    x: int\nA(1, 2, 3, 4, 5)",
        "calib/b.py": "from calib.a import A as B\nB(1, 2, 3, 4, *five)\nB(1, 2, 3, 4, e=5)",
        "calib/c.py": "from calib import A\nA(1, 2, 3, 4, 5)",
        "calib/d.py": "from elsewhere import A\nA(1, 2, 3, 4, 5)",
        "calib/e.py": f"@dataclass\nclass E:\n    x: int\n{made}\nclass Other:\n{made}",
        "calib/f.py": f"class F(NamedTuple):\n    {fields}\nF(1, *four)\nF(1, *three, z=1)\nF(1)",
    }
    trees = {path: ast.parse(text) for path, text in sources.items()}
    classes = filled_classes(trees)
    calls = [list(wide_calls(path, tree, classes, 4)) for path, tree in trees.items()]
    assert calls == [["4 A"], ["2 B"], ["2 A"], [], ["6 E"], ["3 F"]]


def test_a_name_of_a_class_means_one_thing():
    none(list(shared(packages(), public_classes)))


def test_a_name_of_a_constant_means_one_thing():
    none(list(shared(packages(), public_constants)))


def test_a_name_of_two_things_would_be_found():
    sources = {
        "calib/a.py": "class A: pass\nclass _Own: pass\nMOST = 1\nLEAST, _OWN = 2, 3\nT = T_a = 4",
        "calib/b.py": "from calib.a import A, MOST\nclass B: pass\nclass _Own: pass\n_OWN = T = 5",
        "calib/c.py": "class A: pass\nMOST: int = 6\nLEAST = MOST\nLEAST += 1\nT_a = 7",
    }
    trees = {path: ast.parse(text) for path, text in sources.items()}
    assert list(shared(trees, public_classes)) == ["A: calib/a.py, calib/c.py"]
    twice = ["MOST: calib/a.py, calib/c.py", "LEAST: calib/a.py, calib/c.py"]
    assert list(shared(trees, public_constants)) == twice


def test_nothing_follows_the_order_of_a_set():
    """Texts hash otherwise each time Python starts: what is made in a set's order is chance."""
    none([f"{path}:{w}" for path, tree in packages().items() for w in walks_over_sets(tree)])


def test_a_walk_over_a_set_would_be_found():
    bad = (
        *("for x in {'a', 'b'}: pass", "y = [x for x in a.keys() & b]"),
        *("', '.join(set(a) - {'b'})", "list(c | {*b})", "dict.fromkeys(a.intersection(b))"),
    )
    good = ("for x in sorted({1}): pass", "y = {x for x in {1}}", "z = len({1} & {2})", "1 in {1}")
    assert [len(list(walks_over_sets(ast.parse(text)))) > 0 for text in bad] == [True] * 5
    assert [list(walks_over_sets(ast.parse(text))) for text in good] == [[]] * 4


def test_everything_public_has_a_docstring():
    none(
        [
            name
            for path, tree in packages().items()
            for name, node in public(tree.body, module_name(path))
            if not ast.get_docstring(node)
        ]
    )


def unannotated(function: ast.FunctionDef) -> list[str]:
    """What of a function has no type: arguments, and `return`."""
    arguments = every_argument(function)
    lacking = [a.arg for a in arguments if a.annotation is None and a.arg not in ("self", "cls")]
    return lacking + (["return"] if function.returns is None else [])


def test_everything_public_is_typed():
    """A type checker of a user sees the packages' types, as `py.typed` promises."""
    none(
        [
            f"{path}:{node.lineno} {node.name}: {', '.join(lacking)}"
            for path, tree in packages().items()
            for body in (tree, *(n for n in ast.walk(tree) if isinstance(n, ast.ClassDef)))
            for node in body.body
            if isinstance(node, ast.FunctionDef) and not node.name.startswith("_")
            if (lacking := unannotated(node))
        ]
    )
