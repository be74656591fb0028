"""Same input, same bytes: all files of all commands, whatever the hashes, threads and folder.

The one exception is ``seconds`` of summary.json, which the contract wants there.
"""

import json
import re
import sys
from pathlib import Path

import pytest

from calib.cli.app import app

from .programs import execute, rigcal

HERE = "{lidar: hesai_pandarxt32, locations: 3, stops_per_location: 2, column_step: 200}"
MINE = "{name: mine, site: range, unit: '1', sigma: 0.01, basis: [(humidity - 0.45) * range]}"
COMMANDS = """
simulate ../spec.yaml -o rec --seed 3
import table {rec}/stops.csv mesh {rec}/reference/mesh.ply -o imported --rig {rec}/rig.yaml
explain {rec} -o ladder --fix lidar.tz --workers {n}
fit {rec} -o run --effects ring_range_offset --hold-out none --workers {n}
add run arm_gravity_sag ../mine.yaml -o deeper/run --workers {n}
fit {other} -o later --prior run --hold-out stop --without L01P01:joint_2 --workers {n}
diagnose later --candidates ../mine.yaml --workers {n}
plan later --stops 2 --candidates 60 -o stops.csv --workers {n}
evaluate deeper/run
report later -o report.html
plot run rings -o rings.svg
plot run rings -o rings.pdf
plot run rings -o rings.png
effects incidence_angle_bias -o incidence.png
export deeper/run -o export
apply run {rec} -o applied
"""
# Of these the output is compared, and of all others what they write.
SAYING = """
check {rec} --json
compare run deeper/run later --json
moved run deeper/run --json
effects --json
reproduce deeper/run --json
plan later --stops 1 --for lidar,arm_gravity_sag --candidates 60 --json
"""
SERVING = {"view"}
WAYS = {  # PYTHONHASHSEED, threads of a BLAS call, processes over stops
    "a": ("1", "1", "1"),
    "b/c": ("20240", "3", "3"),
}
LIMIT_S = 270  # of all commands: they share a process, as starting takes long
# Runs its arguments as commands; what each says goes to a file, by whether it writes, and its name.
PROGRAM = """
import contextlib, shlex, sys
from calib.cli import main
for k, line in enumerate(sys.argv[1:]):
    sys.argv[1:] = shlex.split(line)
    what = "saying" if "--json" in sys.argv else "writing"
    with open(f"{what}-{k}-{sys.argv[1]}.txt", "w") as said, contextlib.redirect_stdout(said):
        try:
            main()
        except SystemExit as end:
            assert end.code in (0, 3), line
"""


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """Two folders in which the same commands were run."""
    folder = tmp_path_factory.mktemp("bytes")
    (folder / "spec.yaml").write_text(HERE)
    rigcal(["simulate", "spec.yaml", "-o", "rec", "--hide", "arm_gravity_sag=2"], folder)
    rigcal(["simulate", "spec.yaml", "-o", "other", "--seed", "3"], folder)
    found = []
    for way, (seed, threads, workers) in WAYS.items():
        where = folder / way
        where.mkdir(parents=True)
        (where.parent / "spec.yaml").write_text(HERE)
        (where.parent / "mine.yaml").write_text(MINE)
        variables = {"PYTHONHASHSEED": seed, "TZ": f"UTC{-int(threads)}"}
        variables |= {f"{x}_NUM_THREADS": threads for x in ("MKL", "OMP", "OPENBLAS")}
        lines = (COMMANDS + SAYING).format(rec=folder / "rec", other=folder / "other", n=workers)
        command = [sys.executable, "-c", PROGRAM, *filter(None, lines.split("\n"))]
        done = execute(command, where, limit_s=LIMIT_S, **variables)
        assert done.returncode == 0, done.stderr
        found.append(where)
    return found


def written(folder: Path) -> dict[str, bytes]:
    """Every file that commands wrote below a folder, and what those said that write nothing."""
    files = {path.relative_to(folder).as_posix(): path for path in folder.rglob("*")}
    return {
        name: without_seconds(path, folder)
        for name, path in files.items()
        if path.is_file() and not name.startswith("writing")
    }


def without_seconds(path: Path, folder: Path) -> bytes:
    data = path.read_bytes()
    if path.name.startswith("saying"):  # a terminal may be told where things lie
        return data.replace(str(folder).encode(), b"HERE")
    if path.name == "summary.json":
        data, count = re.subn(rb'^ "seconds": [0-9.e-]+,?\n', b"", data, flags=re.M)
        assert count == 1
    return data


@pytest.mark.long
def test_files_are_the_same_byte_by_byte(made):
    one, other = map(written, made)
    assert one.keys() == other.keys() and len(one) > 100
    assert [name for name in one if one[name] != other[name]] == []


@pytest.mark.long
def test_no_file_says_where_it_lies(made):
    """Or two folders would differ by it; recordings are told by their path, as they are given."""
    for folder in made:
        files = {n: data for n, data in written(folder).items() if not n.startswith("saying")}
        assert [name for name, data in files.items() if str(folder).encode() in data] == []


def test_every_command_is_among_them():
    names = {c.name or c.callback.__name__ for c in app.registered_commands}
    tried = {line.split()[0] for line in (COMMANDS + SAYING).split("\n") if line}
    assert tried | SERVING == names


@pytest.mark.long
def test_what_is_made_again_is_identical(made):
    said = (next(folder.glob("saying-*-reproduce.txt")) for folder in made)
    documents = [json.loads(path.read_text()) for path in said]
    assert [each["identical"] for each in documents] == [True, True]
