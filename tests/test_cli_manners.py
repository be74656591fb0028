"""How much the command line says, to whom, and what it completes."""

import json
import sys

import pytest

from calib.effects import CATALOGUE

from .programs import RIGCAL, execute

SPEC = "{lidar: hesai_pandarxt32, locations: 1, stops_per_location: 2, column_step: 400}"


@pytest.fixture(scope="module")
def spec(tmp_path_factory):
    """A small recording's specification."""
    path = tmp_path_factory.mktemp("manners") / "spec.yaml"
    path.write_text(SPEC)
    return path


def test_quiet_prints_no_prose_and_json_all_the_same(rigcal):
    (_, loud, _), quiet = (rigcal(*words, "effects", "range_offset") for words in ((), ("-q",)))
    assert "range_offset" in loud
    assert quiet == (0, "", "")
    documents = [
        json.loads(rigcal(*words, "effects", "range_offset", "--json")[1])
        for words in ((), ("--quiet",))
    ]
    assert documents[0] == documents[1]
    assert documents[0][0]["name"] == "range_offset"


def test_quiet_does_not_hide_what_is_wrong(rigcal, tmp_path):
    code, out, err = rigcal("-q", "check", tmp_path / "nowhere")
    assert code == 2
    assert out == ""
    assert len(err.strip().splitlines()) == 1


def test_verbose_tells_every_step_where_nobody_looks(rigcal, spec, tmp_path):
    _, _, silent = rigcal("simulate", spec, "-o", tmp_path / "a")
    _, out, verbose = rigcal("-v", "simulate", spec, "-o", tmp_path / "b", "--json")
    assert silent == ""
    lines = verbose.splitlines()
    assert len(lines) >= 2
    seconds = [float(line.split()[0]) for line in lines]
    assert seconds == sorted(seconds)
    assert any(line.endswith("2/2") for line in lines)
    json.loads(out)


def test_nothing_is_coloured_in_a_pipe(tmp_path):
    for words in (("effects",), ("--help",), ("check", tmp_path), ("effects", "nonsense")):
        done = execute([*RIGCAL, *words])
        assert "\x1b" not in done.stdout + done.stderr
        assert done.stdout or done.stderr


def completed(line):
    """What a bash offers for the last word of a line, and the modules that took."""
    program = (
        "import atexit, sys; atexit.register(lambda: print(*sys.modules, file=sys.stderr))\n"
        "from calib.cli import main; main()"
    )
    asked = {"COMP_WORDS": line, "COMP_CWORD": str(line.count(" "))}
    done = execute([sys.executable, "-c", program], _RIGCAL_COMPLETE="complete_bash", **asked)
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
