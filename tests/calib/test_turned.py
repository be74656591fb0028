"""A LiDAR that rig.yaml has turned any way is found by its scans, said, and fitted as any other."""

import shutil

import numpy as np
import open3d as o3d
import pandas as pd
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
import yaml
from scipy.spatial.transform import Rotation

from calib.blunders.told import tokens
from calib.problem import build
from calib.problem.model import Model, Source
from calib.problem.without import leave_out
from calib.results.check import check
from calib.rig import load_rig
from calib.runs.calibrate import calibrate
from calib.runs.diagnose import diagnose
from calib.solve.fit import solve
from calib.solve.otherwise.axes import axes_of
from calib.solve.otherwise.orientations import lidars_turned
from chains import se3

from ..worlds import World, write

# Quarter and half turns, and four drawn evenly from all rotations.
QUARTERS = [(0, 0, 90), (0, 0, 180), (180, 0, 0), (0, -90, 0)]
DRAWN = Rotation.random(4, rng=np.random.default_rng(7)).as_euler("xyz", degrees=True)
TURNS = [*QUARTERS, *map(tuple, DRAWN.round(1).tolist())]


@pytest.fixture(scope="module")
def good(tmp_path_factory):
    """A recording by a simulator that shares nothing with the fit, a tenth of it clutter."""
    folder = tmp_path_factory.mktemp("turned") / "good"
    write(World(seed=3, locations=4, stops=3, beams=600, clutter=0.1), folder)
    return folder


def turned(good, to, degrees):
    """A copy whose rig.yaml has the LiDAR turned about its own axes, and the angles it should have:
    roll, pitch and yaw."""
    shutil.copytree(good, to)
    rig = yaml.safe_load((to / "rig.yaml").read_text())
    frame = rig["frames"][rig["lidar"]["frame"]]
    right = [float(a) for a in frame["rpy_rad"]]
    T = se3.from_xyz_rpy([0, 0, 0], right)
    T[:3, :3] = T[:3, :3] @ Rotation.from_euler("xyz", degrees, degrees=True).as_matrix()
    frame["rpy_rad"] = [float(a) for a in se3.to_rpy(T)]
    (to / "rig.yaml").write_text(yaml.safe_dump(rig))
    return to, right


def lidar(folder):
    return load_rig(folder).lidar_frame


def problem_of(folder):
    return build([Source.open(folder)], Model())


@pytest.mark.parametrize("degrees", TURNS, ids=str)
def test_scans_say_how_a_lidar_is_turned(good, tmp_path, degrees):
    """Near enough: from 0.3 rad away the passes over the scans find the optimum."""
    folder, right = turned(good, tmp_path / "turned", degrees)
    problem = problem_of(folder)
    (found,) = lidars_turned(problem, problem.initial).values()
    edge = next(e for e in load_rig(folder).tree.edges if e.child == lidar(folder))
    T = edge.T_parent_child @ se3.exp(found)
    off = se3.inverse(se3.from_xyz_rpy([0, 0, 0], right)) @ T
    assert np.linalg.norm(se3.so3_log(off[:3, :3])) < 0.2
    assert np.array_equal(found[3:], np.zeros(3)), "its origin moved"


def test_nothing_is_turned_where_cad_is_right(good, shared):
    """Nor where two scans were exchanged, whose beams end far from the mesh."""
    for folder in (good, shared / "recordings" / "known_exchanged_scans"):
        problem = problem_of(folder)
        assert lidars_turned(problem, problem.initial) == {}


def test_a_lidar_that_is_elsewhere_is_not_turned(good, tmp_path):
    """Half a metre from where CAD has it."""
    folder = shutil.copytree(good, tmp_path / "moved")
    rig = yaml.safe_load((folder / "rig.yaml").read_text())
    rig["frames"][rig["lidar"]["frame"]]["xyz_m"][0] += 0.5
    (folder / "rig.yaml").write_text(yaml.safe_dump(rig))
    problem = problem_of(folder)
    assert lidars_turned(problem, problem.initial) == {}


Z_DOWN = np.array([[1, 0, 0], [0, 0, 1], [0, -1, 0]])  # x, y, z are written as x, z, -y: y is up
MIRRORED = np.diag([1, -1, 1])


def scans(folder, axes):
    for path in (folder / "scans").glob("*.parquet"):
        table = pq.read_table(path)
        xyz = np.column_stack([table[axis] for axis in "xyz"]) @ axes.T
        for k, axis in enumerate("xyz"):
            at = table.column_names.index(axis)
            table = table.set_column(at, axis, pa.array(xyz[:, k].astype(np.float32)))
        pq.write_table(table, path)


def mesh(folder, axes):
    (path,) = (folder / "reference").glob("*.ply")
    found = o3d.io.read_triangle_mesh(str(path))
    faces = np.asarray(found.triangles)
    found.vertices = o3d.utility.Vector3dVector(np.asarray(found.vertices) @ axes.T)
    found.triangles = o3d.utility.Vector3iVector(
        faces if np.linalg.det(axes) > 0 else faces[:, ::-1]
    )
    o3d.io.write_triangle_mesh(str(path), found)


def bodies(folder, axes):
    stops = pd.read_csv(folder / "stops.csv")
    for body in ("base_markers", "mount_markers"):
        xyz = [f"{body}.{axis}" for axis in "xyz"]
        q = [f"{body}.q{part}" for part in "xyzw"]
        stops[xyz] = stops[xyz].to_numpy() @ axes.T
        turn = Rotation.from_matrix(axes) * Rotation.from_quat(stops[q].to_numpy())
        stops[q] = turn.as_quat()
    stops.to_csv(folder / "stops.csv", index=False)


@pytest.mark.parametrize(
    ("change", "axes", "whose", "said"),
    [
        (scans, MIRRORED, "scans", "x and y exchanged"),
        (scans, MIRRORED[[1, 0, 2]] * [1, -1, 1], "scans", "x and y exchanged"),
        (
            mesh,
            Z_DOWN @ MIRRORED,
            "mesh",
            "x, z, y of the mesh's vertices in place of x, y, z: are they",
        ),
        (mesh, Z_DOWN, "mesh", "x, -z, y of the mesh's vertices in place of x, y, z: is another"),
        (bodies, Z_DOWN, "tracker", "x, -z, y of the bodies' poses in place of x, y, z: is anoth"),
    ],
)
def test_axes_that_were_exchanged_or_mirrored_are_told(good, tmp_path, change, axes, whose, said):
    folder = shutil.copytree(good, tmp_path / "other")
    change(folder, axes)
    problem = problem_of(folder)
    (found,) = axes_of(problem, problem.initial)
    assert (found.whose, found.frame) == (whose, lidar(folder))
    assert found.read is None or np.array_equal(found.read @ axes, np.eye(3))
    assert any(said in sentence for sentence in check(folder).odd)


def test_axes_are_as_they_should_be_where_something_else_is_wrong(good, shared, tmp_path):
    exchanged = shared / "recordings" / "known_exchanged_scans"
    for folder in (good, exchanged, turned(good, tmp_path / "turned", QUARTERS[1])[0]):
        problem = problem_of(folder)
        assert list(axes_of(problem, problem.initial)) == []


@pytest.mark.long
@pytest.mark.parametrize("degrees", [TURNS[-1], QUARTERS[1]], ids=str)
def test_the_fit_and_its_diagnosis_are_those_of_the_right_rig(good, tmp_path, degrees):
    """With the CAD of the LiDAR left out, from either rig.yaml the same place of the LiDAR on its
    mount; as it stands the diagnosis names that CAD, and `check` has said what it should be."""
    folder, _ = turned(good, tmp_path / "turned", degrees)
    ends = []
    for each in (good, folder):
        (source,) = leave_out([Source.open(each)], [f"cad:{lidar(each)}"])
        found = solve(build([source], Model()))
        assert found.converged
        edge = next(e for e in source.rig.tree.edges if e.child == lidar(each))
        ends.append(edge.T_parent_child @ se3.exp(found.values[lidar(each)]))
    apart = se3.log(se3.inverse(ends[0]) @ ends[1])
    assert np.abs(apart[:3]).max() < 1e-4 and np.abs(apart[3:]).max() < 1e-4

    suspects = [s for s in check(folder).suspects if s["kind"] == "frame"]
    assert [s["without"] for s in suspects] == [f"cad:{lidar(folder)}"]
    found = diagnose(calibrate([folder], tmp_path / "run", hold_out="none"))
    assert found.verdict == "bad_data"
    assert tokens(found.blunders) == [f"cad:{lidar(folder)}"]
