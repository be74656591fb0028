"""Structure without a name: what is proposed for it is added by the name that was printed."""

import json
import re
from types import SimpleNamespace

import numpy as np
import pytest
import yaml

from calib.diagnosis.structure import formulas_of, of_look, singly
from calib.diagnosis.structure.empirical import (
    Binned,
    DirectionShape,
    JointShape,
    PoseSlope,
    RingSlope,
)
from calib.diagnosis.suggest import formula, with_ring
from calib.effects import CATALOGUE, View
from calib.effects.own.formula import FormulaEffect
from calib.rig import load_rig
from calib.runs.calibrate import calibrate
from calib.runs.run import Run
from calib.simulation import Spec, simulate
from calib.view.desk import Desk, Findings

# No catalogue has a hump at 34 degrees of incidence.
HUMP = {
    "name": "hump",
    "site": "range",
    "unit": "m",
    "sigma": 0.004,
    "basis": ["exp(-((incidence - 0.6) / 0.15)**2)"],
}
SPEC = Spec(
    lidar="hesai_pandarxt32", room="box", locations=4, stops_per_location=2, column_step=200
)


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    folder = tmp_path_factory.mktemp("empirical")
    (folder / "hump.yaml").write_text(yaml.safe_dump(HUMP))
    simulate(SPEC, folder / "rec", 2, {str(folder / "hump.yaml"): 1.0})
    return calibrate([folder / "rec"], folder / "run")


@pytest.mark.long
def test_it_is_added_by_the_printed_name_and_the_held_out_error_falls(run, rigcal, tmp_path):
    code, said, err = rigcal("diagnose", run.folder)
    assert code == 0, err
    (name,) = set(re.findall(r"can be added by its name, '(\w+)'", " ".join(said.split())))
    assert name == "empirical_incidence"
    code, said, err = rigcal("add", run.folder, name, "-o", tmp_path / "grown")
    assert code == 0, err
    said = " ".join(said.split())
    assert "without a known cause" in said
    (ends,) = re.findall(r"observed at incidence from ([\d.]+) to ([\d.]+) degrees", said)
    assert float(ends[0]) < 5 and 60 < float(ends[1]) < 90
    before, after = run.summary["rms_mm"], Run.open(tmp_path / "grown").summary["rms_mm"]
    assert after["held_out"] < 1.05 * after["noise_floor"] < before["held_out"] / 1.2
    document = json.loads((run.folder / "diagnosis.json").read_text())
    seen = document["unexplained"][0]["seen"]["incidence_rad"]
    assert np.degrees(seen) == pytest.approx([float(x) for x in ends], rel=0.01)
    assert name in Desk.of([run.folder]).addable(Findings.read(run))


def test_a_second_one_has_another_name():
    effect = JointShape("turn", "lift", (-1.0, 0.5))
    assert proposal(effect)["name"] == "empirical_turn_lift"
    assert proposal(effect, ["empirical_turn_lift"])["name"] == "empirical_turn_lift_2"
    assert proposal(effect)["what"].endswith("lift from -57.3 to 28.6 degrees.")


@pytest.mark.parametrize(
    ("column", "name"),
    [
        ("humidity", "empirical_humidity"),
        ("moved.joint_1", "empirical_moved_joint_1"),
        ("two words", None),
        ("a; b", None),
        ("label", None),
    ],
)
def test_a_column_that_no_formula_can_name_has_none(column, name):
    at = np.array([0.1, 0.4, 0.9])
    found = proposal(Binned({column: (at[1:] + at[:-1]) / 2}, {column: at}, {column: (0.0, 1.0)}))
    assert (found and found["name"]) == name


def test_knots_are_told_apart_where_values_are_large():
    """Seconds since 1970, say."""
    at = 1.7e9 + 60.0 * np.arange(12)
    effect = Binned({"time_s": (at[1:] + at[:-1]) / 2}, {"time_s": at}, {"time_s": (at[0], at[-1])})
    knots = re.findall(r"1 - \((\d[\d.e+]*) - time_s", " ".join(proposal(effect)["basis"]))
    assert len({float(knot) for knot in knots}) == len(knots) == 7


@pytest.mark.parametrize("what", ["elevation", "azimuth", "ring", "lidar", "body"])
def test_a_formula_does_what_it_stands_for(tmp_path, what):
    """Site, unit and scale: the same basis, a parameter that a test found alone by itself."""
    simulate("tiny", tmp_path / "rec", 1)
    rig, rng, rows = load_rig(tmp_path / "rec"), np.random.default_rng(0), 40
    columns = {
        "azimuth_rad": rng.uniform(-np.pi, np.pi, rows),
        "ring": rng.integers(0, rig.lidar.rings, rows),
        "temperature_c": rng.uniform(20.0, 24.0, rows),
        "tracked": np.tile(np.eye(4), (rows, len(rig.tracker.bodies), 1, 1)),
    }
    view, seen = View(rig, rows, columns, np.zeros((rows, len(rig.joint_names)))), (20.0, 24.0)
    if what in ("elevation", "azimuth"):
        tested = DirectionShape(what, (-np.pi, np.pi), 4)
        expected = tested.basis(view)
    elif what == "ring":
        ring = int(columns["ring"][7])
        whole = RingSlope("temperature_c", seen)
        tested, basis = whole.alone(ring), whole.basis(view)
        expected = np.where(basis.index == ring, basis.values.T, 0.0).T[:, :, None]
        assert expected.any()
    else:
        slip = next(e for e in CATALOGUE if e.name == f"{what}_slip")
        whole = PoseSlope(slip, "temperature_c", seen, formulas_of(slip, rig))
        tested, expected = whole.alone(4), whole.basis(view)[..., 4:5]
    told = proposal(tested)
    effect = FormulaEffect.read(told, "diagnosis.json", {})
    np.testing.assert_allclose(effect.basis(view), expected, atol=1e-9)
    assert {p.unit for p in effect.params(rig)} == {
        "m" if what in ("ring", "lidar", "body") else "rad"
    }


def test_what_the_tracker_does_has_no_formula(tmp_path):
    """It turns bodies about its own axes. Nor has a mount that not every rig has."""
    simulate("tiny", tmp_path / "rec", 1)
    rig = load_rig(tmp_path / "rec")
    slip = next(e for e in CATALOGUE if e.name == "tracker_slip")
    assert formulas_of(slip, rig) == ()
    assert proposal(PoseSlope(slip, "humidity", (0.0, 1.0), ()).alone(2)) is None


def test_each_ring_and_each_way_is_tested_alone():
    """In every rig that has it, but for what rows hardly feel beside the others."""
    effects = [RingSlope("humidity", (0.0, 1.0)), JointShape("turn", "lift", (-1.0, 0.5))]
    of_rigs = {
        effects[0].name: [np.arange(3), np.arange(3, 5)],
        effects[1].name: [np.arange(5, 11)],
    }
    felt = np.array([1.0, 1e-12, 1.0, 2.0, 1e-12, *6 * [1.0]])
    alone, at = singly(effects, of_rigs, felt)
    assert [e.name for e in alone] == ["structure:ring,humidity@0", "structure:ring,humidity@2",
                                       "structure:turn,lift"]  # fmt: skip
    assert [at[e.name].tolist() for e in alone] == [[0, 3], [2], [5, 6, 7, 8, 9, 10]]
    assert {e.family for e in alone[:2]} == {effects[0].name} and of_look(alone[1]) is effects[0]


def test_a_ring_s_number_stands_beside_no_other_column():
    assert with_ring(["ring", "spring_n"], 3) == ["ring 3", "spring_n"]
    assert with_ring(["ring", "spring_n"], None) == ["ring", "spring_n"]


def proposal(effect, taken=()):
    return formula(SimpleNamespace(effect=effect), taken)
