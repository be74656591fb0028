"""What several recordings of a rig contradict each other by, where no fit takes them together."""

import re
import shutil

import numpy as np
import open3d as o3d
import pytest

from calib import diagnose, fit
from calib.runs.calibrate import calibrate
from chains import se3

from ..mishaps import Scene
from .bumps import bumped

ANEW = np.array([0.0, 0.0, 0.4, 0.5, -0.3, 0.1])  # rad, m: where the scanner stood the other time


def scanned_anew(recording, by=ANEW):
    """Mesh and spheres in another frame of the scanner."""
    T = se3.exp(by)
    path = str(recording / "reference/mesh.ply")
    o3d.io.write_triangle_mesh(path, o3d.io.read_triangle_mesh(path).transform(T))
    with Scene(recording, np.random.default_rng()).sheet("targets.csv") as targets:
        names = [f"faro_{axis}" for axis in "xyz"]
        at = np.stack([np.array(targets.columns[n], float) for n in names], axis=1)
        for name, column in zip(names, se3.apply(T, at).T, strict=True):
            targets.columns[name] = [repr(x) for x in column.tolist()]


def mirrored(recording, targets=True):
    """The tracker's y the other way round, for bodies, and for targets where they are too."""
    scene = Scene(recording, np.random.default_rng())
    sheets = {"stops.csv": (".y", ".qx", ".qz"), "targets.csv": ("er_y",)}
    for sheet, ends in list(sheets.items())[: 1 + targets]:
        with scene.sheet(sheet) as table:
            for name in (n for n in table.columns if n.endswith(ends)):
                column = table.columns[name]
                table.columns[name] = [repr(-float(x)) if x != "" else x for x in column]


def rewrite(recording):
    """Other noise, a thousandth of a millimetre: no copy of what is known."""
    rng = np.random.default_rng(1)

    def jittered(scan):
        return scan | {"x": scan["x"] + rng.normal(0.0, 1e-6, len(scan["x"]))}

    Scene(recording, rng).each_scan(jittered)


@pytest.fixture
def home(once):
    return once(bumped)


def test_a_reference_that_was_scanned_anew_is_what_moved(home, tmp_path):
    """Half a metre away, where no fit that holds the earlier frame comes to an optimum."""
    later = shutil.copytree(home / "before", tmp_path / "later")
    scanned_anew(later)
    rewrite(later)
    run = calibrate(later, tmp_path / "run", hold_out="none", prior=home / "a")
    assert run.converged
    (moved,) = [link for link in run.summary["links"] if link["moved"]]
    assert moved["name"] == "faro"
    z = (np.abs(moved["change"]) - np.abs(se3.log(se3.inverse(se3.exp(ANEW))))) / moved["sigma"]
    assert np.abs(z).max() < 4.0


@pytest.mark.long
def test_in_one_fit_it_is_what_is_wrong(home, tmp_path):
    """And no scan, body or part of the mesh of either recording."""
    scanned_anew(home / "after")
    run = fit([home / "before", home / "after"], tmp_path / "run", hold_out="none")
    assert not run.converged
    found = diagnose(run)
    assert {each["name"] for each in found.blunders} == {"faro", "lidar"}  # that was bumped, too
    assert found.verdict == "bad_data"


@pytest.mark.long
def test_a_recording_that_fits_nothing_by_itself_is_named(home, tmp_path):
    mirrored(home / "after", targets=False)
    run = fit([home / "before", home / "after"], tmp_path / "run", hold_out="none")
    assert not run.converged
    (bad,) = diagnose(run).blunders
    assert (bad["kind"], bad["recording"]) == ("recording", "after")
    assert bad["sentence"].startswith("A fit to after alone comes to no optimum, and one to before")


@pytest.mark.long
def test_a_tracker_of_the_other_hand_is_told_by_its_targets(home, tmp_path):
    mirrored(home / "after")
    run = fit([home / "before", home / "after"], tmp_path / "run", hold_out="none")
    assert not run.converged
    (bad,) = diagnose(run).blunders
    assert (bad["kind"], bad["name"], bad["recording"]) == ("target", "handedness", "after")
    assert "left-handed" in bad["sentence"]


@pytest.mark.long
def test_spheres_under_each_others_names_are_what_is_wrong_and_nothing_that_they_drag_along(
    home, tmp_path
):
    one = shutil.copytree(home / "before", tmp_path / "one")
    with Scene(one, np.random.default_rng()).sheet("targets.csv") as targets:
        for name in (f"faro_{axis}" for axis in "xyz"):
            column = targets.columns[name]
            column[1], column[3] = column[3], column[1]
        first, second = (targets.columns["target"][i] for i in (1, 3))
    run = fit(one, tmp_path / "run", hold_out="none")
    assert not run.converged
    found = diagnose(run)
    (blunder,) = found.blunders
    assert (found.verdict, blunder["kind"], blunder["without"]) == ("bad_data", "target", None)
    assert f"the scanner's {second} is the tracker's {first}" in blunder["sentence"]
    assert found.sentences[1] == blunder["sentence"]


@pytest.mark.long
@pytest.mark.parametrize("by", [ANEW, np.array([0.0, 0.0, 0.003, 0.002, 0.0, 0.0])])
def test_what_rigs_of_other_names_share_may_have_moved_as_well(home, tmp_path, by):
    """Far off no fit of both has an optimum; by millimetres it has, and stops seem to scatter."""
    other = shutil.copytree(home / "after", tmp_path / "other")
    scanned_anew(other, by)
    rig = (other / "rig.yaml").read_text()
    (other / "rig.yaml").write_text(re.sub("^name: .*", "name: other", rig, flags=re.M))
    run = fit([home / "before", other], tmp_path / "run", hold_out="none")
    found = diagnose(run)
    assert [each["name"] for each in found.blunders] == ["faro"] and found.verdict == "bad_data"
    assert "another name in one rig.yaml" in found.blunders[0]["sentence"]
    (other / "rig.yaml").write_text(
        (other / "rig.yaml").read_text().replace("frame: faro", "frame: b")
    )
    apart = fit([home / "before", other], tmp_path / "apart", hold_out="none")
    sigma_m = [apart.solution.shared.frames[name].sigma_m for name in ("faro", "b")]
    assert np.max(sigma_m) < 5e-4
    assert apart.converged and not [
        b for b in diagnose(apart).blunders if b["name"] in ("faro", "b")
    ]
