"""Beams that are noisier than stated are told as that, not as structure or scatter of stops."""

import shutil

import numpy as np
import pytest

from calib.diagnosis.chance.beams import BeamScatter
from calib.problem import build
from calib.problem.model import Model, Source
from calib.runs.calibrate import calibrate
from calib.runs.diagnose import diagnose
from calib.simulation import Spec, simulate
from calib.solve.fit import solve
from sensors.recording import read_table, write_table

SPEC = Spec(lidar="hesai_pandarxt32", locations=4, stops_per_location=3, column_step=20)
EXTRA_M = 0.0016  # about twice the noise of means over a hold


@pytest.fixture(scope="module")
def sound(tmp_path_factory):
    folder = tmp_path_factory.mktemp("beams") / "rec"
    simulate(SPEC, folder, 6)
    return folder


def longer(sound, folder, extra_m):
    """The recording with ranges longer by what a function of a stop's table says."""
    shutil.copytree(sound, folder)
    for path in sorted((folder / "scans").glob("*.parquet")):
        table = read_table(path)
        xyz = np.stack([table[c] for c in "xyz"], axis=1).astype(float)
        range_m = np.linalg.norm(xyz, axis=1)
        times = 1.0 + extra_m(table) / np.maximum(range_m, 0.1)
        xyz = (xyz * np.where(range_m > 0.1, times, 1.0)[:, None]).astype("f4")
        write_table(path, table | dict(zip("xyz", xyz.T, strict=True)))
    return folder


def blocks(rng):
    """By chance, but alike in four rings of four columns each."""

    def extra(table):
        ring, column = np.unique(table["ring"], return_inverse=True)[1], table["column"]
        column = np.unique(column, return_inverse=True)[1]
        drawn = rng.normal(size=(ring.max() // 4 + 1, column.max() // 4 + 1))
        return EXTRA_M * drawn[ring // 4, column // 4]

    return extra


def patterns(rng):
    """By chance, but the same for a beam at every stop."""
    drawn = rng.normal(size=(200, 4000))
    return lambda table: EXTRA_M * drawn[table["ring"], table["column"]]


def scatter(folder):
    source = Source.open(folder)
    return BeamScatter.of(solve(build([source], Model())))


@pytest.mark.long
def test_what_each_beam_does_by_itself_is_told_from_what_they_have_in_common(sound, tmp_path):
    rng = np.random.default_rng(4)
    noisy = longer(sound, tmp_path / "noisy", lambda t: EXTRA_M * rng.normal(size=len(t["x"])))
    none, more = scatter(sound), scatter(noisy)
    assert none.times == pytest.approx(1.0, abs=0.08) and none.common < 0.05
    assert more.times > 1.8 and more.common < 0.03
    for name, extra in (("blocks", blocks(rng)), ("patterns", patterns(rng))):
        alike = scatter(longer(sound, tmp_path / name, extra))
        assert alike.times > 1.5 and alike.common > 0.4, name
        assert alike.alone < 1 + 0.5 * (alike.times - 1), name


@pytest.mark.long
def test_a_lidar_noisier_than_stated_is_told_as_that_and_lacks_no_effect(sound, tmp_path):
    """It was told as structure that no effect explains, at p = 1, and as scatter of stops."""
    rng = np.random.default_rng(5)
    noisy = longer(sound, tmp_path / "rec", lambda t: EXTRA_M * rng.normal(size=len(t["x"])))
    found = diagnose(calibrate([noisy], tmp_path / "run"))
    assert found.verdict == "adequate"
    assert any("noise model says, each beam by itself" in each for each in found.sentences)
    assert not any(c["step"] for c in found.candidates)
