"""Every group of rows against all others: by dense algebra, by leaving it out, and by chance."""

from dataclasses import dataclass, replace
from types import SimpleNamespace

import numpy as np
import pytest
from scipy import stats

from calib.blunders import judged, told
from calib.blunders.others import Others
from calib.blunders.shifts import Shift, of_poses, shifts, standing_alone
from calib.effects import find
from calib.linear.clusters import Gradients
from calib.problem import build
from calib.problem.model import Model, Source
from calib.residuals.groups import CAD, Group
from calib.residuals.store import drawn_evenly
from calib.simulation import Spec
from calib.solve.fit import preview

from . import rigs, simulated
from .linear import cases
from .linear.dense import Dense
from .linear.groups import Groups, by_place

CASES = [name for name in cases.CASES if name != "an earlier estimate"]
WELL = 1e-3  # of what a group says, checked by others: rows can be left out without loss of digits
BY_STOP = {"base": {"moves": "stop"}}


@pytest.fixture(scope="module", params=CASES)
def both(request, tmp_path_factory):
    """A case, and the dense rows of each place with the full weight there."""
    case = cases.made(request.param, tmp_path_factory.mktemp("blunders"))
    return case, by_place(case)


def found(case):
    """Group -> its shift, as the program has it."""
    linear = case.linear(gradients=Gradients(len(case.dense.sigma)))
    every = shifts(Others.of(linear, case.start.problem))
    return {shift.group: shift for shift in every if not shift.of_ranges}


def case_of(problem):
    """A problem where its fit would start, with the weights that it has."""
    start = preview(problem)
    return cases.Case(start, Dense(start.problem, start.values, start.associations), None)


def assert_same(shift, off, tolerance=1e-6):
    name = str(shift.group)
    assert shift.dof == off.dof, name
    assert shift.statistic == pytest.approx(off.statistic, rel=tolerance, abs=tolerance), name
    size = np.sqrt(np.maximum(np.diag(off.covariance), 1e-300))
    limit = tolerance * (1 + np.abs(off.offset / size).max(initial=0.0))
    np.testing.assert_allclose(shift.offset / size, off.offset / size, atol=limit, err_msg=name)
    unit = np.outer(size, size)
    np.testing.assert_allclose(
        shift.covariance / unit, off.covariance / unit, atol=tolerance, err_msg=name
    )


# ------------------------------------------------------------------------------------------ algebra


def test_every_group_is_off_as_dense_rows_say(both):
    case, there = both
    here = found(case)
    known = {*there[CAD].parts, *there[CAD].scans}
    assert here.keys() >= known
    assert {g.kind for g in here.keys() - known} <= {"joints"}, "those of exact encoders: see below"
    for group in known:
        shift = here[group]
        assert_same(shift, there[group.where].off(group))
        axes, units = shift.axes, shift.units
        assert len(axes) == len(units) == len(shift.offset) == len(shift.information)


def with_range_zero(tmp_path):
    """A case with a range zero that all scans have, and its linearisation."""
    source = Source.open(rigs.write(tmp_path / "box", seed=6, **BY_STOP))
    case = case_of(build([source], cases.MODEL.plus((find("range_offset"),))))
    return case, case.linear(gradients=Gradients(len(case.dense.sigma)))


def test_a_range_zero_of_one_scan_is_off_as_dense_rows_say(tmp_path):
    case, linear = with_range_zero(tmp_path)
    here = {s.group: s for s in shifts(Others.of(linear, case.start.problem)) if s.of_ranges}
    there = Groups(case.dense)
    assert here.keys() == there.scans.keys()
    for group, shift in here.items():
        u, M = there.score([there.lengthened(group)])
        assert (shift.dof, list(shift.units)) == (1, ["m"])
        assert shift.statistic == pytest.approx(u[0] ** 2 / M[0, 0], rel=1e-6)
        np.testing.assert_allclose(shift.offset, u / M[0], rtol=1e-6)
        np.testing.assert_allclose(shift.covariance, 1 / M, rtol=1e-6)


def test_groups_are_told_apart_by_what_each_adds_to_those_before_it(tmp_path):
    """Just accepted where the limit is a little below what dense rows say that it adds, and just
    not where it is a little above; what is not accepted is not left out for the next."""
    case, linear = with_range_zero(tmp_path)
    problem, there = case.start.problem, Groups(case.dense)
    others = Others.of(linear, problem)
    every = {(s.group, s.of_ranges): s for s in shifts(others)}
    bodies = [
        Group("body", stop, body)
        for stop, body in (("s0", "base_markers"), ("s2", "mount_markers"))
    ]
    scans = [Group("scan", "s1", "scan"), Group("scan", "s3", "scan")]
    order = [(bodies[0], False), (scans[0], False), (Group("target", "t2", "sphere"), False)]
    order += [(scans[1], True), (bodies[1], False), (Group("frame", CAD, "lidar"), False)]
    columns = [there.lengthened(g) if zero else there.directions(g) for g, zero in order]
    before = []
    for (group, zero), mine in zip(order, columns, strict=True):
        adds = there.together([*before, mine]) - there.together(before)
        known = [(every[key], -1.0) for key in order[: len(before)]]
        for limit, accepted in ((adds - 1e-5, True), (adds + 1e-5, False)):
            found = standing_alone(others, [*known, (every[group, zero], limit)])
            assert (len(found) == len(known) + 1) is accepted, str(group)
        before.append(mine)
    worst, second, third = (every[key] for key in order[:3])
    known = [(worst, -1.0), (second, np.inf)]
    adds = there.together([columns[0], columns[2]]) - there.together([columns[0]])
    for limit, count in ((adds - 1e-5, 2), (adds + 1e-5, 1)):
        assert len(standing_alone(others, [*known, (third, limit)])) == count
    # The first is dropped again where it adds too little to one that is taken up after it.
    alone = there.together([columns[0]])
    beside = there.together([columns[0], columns[3]]) - there.together([columns[3]])
    fourth = every[order[3]]
    assert beside + 1e-3 < alone, "else the first would not be taken up"
    for limit, count in ((beside - 1e-5, 2), (beside + 1e-5, 1)):
        assert len(standing_alone(others, [(worst, limit), (fourth, -1.0)])) == count


@pytest.mark.parametrize("lidar", [True, False], ids=["lidar", "tracker alone"])
def test_readings_of_exact_encoders_are_judged_as_those_of_nearly_exact_ones(lidar, tmp_path):
    """Whose errors are unknowns, and whose readings are rows: to what 10 urad of play changes."""
    statistics = []
    for sigma_rad in (0, 1e-5):
        rig = BY_STOP | {"arm": cases.PLAIN_ARM | {"sigma_joint_rad": sigma_rad}}
        rig |= {} if lidar else {"lidar": None, "reference": None}
        folder = rigs.write(tmp_path / f"{sigma_rad}", seed=6, **rig)
        case = case_of(build([Source.open(folder)], cases.MODEL))
        here = {g: s for g, s in found(case).items() if g.kind == "joints"}
        assert len(here) == 4 * (1 + len(rigs.JOINTS))
        statistics.append({g: (s.dof, s.statistic) for g, s in here.items()})
    for group, (dof, statistic) in statistics[0].items():
        assert statistics[1][group][0] == dof
        assert statistics[1][group][1] == pytest.approx(statistic, rel=0.03, abs=0.03), str(group)


@pytest.mark.parametrize("name", ["stop by stop", "no lidar", "a stop without scan"])
def test_a_group_is_off_by_what_a_solution_without_its_rows_says(name, tmp_path):
    """Of each kind that which is furthest off."""
    case = cases.made(name, tmp_path)
    here, there, seen = found(case), Groups(case.dense), set()
    for group in sorted(here, key=lambda g: -here[g].statistic):
        kind = group.kind, group.what in ("rod", "upper"), len(here[group].axes)
        if kind not in seen and there.well(group) > WELL:
            seen.add(kind)
            assert_same(here[group], there.left_out(group))
    assert {kind for kind, _, _ in seen} >= {"body", "target", "frame", "joints"}


def test_rows_that_lost_weight_are_judged_as_if_they_had_not(tmp_path):
    """With all weights of a place at 1; those elsewhere stay, so that one wild row hides none."""
    source = Source.open(rigs.write(tmp_path / "box", seed=6, **BY_STOP))
    case = case_of(build([source], cases.MODEL))
    problem, plain = case.start.problem, found(case)
    weights = {("body", "s1"): [0.02], ("body", "s3"): [0.5], ("target", "t2"): [0.1, 1.0, 0.4]}
    at = [(b.groups[0].kind, b.groups[0].where) for b in problem.blocks]
    given = (weights.get(key) for key in at)
    blocks = [
        replace(b, weight=w and np.array(w)) for b, w in zip(problem.blocks, given, strict=True)
    ]
    lighter = {"joints@s1": 0.3, "joints@s2": 0.05, "lidar": 0.2, "arm_link_length": 0.6}
    unknowns = {n: replace(u, weight=lighter.get(n, 1.0)) for n, u in problem.variables.items()}
    problem = replace(problem, blocks=blocks, variables=unknowns)
    dense = Dense(problem, case.dense.values, case.dense.associations)
    case = cases.Case(replace(case.start, problem=problem), dense, None)
    here = found(case)
    assert here.keys() == plain.keys()
    for place in ("s0", "s1", "s2", "t2", CAD):
        there = Groups(case.dense, {place})
        for group in (g for g in here if g.where == place):
            assert_same(here[group], there.off(group))
    wild = Group("body", "s1", "mount_markers")
    assert here[wild].statistic != pytest.approx(plain[wild].statistic, rel=1e-3), (
        "others lost some"
    )


def test_what_nothing_contradicts_has_no_degree_of_freedom(tmp_path):
    """A body that alone says where the rig stands; a scan that alone does, planes known or not."""
    rig = {**BY_STOP, "arm": cases.PLAIN_ARM, "lidar": None, "target": None, "reference": None}
    tracker = rigs.drawing()["tracker"] | {"bodies": ["base_markers"]}
    folder = rigs.write(tmp_path / "one body", seed=2, **rig, tracker=tracker)
    (folder / "targets.csv").unlink()
    one = found(case_of(build([Source.open(folder)], Model(("arm_link_length",)))))
    bodies = [shift for group, shift in one.items() if group.kind == "body"]
    assert len(bodies) == 4
    blind = {"tracker": None, "target": None, **BY_STOP}
    folder = rigs.write(tmp_path / "no tracker", seed=2, **blind)
    alone = found(case_of(build([Source.open(folder)], Model())))
    scans = [shift for group, shift in alone.items() if group.kind == "scan"]
    assert len(scans) == 4
    for shift in (*bodies, *scans):
        assert (shift.dof, shift.statistic) == (0, 0.0), str(shift.group)
        assert not shift.offset.any() and not shift.information.any()


def test_groups_that_nothing_tells_apart_are_as_far_off(tmp_path):
    """Without scans, at a stop where only two bodies and the encoders meet, either body takes all
    of what contradicts the other."""
    folder = rigs.write(tmp_path / "box", seed=5, lidar=None, **BY_STOP)
    here = found(case_of(build([Source.open(folder)], Model(("arm_joint_offset",)))))
    for stop in rigs.STOPS:
        base, mount = (here[Group("body", stop, b)] for b in ("base_markers", "mount_markers"))
        assert base.dof == mount.dof == 6
        assert base.statistic == pytest.approx(mount.statistic, rel=1e-6)
        joints = here[Group("joints", stop, "joints")]
        assert joints.statistic < base.statistic - 1e-3, "three turns explain less than a pose"


# ------------------------------------------------------------------------------------------- chance


@dataclass
class Drawn:
    """Many recordings that differ from one model by noise alone, as dense right sides.

    Args:
        case: that model, at a state where its fit would start.
        groups: its rows.
        shifts: group -> how far it is off in the recording itself.
    """

    case: cases.Case
    groups: Groups
    shifts: dict[Group, Shift]

    def statistics(self, count, sigma=1.0, seed=0):
        """Group -> (count,) of recordings whose rows scatter by so many of their sigmas."""
        noise = np.random.default_rng(seed).standard_normal((len(self.groups.b), count))
        left = self.groups.beyond(sigma * noise)
        return {group: self.groups.statistics(group, left)[0] for group in self.shifts}

    def judged(self, statistics, monkeypatch):
        """The verdict on groups that are so far off, the others being as they are."""
        off = [replace(s, statistic=statistics.get(g, s.statistic)) for g, s in self.shifts.items()]
        monkeypatch.setattr(judged, "shifts", lambda others: iter(off))
        others = SimpleNamespace(problem=self.case.start.problem)
        return {b.group: b for b in judged.judge(others)}


@pytest.fixture(scope="module")
def drawn(tmp_path_factory):
    """Twelve stops, so that there are some groups of every kind."""
    spec = Spec(lidar="hesai_pandarxt32", locations=4, stops_per_location=3, column_step=400)
    source, _ = simulated.made(tmp_path_factory.mktemp("chance") / "rec", spec)
    case = case_of(build([source], Model()))
    checked = {group: shift for group, shift in found(case).items() if shift.dof}
    return Drawn(case, Groups(case.dense), checked)


def test_how_far_out_chance_puts_a_group_is_chi_square(drawn):
    """Of its degrees of freedom, for rows that scatter as they say."""
    for group, statistics in drawn.statistics(1000).items():
        dof = drawn.shifts[group].dof
        assert stats.kstest(statistics, stats.chi2(dof).cdf).pvalue > 1e-6, str(group)


def test_the_p_value_of_a_few_groups_of_a_kind_is_uniform(drawn, monkeypatch):
    """Three of a kind or fewer: their sigmas are taken at their word."""
    few = {}
    for group, shift in drawn.shifts.items():
        few.setdefault((group.kind, group.what in ("joints", "base_markers")), (group, shift))
    some = replace(drawn, shifts=dict(few.values()))
    many = some.statistics(600)
    p = {group: [] for group in some.shifts}
    for k in range(600):
        for group, b in some.judged({g: t[k] for g, t in many.items()}, monkeypatch).items():
            p[group].append(b.p_value)
    for group, values in p.items():
        assert stats.kstest(values, "uniform").pvalue > 1e-4, str(group)


@pytest.mark.parametrize("sigma", [1.0, 5.0], ids=["as they say", "five times that"])
def test_by_chance_nothing_is_found_more_often_than_is_said(drawn, sigma, monkeypatch):
    """Nor where all rows scatter more than they say: each kind is measured by its own bulk. With
    many of a kind p-values are larger than uniform, as their scale is never taken to be below 1."""
    count = 100
    many = drawn.statistics(count, sigma)
    alike = {group: (group.kind, group.kind == "body" and group.what) for group in many}
    p, smallest = {}, []
    for k in range(count):
        found = drawn.judged({g: t[k] for g, t in many.items()}, monkeypatch)
        smallest.append(min(b.p_adjusted for b in found.values()))
        for group, b in found.items():
            p.setdefault(alike[group], []).append(b.p_value)
    for kind, values in p.items():
        for level in (0.5, 0.1, 0.01):
            # Groups of a draw share its scale, so draws count, not groups.
            slack = 4 * np.sqrt(level / count)
            assert np.mean(np.array(values) < level) < level + slack, (kind, level)
    # One in a hundred: six of 100 have a chance of 5e-4.
    assert np.sum(np.array(smallest) < 0.01) < 6


def test_a_stated_sigma_counts_beside_a_few_groups(drawn, monkeypatch):
    """Of CAD there are a dozen values: alone they tell their scale so badly that one of them could
    be off by 12 of its sigmas. Judged with what is stated, every named size is smaller."""
    frames = {g: s for g, s in drawn.shifts.items() if g.kind == "frame"}
    assert sum(s.dof for s in frames.values()) < 60
    limits = {}
    for stated in (0.0, judged.STATED):
        monkeypatch.setattr(judged, "STATED", stated)
        limits[stated] = drawn.judged({}, monkeypatch)
    for group in frames:
        alone, both = (limits[stated][group] for stated in (0.0, 8.0))
        taken = stats.chi2(both.shift.dof).isf(judged.ALPHA_BLUNDER / both.looks)
        assert taken < both.limit < 0.8 * alone.limit, "beyond chance, were the sigma known"


def test_no_reading_is_wrong_of_a_joint_all_of_whose_readings_scatter(drawn, monkeypatch):
    """Each joint is measured by its own readings: those of the first move the LiDAR furthest."""
    rng, joint = np.random.default_rng(5), "joint_1"
    mine = {g: s for g, s in drawn.shifts.items() if g.what == joint}
    far = {g: 16.0 * rng.chisquare(s.dof) for g, s in mine.items()}
    found = drawn.judged(far, monkeypatch)
    others = next(b for g, b in found.items() if g.what == "joint_2" and b.shift.dof == 1)
    assert max(far.values()) > others.limit, "wrong, were it of another joint"
    assert not any(found[g].found for g in mine)
    wild = max(far, key=far.get)
    assert drawn.judged(far | {wild: 60.0 * far[wild]}, monkeypatch)[wild].found


@pytest.mark.long
def test_a_shift_of_the_detectable_size_is_found_four_times_in_five(drawn, monkeypatch):
    """Of one group, the others being as they are in the recording, along any of its axes."""
    rng, hits = np.random.default_rng(1), []
    noise = drawn.groups.beyond(rng.standard_normal((len(drawn.groups.b), 40)))
    plain = drawn.judged({}, monkeypatch)
    for group in list(drawn.shifts)[::8]:
        units = np.array(drawn.shifts[group].units)
        for unit, size in plain[group].detectable.items():
            for k in rng.choice(40, 10, replace=False):
                offset = size * (np.arange(len(units)) == rng.choice(np.flatnonzero(units == unit)))
                right = noise[:, k] + drawn.groups.beyond(drawn.groups.shifted(group, offset))
                (statistic,), _ = drawn.groups.statistics(group, right[:, None])
                now = drawn.judged({group: float(statistic)}, monkeypatch)[group]
                assert now.found == (statistic > now.limit)
                hits.append(now.found)
    assert len(hits) > 200
    assert 0.7 < np.mean(hits) < 0.9


@pytest.mark.parametrize("most", [1, 2, 3])
def test_of_many_scans_some_drawn_evenly_tell_what_they_tell_among_all(tmp_path, monkeypatch, most):
    case, linear = with_range_zero(tmp_path)
    others = Others.of(linear, case.start.problem)
    every = of_poses(others, [])
    monkeypatch.setattr("calib.blunders.shifts.TELLING_SCANS", most)
    some = of_poses(others, [])
    scans = len(case.start.problem.scans)
    assert scans == 4
    chosen = drawn_evenly(scans, most, seed=0)
    at = np.arange(6 * scans).reshape(scans, 6)[chosen].ravel()
    assert len(some.score) == len(at) == 6 * most
    size = np.sqrt(np.diag(every.information)[at])
    np.testing.assert_allclose(some.score / size, every.score[at] / size, atol=1e-6)
    unit = np.outer(size, size)
    expected = every.information[np.ix_(at, at)] / unit
    np.testing.assert_allclose(some.information / unit, expected, atol=1e-6)
    np.testing.assert_array_equal(some.group, every.group[at])


def test_an_arm_far_from_as_drawn_is_plainly_wrong():
    """Where a fit explains all by a link turned over, nothing is left for a test."""
    moved = {
        # How a tool hangs, CAD may not know; and a dot in its name says nothing.
        "tool.a": {"change": 1.5, "sigma": 0.01, "unit": "rad", "drawn": False},
        "arm_geometry.j2.tilt_b": {"change": -3.14, "sigma": 0.003, "unit": "rad", "drawn": True},
        "arm_joint_offset.j4": {"change": 0.2, "sigma": 0.005, "unit": "rad", "drawn": True},
        "arm_link_length.j3": {"change": 0.9, "sigma": 0.005, "unit": "m", "drawn": True},
    }
    (found,) = told.not_as_drawn(moved)
    assert (found["kind"], found["name"]) == ("frame", "arm_geometry.j2.tilt_b")
    assert found["size"] == 3.14 and found["without"] is None
    assert "is 180 deg from where it is drawn" in found["sentence"]
