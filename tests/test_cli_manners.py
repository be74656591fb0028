"""How much the command line says, to whom, and what it completes."""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

from calib.effects import CATALOGUE

ROOT = Path(__file__).resolve().parents[1]
PROGRAM = "import sys; from calib.cli import main; main()"
SPEC = "{lidar: hesai_pandarxt32, locations: 1, stops_per_location: 2, column_step: 400}"


def rigcal(*arguments, program=PROGRAM, **environment):
    """The command in a process of its own, its streams pipes."""
    return subprocess.run(
        [sys.executable, "-c", program, *map(str, arguments)],
        cwd=ROOT,
        env=os.environ | environment,
        capture_output=True,
        text=True,
    )


@pytest.fixture(scope="module")
def spec(tmp_path_factory):
    """A small recording's specification."""
    path = tmp_path_factory.mktemp("manners") / "spec.yaml"
    path.write_text(SPEC)
    return path


def test_quiet_prints_no_prose_and_json_all_the_same(spec):
    loud, quiet = (rigcal(*words, "effects", "range_offset") for words in ((), ("-q",)))
    assert "range_offset" in loud.stdout
    assert (quiet.returncode, quiet.stdout, quiet.stderr) == (0, "", "")
    documents = [
        json.loads(rigcal(*words, "effects", "range_offset", "--json").stdout)
        for words in ((), ("--quiet",))
    ]
    assert documents[0] == documents[1]
    assert documents[0][0]["name"] == "range_offset"


def test_quiet_does_not_hide_what_is_wrong(tmp_path):
    done = rigcal("-q", "check", tmp_path / "nowhere")
    assert done.returncode == 2
    assert done.stdout == ""
    assert len(done.stderr.strip().splitlines()) == 1


def test_verbose_tells_every_step_where_nobody_looks(spec, tmp_path):
    silent = rigcal("simulate", spec, "-o", tmp_path / "a")
    verbose = rigcal("-v", "simulate", spec, "-o", tmp_path / "b", "--json")
    assert silent.stderr == ""
    lines = verbose.stderr.splitlines()
    assert len(lines) >= 2
    seconds = [float(line.split()[0]) for line in lines]
    assert seconds == sorted(seconds)
    assert any(line.endswith("2/2") for line in lines)
    json.loads(verbose.stdout)


def test_nothing_is_coloured_in_a_pipe(tmp_path):
    for words in (("effects",), ("--help",), ("check", tmp_path), ("effects", "nonsense")):
        done = rigcal(*words)
        assert "\x1b" not in done.stdout + done.stderr
        assert done.stdout or done.stderr


def completed(line):
    """What a bash offers for the last word of a line, and the modules that took."""
    program = (
        "import atexit, sys; atexit.register(lambda: print(*sys.modules, file=sys.stderr))\n"
        + PROGRAM
    )
    words = line.split(" ")
    done = rigcal(
        program=program,
        _RIGCAL_COMPLETE="complete_bash",
        COMP_WORDS=line,
        COMP_CWORD=str(len(words) - 1),
    )
    return done.stdout.split(), set(done.stderr.split())


@pytest.mark.parametrize(
    ("line", "offered"),
    [
        ("rigcal exp", {"explain", "export"}),
        ("rigcal add RUN ring_range", {"ring_range_offset"}),
        ("rigcal effects noise_", {"noise_range", "noise_incidence", "noise_intensity"}),
        ("rigcal effects ", {effect.name for effect in CATALOGUE}),
        ("rigcal effects zz", set()),
    ],
)
def test_a_shell_completes_commands_and_effects_at_once(line, offered):
    words, modules = completed(line)
    assert set(words) == offered
    assert not {"numpy", "scipy", "gtsam", "calib.effects"} & modules
