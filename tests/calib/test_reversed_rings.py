"""Rings counted from the other end, as many drivers do: said, and no table by channel is wrong."""

import csv
import json

import numpy as np
import pandas
import pytest

from calib.blunders.told import of_rings, size_told
from calib.exporters import export
from calib.problem.model import Model, Source
from calib.results.rings import misnumbered
from calib.runs.calibrate import calibrate
from calib.runs.diagnose import diagnose
from calib.runs.run import Run
from calib.show.verdict import judge
from calib.simulation import Spec, simulate
from chains.errors import InputError
from sensors.recording import read_table, write_table

from ..mishaps import Scene

SPEC = Spec(lidar="hesai_pandarxt32", locations=2, stops_per_location=3, column_step=250)
EFFECTS = "arm_link_length,arm_joint_offset,ring_elevation_offset,ring_range_offset"
NUMBERED = {"straight": lambda ring: ring, "reversed": lambda ring: 31 - ring,
            "one off": lambda ring: (ring + 1) % 32}  # fmt: skip


def _three_runs(folder):
    """Of one recording, with its rings numbered in three ways."""
    simulate(SPEC, folder / "straight", 1, {"ring_elevation_offset": 1.0})
    scans = {p.name: read_table(p) for p in (folder / "straight/scans").glob("*.parquet")}
    for name, numbered in NUMBERED.items():
        rec = folder / name
        if name != "straight":
            simulate(SPEC, rec, 1, {"ring_elevation_offset": 1.0})
            for scan, columns in scans.items():
                ring = numbered(columns["ring"].astype(int)).astype(np.uint16)
                write_table(rec / "scans" / scan, columns | {"ring": ring})
        model = Model.of(EFFECTS, (), (), [rec])
        calibrate(rec, folder / f"run of {name}", model, hold_out="none")


@pytest.fixture(scope="module")
def runs(once):
    folder = once(_three_runs)
    return {name: Run.open(folder / f"run of {name}") for name in NUMBERED}


def _table(path):
    with path.open() as file:
        rows = [[float(x) for x in row] for row in list(csv.reader(file))[1:]]
    assert [row[0] for row in rows] == list(range(1, 33))
    return np.array(rows)[:, 1:]


def test_the_makers_table_is_by_the_lidars_channels_however_rings_are_counted(runs, tmp_path):
    straight = export(runs["straight"], tmp_path / "a", ["hesai", "rings"])
    other = export(runs["reversed"], tmp_path / "b", ["hesai", "rings"])
    ours, theirs = (_table(tmp_path / f / "hesai_angle_correction.csv") for f in "ba")
    np.testing.assert_allclose(ours, theirs, rtol=0, atol=1e-6)
    by_ring = [pandas.read_csv(tmp_path / f / "rings.csv", comment="#") for f in "ba"]
    offset = [table["elevation_offset_rad"].to_numpy() for table in by_ring]
    np.testing.assert_allclose(offset[0][::-1], offset[1], rtol=0, atol=1e-8)
    assert np.ptp(offset[1]) > 1e-4  # else their order would not matter
    assert not any("the other end" in file.read_text() for file in straight.files)
    for name in ("rings.csv", "hesai_angle_correction.txt"):
        assert "from the other end" in (tmp_path / "b" / name).read_text(), name
    assert any("from the other end" in each for each in other.not_held["hesai"])


def test_a_table_by_channel_is_refused_where_channels_are_not_known(runs, tmp_path):
    with pytest.raises(InputError, match=r"hesai: .* are numbered 1 too high"):
        export(runs["one off"], tmp_path / "out", ["hesai"])
    assert "numbered 1 too high" in export(runs["one off"], tmp_path / "out").left_out["hesai"]


def test_every_command_says_how_rings_are_counted(runs, tmp_path, rigcal):
    run = runs["reversed"]
    said = "are numbered from the other end"
    assert said in " ".join(rigcal("check", run.recordings[0])[1].split())
    (found,) = json.loads((run.folder / "summary.json").read_text())["rings"]
    assert (found["what"], found["lidar"]) == ("reversed", "hesai_pandarxt32")
    assert said in found["sentence"] and runs["straight"].summary["rings"] == []
    assert said in rigcal("export", run.folder, "-o", tmp_path / "out")[1]
    assert said not in rigcal("export", runs["straight"].folder, "-o", tmp_path / "straight")[1]


def test_the_verdict_is_amber_or_red_as_it_matters(runs):
    def told(name):
        verdict = judge(runs[name], None)
        return verdict.light, [each for each in verdict.reasons if each.startswith("rings of")]

    assert told("straight") == ("amber", [])  # as it is not diagnosed
    assert told("reversed")[0] == "amber" and "the other end" in told("reversed")[1][0]
    assert told("one off")[0] == "red" and "1 too high" in told("one off")[1][0]


def test_recordings_of_one_rig_that_are_numbered_alike_are_left_as_they_are(runs):
    """Counted from the other end, offsets by ring are right; but not in one recording of two."""
    straight, other, off = (Source.open(runs[name].recordings[0]) for name in NUMBERED)
    assert misnumbered([straight]) == misnumbered([other]) == misnumbered([other, other]) == []
    for both in ([straight, other], [other, straight]):
        (found,) = misnumbered(both)
        assert found.source is other and found.label == "reversed" and found.apart
    told = of_rings("xt32", found.label, found.finding)
    assert told["recording"] == "reversed" and told["sentence"].startswith("reversed: rings of")
    (found,) = misnumbered([off])
    told = of_rings("xt32", found.label, found.finding)
    assert told["recording"] is None and told["sentence"].startswith("Rings of")
    assert not any(found.apart for found in misnumbered([off, off]))


@pytest.mark.long
@pytest.mark.parametrize("order", [1, -1], ids=["later", "first"])
def test_rings_that_one_recording_of_two_counts_from_the_other_end_are_what_is_wrong(
    once, tmp_path, order
):
    """And neither that offsets by ring changed, nor what follows from it, whichever is given
    first."""
    folder = once(_three_runs)
    scene = Scene(folder / "reversed", np.random.default_rng())
    scene.each_scan(lambda scan: scan | {"x": scan["x"] + np.float32(1e-5)})  # no copies
    run = calibrate(
        [folder / "straight", folder / "reversed"][::order], tmp_path / "run", hold_out="none"
    )
    found = diagnose(run, refits=False)
    assert [b["kind"] for b in found.blunders][:1] == ["rings"]
    assert not any(b["name"] == "ring_range_offset" for b in found.blunders)
    assert found.unexplained == [] and found.sentences[0].startswith("reversed: rings of")


def test_a_size_without_a_unit_has_none():
    assert size_told(0.00195, 0.00011, "1") == "0.00195 ± 0.00011"
    assert size_told(1500.0, 2.0, "1") == "1.5e+03 ± 2"
    assert size_told(0.00195, 0.00011, "m") == "1.95 ± 0.11 mm"
