"""Effects: what a basis claims is what the geometry, or the measurement, does."""

from dataclasses import replace

import numpy as np
import pytest

from calib import effects
from calib.effects import Effect, FrameOffset, OneHot, Param, Site, View
from calib.forward import Term, place
from calib.problem import build
from calib.problem.model import Model, Source
from calib.rig import load_rig
from chains.errors import InputError

from . import rigs
from .hidden import as_needed, coarse, every_column
from .rescanned import rescanned


@pytest.fixture(scope="module")
def problem(tmp_path_factory):
    source = Source.open(rigs.write(tmp_path_factory.mktemp("effects") / "box"))
    return build([source], Model())


@pytest.fixture(scope="module")
def views(tmp_path_factory):
    """A function: what an effect sees at its site, of a recording with all that any looks at."""
    source, _ = every_column(tmp_path_factory.mktemp("views") / "rec")
    problem = build([source], Model())
    beams = problem.scans[-1].rows(problem.initial).view
    beams = replace(beams, rig=coarse(beams.rig))
    count = len(source.recording.stops)
    stops = View(source.rig, count, source.columns, source.recording.joints)
    targets = View(source.rig, 4, {"target": np.arange(4)}, np.zeros((1, 0)))
    at = {
        **dict.fromkeys((Site.BEAM, Site.REFERENCE, Site.NOISE), beams),
        **dict.fromkeys((Site.JOINTS, Site.EDGE, Site.ROOT, Site.TRACKER), stops),
        Site.TARGET: targets,
    }

    def seen(effect):
        view = at[effect.site]
        return replace(view, rig=as_needed(view.rig, effect))

    return seen


def shape(site, rig):
    return {
        Site.BEAM: (3,),
        Site.JOINTS: (len(rig.joint_names),),
        Site.EDGE: (len(rig.tree.edges), 6),
        Site.ROOT: (6,),
        Site.TRACKER: (len(rig.tracker.bodies), 6),
        Site.TARGET: (3,),
        Site.REFERENCE: (3,),
        Site.NOISE: (1,),
    }[site]


# Of edges, what has unknowns for each joint.
OF_JOINTS = ("arm_link_length", "arm_axis_tilt", "arm_geometry", "arm_link_bending")
# The rig of these views has no rails, and no joint follows another: see test_rail, test_coupled.
SHAPED = [e for e in effects.CATALOGUE if e.joint_kind not in ("prismatic", "mimic")]


@pytest.mark.parametrize("effect", SHAPED, ids=lambda e: e.name)
def test_a_basis_has_the_shape_of_its_site(effect, views):
    view = views(effect)
    params, basis = effect.params(view.rig), effect.basis(view)
    assert params and len({p.name for p in params}) == len(params)
    if isinstance(basis, OneHot):
        assert basis.size == len(params) and basis.values.shape == (
            view.rows,
            *shape(effect.site, view.rig),
        )
        assert basis.index.shape == (view.rows,)
        assert basis.index.min() >= -1 and basis.index.max() < basis.size
        moves = np.bincount(basis.index[basis.index >= 0], minlength=basis.size) > 0
        basis = basis.values
    else:
        assert basis.shape[0] in (1, view.rows)
        assert basis.shape[1:] == (*shape(effect.site, view.rig), len(params))
        moves = np.abs(basis).reshape(-1, len(params)).max(axis=0) > 0
    assert np.isfinite(basis).all()
    # A parameter that may differ from zero does something; one that is held does nothing.
    assert (moves <= [p.sigma > 0 for p in params]).all() and moves.any()


@pytest.mark.parametrize("effect", SHAPED, ids=lambda e: e.name)
def test_a_parameter_of_a_joint_moves_that_joint_alone(effect, views):
    """And none is of a joint because of its name: a gantry's may be called x and y, as are the two
    ways in which a foot tilts."""
    view = views(effect)
    joints = np.array(view.rig.joint_names)
    about = np.array([p.joint for p in effect.params(view.rig)])
    if effect.site is Site.JOINTS:
        moved = np.abs(effect.basis(view)).max(axis=0) > 0
        alone = moved.sum(axis=0) == 1
        # Of a payload one way may bend one joint alone; members' scatter is of stops.
        several = effect.family == "arm_payload_offset" or effect.by_chance
        assert several or np.array_equal(about[alone], joints[moved[:, alone].argmax(axis=0)])
        assert set(about[~alone]) <= {""} or not moved[:, ~alone].any()
    elif effect.family in OF_JOINTS:
        assert len(set(about) - {""}) > 1 and set(about) <= {"", *joints}
    else:
        assert set(about) == {""}


@pytest.mark.parametrize("effect", SHAPED, ids=lambda e: e.name)
def test_the_catalogue_says_what_an_effect_is(effect, views):
    assert effects.find(effect.name) is effect and effects.read(effect.document()) is effect
    assert effect.formula and effect.typical and effect.source
    others = {e.name for e in effects.CATALOGUE} | {*views(effect).rig.tree.edge_names, "faro"}
    assert set(effect.confounded_with) <= others - {effect.name}
    view = views(effect)
    units = dict.fromkeys(p.unit for p in effect.params(view.rig))
    assert effect.unit == ", ".join(units)
    assert set(effect.covariates) <= {*view.columns, "joints"}
    # It looks at nothing else.
    columns = {name: view.columns[name] for name in effect.covariates if name != "joints"}
    if "time_s" in columns:  # what follows from it
        columns |= {n: c for n, c in view.columns.items() if n.startswith(("moved.", "travel."))}
    # What says which row it is of.
    own = {Site.REFERENCE: "normal", Site.TARGET: "target"}.get(effect.site)
    normal = {own: view.columns[own]} if own else {}
    joints = view.joints if {"joints", "time_s"} & set(effect.covariates) else view.joints * np.nan
    effect.basis(View(view.rig, view.rows, columns | normal, joints))


def test_every_name_is_there_once():
    names = [effect.name for effect in effects.CATALOGUE]
    assert len(set(names)) == len(names) > 40


@pytest.fixture(scope="module")
def bare(tmp_path_factory):
    """A LiDAR alone in a room without labels, and an arm alone that weighs nothing."""
    folder = tmp_path_factory.mktemp("bare")
    none = {"tracker": None, "target": None, "reference": None}
    carrier = {"arm_base": rigs.drawing()["frames"]["arm_base"]}
    rigs.write(folder / "lidar", arm=None, frames={}, **none)
    rigs.write(folder / "arm", lidar=None, frames=carrier, **none)
    return load_rig(folder / "lidar"), load_rig(folder / "arm")


@pytest.mark.parametrize("effect", effects.CATALOGUE, ids=lambda e: e.name)
def test_a_rig_without_what_it_acts_on_has_no_such_effect(effect, bare):
    lidar, arm = bare
    unknown = {"label_range_offset", "label_incidence_bias", "range_quantisation"}
    of_lidar = effect.site in (Site.BEAM, Site.NOISE) and effect.name not in unknown
    assert bool(effect.params(lidar)) == (of_lidar or effect.needs_standing)
    unknown = {"arm_gravity_sag", "arm_link_bending", "base_flex", "mount_bending"}
    unknown |= {"mount_slip", "mount_creep", "mount_settle", "lidar_slip"}
    unknown |= {"stop_pose_scatter"}  # of a LiDAR
    unknown |= {"arm_mimic_ratio"}  # no joint follows another
    of_arm = effect.site in (Site.JOINTS, Site.EDGE) and effect.name not in unknown
    assert bool(effect.params(arm)) == of_arm


def test_the_default_effects_are_in_the_catalogue():
    assert set(effects.DEFAULT) <= {e.name for e in effects.CATALOGUE}


def test_an_unknown_effect_is_refused_and_the_nearest_named():
    with pytest.raises(InputError, match="did you mean 'ring_range_offset'"):
        effects.find("ring_range_ofset")


def placed(problem, effect, theta):
    """Where the lidar is at every stop under one effect."""
    source = problem.sources[0]
    term = Term(effect, effect.name, np.arange(len(theta)))
    values = {effect.name: np.asarray(theta, float)}
    chain = place(source.rig, [term], source.recording.joints, source.columns, "root", None)
    return chain.in_root("lidar", values).T


@pytest.mark.parametrize("edge", range(len(rigs.ARM)))
def test_a_link_is_longer_along_its_own_origin(problem, edge):
    theta = np.zeros(len(rigs.ARM))
    theta[edge] = 0.02
    found = placed(problem, effects.find("arm_link_length"), theta)
    for T, (_, joints) in zip(found, rigs.STOPS.values(), strict=True):
        expected = rigs.placed("lidar", joints, rigs.Hardware(link_m=theta))
        np.testing.assert_allclose(T, expected.as_matrix(), atol=1e-12)


def test_a_joint_offset_adds_to_what_the_encoder_reports(problem):
    theta = [0.02, -0.03, 0.01]
    found = placed(problem, effects.find("arm_joint_offset"), theta)
    for T, (_, joints) in zip(found, rigs.STOPS.values(), strict=True):
        expected = rigs.placed("lidar", np.add(joints, theta), rigs.Hardware())
        np.testing.assert_allclose(T, expected.as_matrix(), atol=1e-12)
    units = [p.unit for p in effects.find("arm_joint_offset").params(problem.sources[0].rig)]
    assert units == ["rad", "rad", "m"]


def test_a_frame_is_off_in_its_own_axes(problem):
    twist = np.array([0.02, -0.01, 0.03, 0.004, 0.005, -0.006])
    found = placed(problem, FrameOffset("mount"), twist)
    for T, (_, joints) in zip(found, rigs.STOPS.values(), strict=True):
        expected = rigs.placed("lidar", joints, rigs.Hardware(frames={"mount": twist}))
        np.testing.assert_allclose(T, expected.as_matrix(), atol=1e-12)


def test_a_range_offset_reads_long(problem):
    """measured = true + a: raising the measured range and the offset together changes nothing."""
    scan, values = problem.scans[0], problem.initial
    association = scan.associate(values, near_edges=False)
    offset = np.linspace(-0.02, 0.03, rigs.RINGS)
    before = scan.rows(values, association)
    longer = reaching(scan, lambda ring: offset[ring])
    after = longer.rows({**values, "ring_range_offset": offset}, association)
    np.testing.assert_allclose(after.residual_m, before.residual_m, atol=1e-9)
    assert np.abs(longer.rows(values, association).residual_m - before.residual_m).max() > 0.02


def reaching(scan, more_m):
    """The stop, its beams reaching further by `more_m` of their ring, in the same directions."""
    read, origin_m = scan.recording.scan(scan.index), rigs.fan()[0]
    direction = rigs.fan()[1]
    longer = read.xyz_m + np.asarray(more_m(read.ring))[:, None] * direction
    assert np.linalg.norm(read.xyz_m - origin_m, axis=1).min() > 0.1
    return rescanned(scan, replace(read, xyz_m=longer))


class Nosy(Effect):
    """Looks at everything of a beam that noise in the range could spoil."""

    name, site = "nosy", Site.BEAM
    columns = ("range_m", "incidence_rad", "azimuth_rad", "elevation_rad", "surface", "patch")

    def params(self, rig):
        return tuple(Param(name, "m", 1.0) for name in self.columns)

    def basis(self, view):
        basis = np.zeros((view.rows, 3, len(self.columns)))
        basis[:, 0] = np.stack([view[name] for name in self.columns], axis=1)
        return basis


def test_covariates_are_predicted_not_measured(problem):
    """Noise common to a column and its residual would look like an effect."""
    scan, values = problem.scans[0], {**problem.initial, "nosy": np.zeros(6)}
    scan = replace(scan, terms=[*scan.terms, Term(Nosy(), "nosy", np.arange(6))])
    association = scan.associate(values, near_edges=False)
    noise = np.random.default_rng(0).normal(0, 0.02, rigs.RINGS * rigs.COLUMNS)
    noisy = reaching(scan, lambda ring: noise)
    before, after = scan.rows(values, association), noisy.rows(values, association)
    assert np.abs(after.residual_m - before.residual_m).max() > 0.02
    np.testing.assert_allclose(after.dense["nosy"], before.dense["nosy"], atol=1e-9)
    np.testing.assert_allclose(after.sigma_m, before.sigma_m, atol=1e-12)
    assert np.ptp(before.dense["nosy"], axis=0).min() > 0.1


def test_an_absent_column_is_named_with_those_there(views):
    with pytest.raises(InputError, match=r"'moisture'.*temperature_c"):
        views(effects.find("base_flex"))["moisture"]
