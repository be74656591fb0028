"""A diagnosis that is cut short goes on from the stops whose sums it had."""

import logging
import os
import pickle

import numpy as np
import pytest

from calib.linear.rows import State
from calib.outputs import journal
from calib.outputs.journal import Journal, going_on
from calib.outputs.parts import Kept
from calib.runs.calibrate import calibrate
from calib.runs.diagnose import diagnose
from calib.runs.explain import explain
from calib.runs.run import DIAGNOSIS
from calib.simulation import Spec, simulate

STOPS = ("0 A", "1 B", "2 C")
SMALL = Spec(lidar="hesai_pandarxt32", locations=4, stops_per_location=2, column_step=100)


@pytest.fixture
def unhurried(monkeypatch):
    """As if each stop took long."""
    monkeypatch.setattr(journal, "_WRITTEN_BYTES_PER_S", 1e30)


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
    monkeypatch.setattr(journal, "_WRITTEN_BYTES_PER_S", 1e-9)
    asked_for(tmp_path)
    assert not files(tmp_path)
    monkeypatch.setattr(journal, "_WRITTEN_BYTES_PER_S", 1e30)
    monkeypatch.setattr(journal, "_SHARE_OF_DISK", 0.0)  # nor where the disk is full
    asked_for(tmp_path)
    assert not files(tmp_path)


def in_look(number: int):
    """Progress that is interrupted half-way through a look."""
    looks = 0

    def progress(what: str, done: int, total: int) -> None:
        nonlocal looks
        looks += "testing what is missing" in what and done == 0
        if looks >= number and "testing what is missing" in what and done == total // 2:
            raise KeyboardInterrupt

    return progress


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
