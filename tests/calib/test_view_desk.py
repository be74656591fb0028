"""The workbench without a browser: runs, ladders, findings, background jobs, bad input."""

import json
import re
import shutil
import signal
import socket
import sys
import urllib.request
from dataclasses import replace
from html.parser import HTMLParser
from urllib.parse import urlsplit

import pytest

from calib.runs.add import add
from calib.runs.ladder import Rung
from calib.runs.run import Run
from calib.view import panels
from calib.view.desk import Desk, Findings
from calib.view.effects.known import told
from calib.view.job import Change, Job
from calib.view.server import serve
from chains.errors import InputError
from tests.calib.viewed import blunder, candidate, diagnosed, grown, small_run
from tests.programs import RIGCAL, execute, started


@pytest.fixture(scope="module")
def made(once) -> Run:
    return Run.open(once(small_run) / "run")


@pytest.fixture
def first(made, tmp_path) -> Run:
    shutil.copytree(made.folder, tmp_path / "run")
    return Run.open(tmp_path / "run")


# -------------------------------------------------------------------------------------------- desk


def test_a_run_brings_those_below_it_and_undo_goes_back(first, tmp_path):
    second = grown(first, tmp_path / "second", "range_scale", 3.0)
    third = grown(second, tmp_path / "third", "faro_scale", 2.0)
    desk = Desk.of([third.folder])
    assert list(desk.runs) == ["run", "second", "third"] and desk.chosen == "third"
    assert [rung.added for rung in desk.rungs()] == [[], ["range_scale"], ["faro_scale"]]
    assert "third stays on disk" in desk.undo() and third.folder.is_dir()
    assert desk.chosen == "second" and len(desk.rungs()) == 2
    desk.undo()
    with pytest.raises(InputError, match="grew from no other run"):
        desk.undo()
    assert desk.chosen == "run"


def test_runs_of_one_name_are_told_apart(first, tmp_path):
    shutil.copytree(first.folder, tmp_path / "b" / "run")
    desk = Desk.of([first.folder, tmp_path / "b" / "run", first.folder])
    assert list(desk.runs) == ["run", str((tmp_path / "b" / "run").resolve())]
    assert desk.run.folder == first.folder


def test_new_runs_go_beside_under_a_name_not_taken(first, tmp_path):
    desk = Desk.of([first.folder])
    assert desk.folder_for("near_range_bias@2") == tmp_path / "run+near_range_bias@2"
    (tmp_path / "run+x").mkdir()
    (tmp_path / "run+x-2").mkdir()
    assert desk.folder_for("x") == tmp_path / "run+x-3"
    assert desk.folder_for("x", "y", dropped=["z"]) == tmp_path / "run+x+y-z"
    assert desk.folder_for(*("x" * 30 for _ in range(3))) == tmp_path / "run-refit"


def test_a_run_that_leaves_something_out_goes_beside_too(first, tmp_path):
    desk = Desk.of([first.folder])
    assert desk.folder_without() == tmp_path / "run-without"
    (tmp_path / "run-without").mkdir()
    assert desk.folder_without() == tmp_path / "run-without-2"


def test_of_several_folders_those_that_are_runs_are_opened(first, tmp_path):
    desk = Desk.of([first.folder, tmp_path / "none"])
    assert list(desk.runs) == ["run"]
    assert len(desk.refused) == 1 and "no run there" in desk.refused[0]
    with pytest.raises(InputError, match="no run there"):
        Desk.of([tmp_path / "none"])


def test_effects_to_add_begin_with_what_was_found(first):
    diagnosed(first.folder)
    offered = Desk.of([first.folder]).addable(Findings.read(first))
    assert list(offered)[:3] == ["incidence_angle_bias", "empirical_range", "range_scale"]
    assert offered["empirical_range"] == {"name": "empirical_range", "basis": ["range"]}
    assert "faro_scale" in offered and "ring_range_offset" not in offered
    undiagnosed = Desk.of([first.folder]).addable(None)
    assert set(offered) - set(undiagnosed) == {"empirical_range"}


def test_a_name_that_something_is_dressed_up_in_is_not_offered_first(first):
    names = [candidate("range_scale", 1, dressed_up=True), candidate("faro_scale", 2)]
    diagnosed(first.folder, candidates=names)
    assert Findings.read(first).worth_adding == ["faro_scale"]


def test_the_curve_is_the_effects_own_or_that_which_stands_out_most(first):
    diagnosed(first.folder)
    found = Findings.read(first)
    assert list(found.curves) == ["range_m", "incidence_rad"]
    assert found.covariate_of("incidence_angle_bias") == "incidence_rad"
    assert found.covariate_of("range_scale") == "range_m"
    assert found.covariate_of("empirical_range") == "range_m"
    assert found.curves["incidence_rad"].stands_out == pytest.approx(2.0)


# ------------------------------------------------------------------ what is known before a refit


def step(name: str, number: int, before: float, after: float) -> dict:
    return candidate(name, number) | {"held_out_rms_mm": {"before": before, "after": after}}


def expected(run: Run, *wanted: str, runs: dict[str, Run] | None = None) -> str:
    """What is told of these effects beside the run's, or of those after "only"."""
    chosen = wanted[1:] if wanted[:1] == ("only",) else (*run.effects, *wanted)
    return told(run, {name: name for name in chosen}, Findings.read(run), runs or {})


def test_what_a_diagnosis_fitted_is_expected_and_nothing_else_is(first):
    """Its steps, one after another, and formulas after them; of all else it fitted nothing."""
    first.summary["rms_mm"]["held_out"] = 7.71
    steps = [step("faro_scale", 2, 3.0, 2.0), step("incidence_angle_bias", 1, 7.71, 3.0)]
    fall = {"before": 2.0, "after": 1.25}
    formula = {"formula": {"name": "empirical_range"}, "held_out_rms_mm": fall}
    diagnosed(first.folder, candidates=[candidate("range_scale"), *steps], unexplained=[formula])
    both = ("incidence_angle_bias", "faro_scale")
    assert "7.71 → 3.00 mm" in expected(first, "incidence_angle_bias")
    assert "7.71 → 2.00 mm" in expected(first, *both)
    assert "7.71 → 1.25 mm" in expected(first, "empirical_range", *both)
    unfitted = [("faro_scale",), ("empirical_range",), ("range_scale",), ("incidence_angle_bias",)]
    unfitted[3:] = [(*both, "range_scale"), ("only", *first.effects[1:], both[0])]
    for wanted in unfitted:
        assert "not known before" in expected(first, *wanted) and "→" not in expected(
            first, *wanted
        )
    assert "explains 0.44 mm" in expected(first, "range_scale")
    assert "effects of the run" in expected(first)
    # A diagnosis that began elsewhere, as without a blunder, tells nothing of this run.
    first.summary["rms_mm"]["held_out"] = 8.0
    assert "not known before" in expected(first, "incidence_angle_bias")
    first.summary["rms_mm"]["held_out"] = None
    assert "No stop was held out" in expected(first, "incidence_angle_bias")


def test_a_run_that_was_fitted_so_is_what_is_expected(first, tmp_path):
    first.summary["rms_mm"]["held_out"] = 7.71
    second = grown(first, tmp_path / "second", "faro_scale", 3.0)
    runs = {"second": second}
    assert "7.71 → 3.00 mm: so it was fitted, as second" in expected(first, "faro_scale", runs=runs)
    assert "3.00 → 7.71 mm" in expected(second, "only", *first.effects, runs={"run": first})
    assert "→" not in expected(first, "faro_scale", "range_scale", runs=runs)
    second.model["fixed"] = ["lidar.tz"]
    assert "→" not in expected(first, "faro_scale", runs=runs)
    second.model["fixed"] = []
    second.model["effects"] = [*first.effects, {"name": "own", "basis": ["ring"]}]
    of = {name: name for name in first.effects}
    for basis, known in (("ring", True), ("ring * 2", False)):
        wanted = of | {"own": {"name": "own", "basis": [basis]}}
        assert ("3.00 mm" in told(first, wanted, None, runs)) is known


OLD = json.dumps({key: [] for key in ("sentences", "unexplained", "curves", "weak_directions")})
OLD = OLD.replace(
    "}", ', "verdict": "", "heading": "", "too_few_stops": false, "candidates": [{}]}'
)


@pytest.mark.parametrize("text", [OLD, "{", "[]", '{"verdict": "adequate"}', '{"curves": [{}]}'])
def test_a_diagnosis_of_another_version_is_said(first, text):
    (first.folder / "diagnosis.json").write_text(text)
    with pytest.raises(InputError, match="diagnose the run again"):
        Findings.read(first)


# ------------------------------------------------------------------------------------------ panels


class Text(HTMLParser):
    """Tags and text of a piece of HTML, as a browser would take it."""

    def __init__(self, html: str) -> None:
        super().__init__()
        self.tags, self.text = [], ""
        self.feed(html)
        self.close()

    def handle_starttag(self, tag, attrs):
        self.tags.append(tag)

    def handle_data(self, data):
        self.text += data


def test_what_is_wrong_is_listed_once(first):
    """In a list of its own, with its buttons, and not among the sentences."""
    wrong = [blunder("s1:base"), blunder("s2:scan")]
    sentences = [wrong[0]["sentence"], "The rest is fine.", wrong[1]["sentence"]]
    diagnosed(first.folder, sentences=sentences, blunders=wrong)
    found = Findings.read(first)
    assert found.blunders == wrong
    said = Text(panels.findings(found)).text
    assert "The rest is fine." in said and "s1:base" not in said and "s2:scan" not in said
    assert all(each["sentence"] in Text(panels.blunders(wrong)).text for each in wrong)


def test_a_stop_says_what_of_it_does_not_fit():
    html = panels.scan(None, 0, "a<b", {"base<1>": 4.5, "beams": 1.0})
    said = Text(html)
    assert "Stop a<b has no scan in this fit." in said.text
    assert "base<1> 4.5, beams 1.0" in said.text and "b" not in said.tags
    loud = html.partition("beams")[0]
    assert "font-weight" in loud and "font-weight" not in html.replace(loud, "")
    assert "sigmas" not in Text(panels.scan(None, 0, "a", {})).text


def test_an_adjusted_p_value_is_told_as_a_number(first):
    """As elsewhere: two digits, and no number below what is known of a tail."""
    each = [candidate(f"range_scale@{i}") | {"p_adjusted": p} for i, p in enumerate((0.26, 1e-6))]
    diagnosed(first.folder, candidates=[*each, candidate("faro_scale") | {"p_adjusted": None}])
    said = panels.findings(Findings.read(first))
    cells = re.findall(r"<td[^>]*>([^<]*)</td>", said.partition("adjusted p</th>")[2])
    assert cells[1::3] == ["0.26", "&lt; 1e-06", ""]


def test_the_ladder_draws_every_rung_and_the_floor_to_scale(first, tmp_path):
    runs = [first, grown(first, tmp_path / "second", "range_scale", 3.0)]
    below = [None, runs[0]]
    rungs = [Rung(run, b) for run, b in zip(runs, below, strict=True)]
    runs[0].summary["rms_mm"] |= {"held_out": 6.0}
    runs[1].summary["rms_mm"] |= {"noise_floor": 1.5}
    html = panels.ladder(rungs)
    widths = [float(x) for x in re.findall(r"width:([\d.]+)%", html)]
    floors = [float(x) for x in re.findall(r"left:([\d.]+)%", html)]
    assert re.findall(r'data-mm="([\d.]+)"', html) == ["6.0000", "3.0000"]
    assert widths[0] == pytest.approx(2 * widths[1], rel=1e-3)
    assert floors == pytest.approx([widths[0] / 4] * 2, rel=1e-3)
    assert "+ range_scale" in Text(html).text and "start: run" in Text(html).text


def test_names_cannot_become_markup(first):
    evil = '<script>alert("x")</script>'
    diagnosed(first.folder, sentences=[evil], candidates=[candidate(evil)])
    rung = Rung(replace(first, model=first.model | {"without": [evil]}), None)
    shown = (panels.note(evil), panels.ladder([rung]), panels.blunders([blunder(evil)]))
    for html in (panels.findings(Findings.read(first)), *shown):
        assert "script" not in Text(html).tags and evil in Text(html).text


# -------------------------------------------------------------------------------------------- jobs


def test_a_job_that_cannot_be_done_ends_in_its_sentence(first, tmp_path):
    *_, last = Job(first.folder, Change(tmp_path / "out", ["no_such_effect"])).listen()
    assert last.kind == "failed" and "not in the catalogue" in last.text
    assert not (tmp_path / "out").exists()


@pytest.mark.long
def test_a_job_leaves_out_what_rigcal_add_leaves_out(first, tmp_path):
    token = "L01P01:base_markers"
    job = Job(first.folder, Change(tmp_path / "out", without=[token]))
    for each in job.listen():
        if each.kind == "run":
            job.stop()
    wanted = add(first, [], tmp_path / "wanted", without=[token])
    found = Run.open(tmp_path / "out")
    assert found.model == wanted.model and found.left_out == [token]
    rms = [r.summary["rms_mm"]["fit"] for r in (found, wanted)]
    assert rms[0] == pytest.approx(rms[1], rel=1e-9)
    desk = Desk.of([found.folder])
    said = Text(panels.ladder(desk.rungs())).text
    assert f"Left out: {token}" in said and f"without {token}" in said
    assert "Left out" not in Text(panels.ladder(desk.rungs()[:1])).text


def test_a_job_that_is_stopped_leaves_nothing(first, tmp_path):
    before = sorted(path.name for path in tmp_path.iterdir())
    job = Job(first.folder, Change(tmp_path / "out", ["range_scale"]))
    heard = job.listen()
    assert next(heard).kind == "progress"
    during = {path.name for path in tmp_path.iterdir()} - set(before)
    assert len(during) == 1 and during.pop().startswith(".out.")
    job.stop()
    assert [each.kind for each in heard] == ["stopped"]
    assert sorted(path.name for path in tmp_path.iterdir()) == before


@pytest.mark.long
def test_a_job_makes_the_run_that_rigcal_add_makes(first, tmp_path):
    from calib.runs.calibrate import grow, grown_model

    formula = {"name": "humid", "site": "range", "unit": "1", "sigma": 0.01, "basis": ["range"]}
    heard = []
    job = Job(first.folder, Change(tmp_path / "out", [formula]))
    for each in job.listen():
        heard.append(each)
        if each.kind == "run":
            job.stop()
    *progress, made, last = heard
    assert (made.text, last.kind) == (str(tmp_path / "out"), "stopped")
    assert all(0 < each.share <= 1 for each in progress)
    mine = tmp_path / "mine.yaml"
    mine.write_text(json.dumps(formula))
    wanted = grow(first, grown_model(first, [str(mine)]), tmp_path / "wanted")
    found = Run.open(tmp_path / "out")
    assert found.model == wanted.model and found.grown_from == first.folder.resolve()
    rms = [r.summary["rms_mm"]["fit"] for r in (found, wanted, first)]
    assert rms[0] == pytest.approx(rms[1], rel=1e-9) and rms[0] != rms[2]


# ------------------------------------------------------------------------------------ command line


@pytest.mark.long
def test_view_serves_this_machine_alone_and_ends_with_ctrl_c(first):
    command = [*RIGCAL, "view", first.folder, "--no-open"]
    with started([*command, "--json"]) as process:
        text = ""
        while "}" not in text:
            text += process.stdout.readline()
        url = json.loads(text)["url"]
        host, port = urlsplit(url).netloc.split(":")
        assert host == "127.0.0.1"
        page = urllib.request.urlopen(url, timeout=30).read()
        assert b"<html" in page[:500].lower()
        with pytest.raises(OSError):  # nobody listens at this machine's other addresses
            socket.create_connection(("127.0.0.2", int(port)), timeout=5)
        taken = execute([*command, "--port", port])
        assert taken.returncode == 2
        assert f"--port {port} is taken" in taken.stderr
        process.send_signal(signal.SIGINT)
        assert process.wait(30) == 0
        assert process.stdout.read() == ""


def test_no_page_can_open_a_tunnel_to_the_outside(monkeypatch):
    viser = pytest.importorskip("viser")
    monkeypatch.setattr(viser._viser, "ViserTunnel", None)  # calling it would fail
    served = serve(0)
    try:
        assert served.server.request_share_url() is None
        assert served.server._share_tunnel is None
    finally:
        served.stop()


def test_a_missing_library_is_said(monkeypatch):
    monkeypatch.setitem(sys.modules, "viser", None)
    with pytest.raises(InputError, match=re.escape("pip install 'rigcal[view]'")):
        serve(0)


def test_view_of_no_run_is_one_sentence(tmp_path):
    done = execute([*RIGCAL, "view", tmp_path])
    assert done.returncode == 2
    said = done.stderr.strip().splitlines()
    assert len(said) == 1 and "no run there" in said[0] and "rigcal fit" in said[0]
