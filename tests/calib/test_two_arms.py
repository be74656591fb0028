"""Several tips in one rig: two arms on a torso, fitted together."""

import numpy as np
import pytest
import yaml
from scipy.stats import chi2

import calib
from calib.evaluation.arm import Arm
from calib.evaluation.at_poses import evaluate_at
from calib.problem import build
from calib.problem.model import Model, Source
from calib.report import report
from calib.solve.fit import solve
from chains import se3
from chains.align import align_points
from chains.errors import InputError
from chains.minimal import own_errors

from . import two_arms

GEOMETRY = ("arm_link_length", "arm_joint_offset")


@pytest.fixture(scope="module")
def arms():
    return two_arms.drawn(np.random.default_rng(5))


@pytest.fixture(scope="module")
def recording(tmp_path_factory, arms):
    folder = tmp_path_factory.mktemp("torso") / "rec"
    two_arms.write(folder, arms, 80, np.random.default_rng(6))
    return folder


@pytest.fixture(scope="module")
def run(recording):
    return calib.fit(recording, recording.parent / "run")


def test_a_rig_has_the_joints_of_all_of_its_chains(recording):
    rig = Source.open(recording).rig
    assert rig.tips == two_arms.HANDS and rig.arm_base == "foot"
    assert [len(chain) for chain in rig.chains] == [9, 9] and len(rig.arm_edges) == 16
    assert set(rig.joint_names) == set(two_arms.JOINTS)
    assert rig.joints_to("right_hand")[:3] == ("waist", "lift", "right_1")
    assert rig.beyond_arm == {"left_hand_tool", "right_hand_tool"}
    assert rig.beyond(["right_hand"]) == {"right_hand_tool"}


def test_what_both_hands_tell_lies_within_its_sigmas(recording, arms):
    """All of the calibration at once: d' C^-1 d is a chi-square, what is tied included."""
    estimate = solve(build([Source.open(recording)], Model(GEOMETRY)))
    assert estimate.converged
    variables = estimate.problem.variables
    truth = {"arm_link_length": arms.lengths, "arm_joint_offset": arms.zeros}
    off = [
        estimate.values[name] - [true[dof] for dof in variables[name].dofs]
        for name, true in truth.items()
    ]
    off += [estimate.values[f"{hand}_tool"] - arms.tools[hand] for hand in two_arms.HANDS]
    names = [*truth, *(f"{hand}_tool" for hand in two_arms.HANDS)]
    off, C = np.concatenate(off), estimate.covariance_of(names)
    squared = off @ np.linalg.solve(C, off)
    low, high = chi2.ppf([0.001, 0.999], len(off))
    assert low < squared < high
    z = off / np.sqrt(np.diag(C))
    assert np.abs(z).max() < 4


def test_geometry_is_complete_and_minimal_over_both_chains(recording):
    """Four ways an axis, two a slide, and six for each tool: as many directions move the hands."""
    rig = Source.open(recording).rig
    full = 4 * 13 + 2 * 1 + 6 * 2
    rng = np.random.default_rng(1)
    joints = rng.uniform(-2, 2, (60, len(rig.joint_names)))
    placed = [rig.tree.place(hand, joints) for hand in two_arms.HANDS]

    def moved(edge, twist):
        at = rig.tree.edge_names.index(edge)
        return np.concatenate([(p.d_twist[:, :, at] @ twist).ravel() for p in placed])

    for base_held, tips_held in (
        (True, (True, True)),
        (False, (True, False)),
        (False, (False,) * 2),
    ):
        columns = [
            moved(s.edge, s.twist)
            for s in own_errors(rig.tree, rig.chains, base_held, tips_held).slips
        ]
        own = len(columns)
        for name in rig.arm_edges:
            T = rig.edge(name).T_parent_child
            along = np.concatenate([np.zeros(3), T[:3, :3].T @ T[:3, 3]])
            columns += [moved(name, along)] if np.linalg.norm(along) > 1e-9 else []
        columns += [
            np.concatenate([p.d_joint[:, :, j].ravel() for p in placed])
            for j in range(len(rig.joint_names))
        ]
        columns += [moved("foot", e) for e in np.eye(6)] if base_held else []
        for k in np.flatnonzero(tips_held):
            for e in np.eye(6):
                each = [np.tile(e, len(joints)) * (i == k) for i in range(2)]
                columns.append(np.concatenate(each))
        A = np.array(columns).T
        assert np.linalg.matrix_rank(A, tol=1e-6 * np.linalg.norm(A, 2)) == full, "complete"
        rest = A[:, own:]
        rank = np.linalg.matrix_rank(rest, tol=1e-6 * np.linalg.norm(rest, 2))
        assert rank == full - own, "minimal"


@pytest.mark.long
def test_a_run_of_two_arms_is_diagnosed_shown_and_exported(run, arms, tmp_path):
    rms = run.summary["rms_mm"]
    assert run.summary["converged"] and 0.8 < rms["held_out"] / rms["noise_floor"] < 1.3
    assert "arm_geometry" in run.solution.shared.effects  # 160 poses of six rows tell it
    found = calib.diagnose(run)
    assert found.verdict == "adequate" and not found.blunders
    report([run], tmp_path / "report.html")
    page = (tmp_path / "report.html").read_text()
    assert "left_hand" in page and "right_hand" in page
    calib.export(run, tmp_path / "out", ["dh", "urdf"])
    table = yaml.safe_load((tmp_path / "out" / "dh_2.yaml").read_text())
    assert table["tip_link"] == "right_hand" and len(table["calibrated"]["links"]) == 7


def test_either_hand_is_corrected(recording, run, arms):
    joints = np.random.default_rng(8).uniform(-0.2, 0.2, (50, len(two_arms.JOINTS)))
    rig = Source.open(recording).rig
    order = [two_arms.JOINTS.index(name) for name in rig.joint_names]
    for hand in two_arms.HANDS:
        true = arms.T_world_foot.inv() * arms.seen(hand, joints)
        found = calib.Arm.of(run, tip=f"{hand}_tool").corrected(joints[:, order])
        # Where the foot is was estimated as well: all poses may be off by one turn and shift.
        turn, _ = align_points(true.translation, found[:, :3, 3])
        off_m = se3.apply(turn, found[:, :3, 3]) - true.translation
        assert np.linalg.norm(off_m, axis=1).max() < 2e-4


@pytest.mark.parametrize(
    ("tip", "said"),
    [
        (["left_hand", "left_hand"], "left_hand is there twice"),
        ([], "arm.tip"),
        (["left_hand", "rihgt_hand"], "link 'rihgt_hand' is unknown; did you mean 'right_hand'"),
    ],
)
def test_tips_that_make_no_sense_are_refused(tmp_path, arms, tip, said):
    two_arms.write(tmp_path / "rec", arms, 3, np.random.default_rng(1), tip=tip)
    with pytest.raises(InputError, match=said):
        Source.open(tmp_path / "rec")


def test_each_hand_is_predicted_at_any_pose(run, recording, tmp_path):
    """Where the corrected arm brings it; a hand that there is not is said."""
    table, joints = tmp_path / "poses.csv", Source.open(recording).recording.joints[:9] / 2
    rows = [["stop", *two_arms.JOINTS], *([f"p{k}", *q] for k, q in enumerate(joints.tolist()))]
    table.write_text("".join(",".join(map(str, row)) + "\n" for row in rows))
    for hand in ("left_hand_tool", "right_hand_tool"):
        found = evaluate_at(run, table, body=hand)
        assert found.body == hand
        ours = Arm.of(run, tip=hand).corrected(joints)
        np.testing.assert_allclose(found.place_m, ours[:, :3, 3], atol=1e-9)
    with pytest.raises(InputError, match="no body 'head', but: left_hand_tool, right_hand_tool"):
        evaluate_at(run, table, body="head")
