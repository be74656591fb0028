"""A run for others: what is written is what was found, and is read back."""

import itertools

import numpy as np
import pytest
import yaml
from scipy.spatial.transform import RigidTransform, Rotation

from calib.exporters import FORMATS, export, read_extrinsics
from calib.results.solution import EffectEstimate, FrameEstimate, Part, Solution
from calib.runs.run import Run
from chains.errors import InputError


@pytest.fixture
def run(tmp_path):
    """A run of two rigs, its numbers drawn at random."""
    rng = np.random.default_rng(3)

    def frame(parent):
        T = RigidTransform.from_components(rng.normal(size=3), Rotation.random(rng=rng)).as_matrix()
        return FrameEstimate(parent, T, *rng.uniform(1e-5, 1e-3, (2, 3)))

    def rings(count):
        names = tuple(f"ring_{k:03d}" for k in range(count))
        estimate, sigma = rng.normal(0, 0.01, (2, count))
        return EffectEstimate(unit="m", names=names, estimate=estimate, sigma=sigma)

    link = EffectEstimate("m", ("turn", "tip"), np.array([1e-3, 0.0]), np.array([1e-4, 0.0]))
    own = {
        rig: Part(
            {"lidar": frame("mount")},
            {"ring_range_offset": rings(count), "a_bent_mirror": rings(count)},
        )
        for rig, count in (("one", 4), ("two", 3))
    }
    shared = Part({"mount": frame("tip"), "faro": frame("opti")}, {"arm_link_length": link})
    untold = [{"name": "mount.tz", "why": "tied to arm_link_length.tip: both change alike"}]
    model = {
        "recordings": [{"path": f"/data/{rig}", "rig": rig, "sha256": rig * 9} for rig in own],
        "effects": ["arm_link_length", "ring_range_offset"],
        "fixed": ["lidar.tz"],
        "prior": None,
        "versions": {"rigcal": "0.1.0"},
    }
    summary = {
        "residual": "range",
        "converged": True,
        "rms_mm": {"fit": 3.25, "held_out": None},
    }
    return Run(
        tmp_path / "run",
        model,
        summary,
        Solution(
            shared=shared,
            recordings=own,
            not_estimated=untold,
            keys=(),
            covariance=np.zeros((0, 0)),
        ),
    )


@pytest.fixture
def path(run, tmp_path):
    (file,) = export(run, tmp_path / "out", ["yaml"]).files
    return file


@pytest.fixture
def written(path):
    """As any other program reads it."""
    return yaml.safe_load(path.read_text())


def assert_equal(a, b):
    assert a.frames.keys() == b.frames.keys()
    assert a.effects.keys() == b.effects.keys()
    for name, frame in a.frames.items():
        assert frame.parent == b.frames[name].parent
        for key in ("T_parent_child", "sigma_m", "sigma_rad"):
            x, y = getattr(frame, key), getattr(b.frames[name], key)
            np.testing.assert_allclose(x, y, rtol=0, atol=1e-12)
    for name, effect in a.effects.items():
        other = b.effects[name]
        assert (effect.unit, effect.names) == (other.unit, other.names)
        np.testing.assert_array_equal(effect.estimate, other.estimate)
        np.testing.assert_array_equal(effect.sigma, other.sigma)


def test_what_is_read_back_is_the_solution(run, path):
    shared, recordings = read_extrinsics(path)
    assert_equal(shared, run.solution.shared)
    assert recordings.keys() == run.solution.recordings.keys()
    for rig, part in recordings.items():
        assert_equal(part, run.solution.recordings[rig])


def test_every_notation_of_a_frame_says_the_same(run, written):
    frames = written["frames"] | written["recordings"]["two"]["frames"]
    for name, frame in frames.items():
        T = run.solution.part("two").frames[name].T_parent_child
        np.testing.assert_allclose(frame["T_parent_child"], T, rtol=0, atol=1e-12)
        np.testing.assert_allclose(frame["xyz_m"], T[:3, 3], rtol=0, atol=1e-12)
        for R in (
            Rotation.from_quat(frame["quat_wxyz"], scalar_first=True),
            Rotation.from_euler("xyz", frame["rpy_rad"]),
        ):
            np.testing.assert_allclose(R.as_matrix(), T[:3, :3], rtol=0, atol=1e-12)


def test_every_ring_has_its_row(run, written):
    for rig, count in (("one", 4), ("two", 3)):
        effect = run.solution.recordings[rig].effects["ring_range_offset"]
        rings = written["recordings"][rig]["rings"]["ring_range_offset"]
        assert rings["unit"] == "m"
        assert [row["ring"] for row in rings["table"]] == list(range(count))
        assert [row["offset_m"] for row in rings["table"]] == effect.estimate.tolist()
        assert [row["sigma_m"] for row in rings["table"]] == effect.sigma.tolist()
    assert list(written["effects"]) == ["arm_link_length"]


def test_where_it_came_from_is_told(run, written):
    told = written["provenance"]
    assert told["recordings"] == run.model["recordings"]
    assert told["model"] == {
        "effects": run.model["effects"],
        "fixed": ["lidar.tz"],
        "prior": None,
    }
    assert told["versions"] == {"rigcal": "0.1.0"}
    assert told["run"] == run.folder.name
    assert written["not_estimated"] == run.solution.not_estimated


def test_every_key_of_a_frame_has_its_convention(written):
    keys = set(itertools.chain(*written["frames"].values())) - {"parent"}
    assert keys <= set(written["conventions"])
    assert all(value for value in written["conventions"].values())


def test_a_frame_that_contradicts_itself_is_refused(path):
    path.write_text(path.read_text().replace("rpy_rad: [", "rpy_rad: [1", 1))
    with pytest.raises(
        InputError, match=r"extrinsics.yaml:\d+: frame mount: .* do not say the same"
    ):
        read_extrinsics(path)


@pytest.mark.parametrize(
    ("old", "new", "complaint"),
    [
        ("format: rigcal", "format: other", "is missing, so this is no export"),
        (
            "sigma_rad: [",
            "sigma_deg: [",
            r"extrinsics.yaml:\d+: unknown key .*sigma_deg; .*sigma_rad",
        ),
        ("offset_m:", "offset:", r"ring_range_offset: a row has ring, offset, sigma_m; each has"),
    ],
)
def test_another_file_is_refused(path, old, new, complaint):
    path.write_text(path.read_text().replace(old, new, 1))
    with pytest.raises(InputError, match=complaint):
        read_extrinsics(path)


def test_an_unknown_format_names_those_there_are(run, tmp_path):
    with pytest.raises(InputError, match=f"--format kdl: .* {', '.join(FORMATS)}"):
        export(run, tmp_path / "none", ["kdl"])
    assert not (tmp_path / "none").exists()


def test_all_formats_are_written_or_left_out_where_none_is_named(run, tmp_path):
    """The recordings of this run are not there, which YAML and tables can do without."""
    done = export(run, tmp_path / "all")
    assert sorted(done.files) == sorted((tmp_path / "all").iterdir())
    assert {file.suffix for file in done.files} == {".yaml", ".tex", ".md"}
    assert done.not_held.keys() | done.left_out.keys() == set(FORMATS)
    assert done.not_held["yaml"] == []
    assert all("/data/one" in why and "no longer there" in why for why in done.left_out.values())


def test_a_format_twice_is_written_once(run, tmp_path):
    assert len(export(run, tmp_path / "out", ["yaml", "yaml"]).files) == 1


def test_a_file_in_the_way_is_left_alone(run, path):
    before = path.read_bytes()
    with pytest.raises(InputError, match="is a file; give a folder"):
        export(run, path)
    assert path.read_bytes() == before


def test_a_failure_leaves_the_earlier_export(run, path, monkeypatch):
    before = path.read_bytes()
    monkeypatch.setattr("sensors.documents.yaml.dump", lambda *_, **__: 1 / 0)
    with pytest.raises(ZeroDivisionError):
        export(run, path.parent)
    assert path.read_bytes() == before
    assert list(path.parent.iterdir()) == [path]
