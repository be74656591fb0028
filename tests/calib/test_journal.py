"""A diagnosis that is cut short goes on from the stops whose sums it had."""

import logging
import os
import pickle
import shutil
from contextlib import contextmanager

import numpy as np
import pytest

from calib.effects import find
from calib.linear.clusters import Gradients
from calib.linear.layout import Layout
from calib.linear.linearise import linearise
from calib.linear.rows import State
from calib.outputs import journal
from calib.outputs.journal import Journal, going_on
from calib.outputs.parts import Kept
from calib.problem.build import build
from calib.problem.model import Model, Source
from calib.runs.calibrate import calibrate
from calib.runs.diagnose import diagnose
from calib.runs.explain import explain
from calib.runs.run import DIAGNOSIS
from calib.simulation import Spec, simulate
from chains.errors import InputError

STOPS = ("0 A", "1 B", "2 C")
SMALL = Spec(lidar="hesai_pandarxt32", locations=4, stops_per_location=2, column_step=100)


@pytest.fixture
def unhurried(monkeypatch):
    """As if each stop took long."""
    monkeypatch.setattr(journal, "_SHARE_OF_TIME", np.inf)


def asked_for(folder, size: float = 1.0, kinds=(State,)) -> tuple[list, list[int]]:
    """What stops add to an answer, and which of them had to be worked on for it."""
    worked: list[int] = []

    def compute(some):
        for i in some:
            worked.append(i)
            yield State({"x": np.full(3, i * size)})

    with going_on(Kept(folder)):
        found = list(Journal().each({"size": size}, STOPS, compute, kinds))
    return [state.values["x"][0] for state in found], worked


def files(folder) -> list:
    return sorted(path for path in folder.rglob("*") if path.is_file())


def test_stops_that_are_known_are_not_worked_on_again(tmp_path, unhurried):
    assert asked_for(tmp_path) == ([0.0, 1.0, 2.0], [0, 1, 2])
    assert asked_for(tmp_path) == ([0.0, 1.0, 2.0], [])
    files(tmp_path)[1].unlink()
    values, worked = asked_for(tmp_path)
    assert values == [0.0, 1.0, 2.0] and len(worked) == 1
    # Another question is another answer, whatever is there.
    assert asked_for(tmp_path, 2.0) == ([0.0, 2.0, 4.0], [0, 1, 2])


@pytest.mark.parametrize("damage", [b"", b"x" * 10, None])
def test_a_damaged_file_is_as_none(tmp_path, unhurried, damage):
    asked_for(tmp_path)
    for file in files(tmp_path):
        whole = file.read_bytes()
        file.write_bytes(whole[:-1] + b"?" if damage is None else damage)
    assert asked_for(tmp_path) == ([0.0, 1.0, 2.0], [0, 1, 2])


class Runs:
    """Runs a command where it is opened."""

    def __reduce__(self):
        return os.mkdir, ("ran",)


def test_a_file_of_anything_but_plain_data_is_not_opened(tmp_path, unhurried, monkeypatch):
    """Even if it is sealed as one of rigcal's."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(pickle, "dumps", lambda found, _, of=pickle.dumps: of(Runs()))
    asked_for(tmp_path / "kept")
    assert len(files(tmp_path / "kept")) == len(STOPS)
    monkeypatch.undo()
    assert asked_for(tmp_path / "kept") == ([0.0, 1.0, 2.0], [0, 1, 2])
    assert asked_for(tmp_path / "kept", kinds=()) == ([0.0, 1.0, 2.0], [0, 1, 2])
    assert not (tmp_path / "ran").exists()


def test_what_is_as_soon_computed_again_is_not_kept(tmp_path, monkeypatch):
    monkeypatch.setattr(journal, "_SHARE_OF_TIME", 0.0)
    assert asked_for(tmp_path) == ([0.0, 1.0, 2.0], [0, 1, 2])
    assert not files(tmp_path)


def test_it_takes_no_more_than_its_share_of_the_disk(tmp_path, unhurried, monkeypatch):
    """Of all that a command keeps, in this call and in those that were killed."""
    disk = shutil.disk_usage(tmp_path)
    asked_for(tmp_path / "one")
    size, most = files(tmp_path)[0].stat().st_size, 0.0

    def usage(path):
        taken = sum(file.stat().st_size for file in files(tmp_path / "kept"))
        return disk._replace(free=20 * size * 2 - taken)

    monkeypatch.setattr(journal.shutil, "disk_usage", usage)
    for number in range(1, 5):
        asked_for(tmp_path / "kept" / str(number), number)
        most = max(most, sum(file.stat().st_size for file in files(tmp_path / "kept")))
    assert 3 * size < most <= 4.01 * size
    assert asked_for(tmp_path / "kept" / "9", 9.0) == ([0.0, 9.0, 18.0], [0, 1, 2])


@pytest.mark.parametrize("error", [OSError(28, "No space left"), InputError("no folder")])
def test_on_a_full_disk_all_goes_on_without(tmp_path, unhurried, monkeypatch, error):
    @contextmanager
    def full(path):
        raise error
        yield

    monkeypatch.setattr(journal, "write_atomically", full)
    assert asked_for(tmp_path) == ([0.0, 1.0, 2.0], [0, 1, 2])
    with going_on(Kept(tmp_path)):
        assert Journal().answer({"x": 1.0}, lambda: {"found": np.ones(2)})["found"].sum() == 2.0


@pytest.mark.parametrize("mesh", [True, False])
def test_sums_that_were_kept_are_the_sums(tmp_path, unhurried, mesh):
    """Of two recordings whose stops have the same names, with scatter within holds; of a mesh, and
    of planes."""
    spec = Spec(**{**SMALL.model_dump(), "locations": 1, "column_step": 10, "mesh": mesh})
    for name in ("one", "two"):
        simulate(spec, tmp_path / name, 1 + len(name), {})
    sources = [Source.open(tmp_path / name) for name in ("one", "two")]
    model = Model.of(None, (), (), [tmp_path / "one"]).plus((find("noise_range"),))
    problem = build(sources, model)
    met = [scan.settled(None, problem.initial) for scan in problem.scans]

    def linear():
        with going_on(Kept(tmp_path / "kept")):
            layout = Layout.of(problem)
            gradients = Gradients(layout.size)
            given = {"layout": layout, "gradients": gradients, "journal": Journal()}
            return linearise(problem, problem.initial, met, **given), gradients.table()[0]

    first, again = linear(), linear()
    assert len(files(tmp_path / "kept")) == len(problem.scans) == 4
    np.testing.assert_array_equal(again[0].kept, first[0].kept)
    assert (again[1] != first[1]).nnz == 0 and again[0].beams_cost == first[0].beams_cost


def in_look(number: int):
    """Progress that is interrupted half-way through a look."""
    looks = 0

    def progress(what: str, done: int, total: int) -> None:
        nonlocal looks
        looks += "testing what is missing" in what and done == 0
        if looks >= number and "testing what is missing" in what and done == total // 2:
            raise KeyboardInterrupt

    return progress


@pytest.mark.long
@pytest.mark.usefixtures("unhurried")
def test_a_diagnosis_that_is_cut_short_goes_on(tmp_path, caplog):
    """To the same document, through every fit and look on its way; one that is asked anything else
    begins anew."""
    caplog.set_level(logging.INFO, "rigcal")
    simulate(SMALL, tmp_path / "rec", 1, {"incidence_angle_bias": 1.0})
    run = calibrate(tmp_path / "rec", tmp_path / "run")
    told = diagnose(run).sentences[0]
    assert told.startswith("incidence_angle_bias is missing")
    whole = (run.folder / DIAGNOSIS).read_bytes()
    with pytest.raises(KeyboardInterrupt):
        diagnose(run, in_look(2))
    caplog.clear()
    diagnose(run)
    assert (run.folder / DIAGNOSIS).read_bytes() == whole
    sums = next(r.args[0] for r in caplog.records if "sums of stops" in r.msg)
    assert sums > 8 and "answers of passes" in caplog.text

    with pytest.raises(KeyboardInterrupt):
        diagnose(run, in_look(2))
    caplog.clear()
    diagnose(run, refits=False)
    assert "sums of stops" not in caplog.text
    assert not list(tmp_path.glob(".*.rigcal"))


@pytest.mark.long
@pytest.mark.usefixtures("unhurried")
def test_a_ladder_goes_on_from_the_looks_of_all_its_rungs(tmp_path, caplog):
    caplog.set_level(logging.INFO, "rigcal")
    simulate(SMALL, tmp_path / "rec", 1, {"incidence_angle_bias": 1.0})
    passes = []

    def counting(what: str, done: int, total: int) -> None:
        passes.extend([what] * ("testing what is missing" in what and done == 0))

    whole = explain(tmp_path / "rec", tmp_path / "whole", progress=counting)
    assert len(whole.runs) > 1
    with pytest.raises(KeyboardInterrupt):
        explain(tmp_path / "rec", tmp_path / "cut", progress=in_look(len(passes)))
    caplog.clear()
    again = explain(tmp_path / "rec", tmp_path / "cut")
    sums = next(r.args[0] for r in caplog.records if "sums of stops" in r.msg)
    assert sums > 0 and again.steps[-1]["added"] == whole.steps[-1]["added"]
    for rung in ("00", "01"):
        one, other = (tmp_path / name / rung / DIAGNOSIS for name in ("whole", "cut"))
        assert one.read_text().replace("/whole/", "/cut/") == other.read_text()
    counts = [r.args[0] for r in caplog.records if "sums of stops" in r.msg]
    assert len(counts) == 2  # of the first rung's diagnosis, which was done, too
    assert not list(tmp_path.glob(".*.rigcal"))
