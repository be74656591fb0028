"""What changed between two runs: as a fit from the first finds it, with honest chances."""

import json
import shutil
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.stats import kstest

from calib.problem.prior import JointPrior
from calib.problem.unknowns import Key, Unknown
from calib.recalibration.letgo import let_go
from calib.recalibration.newer import RefittedPrior
from calib.runs.asked.moved import _apart, _differences, _models_differ, moved
from calib.runs.asked.pair import Covariances, Pair, unknowns_of
from calib.runs.belief import cautions, forbids
from calib.runs.calibrate import calibrate
from calib.runs.diagnose import diagnose
from calib.runs.run import Run
from calib.show.comparison import moved_document
from calib.show.headline import moved_sentence
from chains.errors import InputError
from sensors.recording import write_table

from ..mishaps import Scene
from .bumps import BUMP, bump, bumped, keep

NAMES, DIM = ("mount", "lidar", "arm", "unseen"), 3
SIZE = DIM * len(NAMES)
CAD = np.repeat([0.5, 1.0, 2.0, 1.0], DIM)  # sigmas
RUN = SimpleNamespace(summary={"sigmas_widened_by": 1.0})


def unknowns():
    """Links as CAD knows them."""
    blocks = np.split(CAD, len(NAMES))
    return [
        Unknown(
            name=name,
            kind="vector",
            mean=np.zeros(DIM),
            sigma=sigma,
            dofs=("a", "b", "c"),
            units=("m",) * 3,
        )
        for name, sigma in zip(NAMES, blocks, strict=True)
    ]


def values(x):
    return dict(zip(NAMES, np.split(x, len(NAMES)), strict=True))


def pair(first, second):
    """Two estimates (x, graph, reported) of the same links."""
    return Pair(
        held=unknowns(),
        then=values(first[0]),
        now=values(second[0]),
        first=Covariances(*first[1:]),
        second=Covariances(*second[1:]),
        is_frame=np.ones(SIZE, bool),
    )


def fitted(J, y, noise=1.0):
    """An estimate from CAD and rows that err by `noise` times their sigmas."""
    information = J.T @ J
    graph = np.linalg.inv(information + np.diag(CAD**-2))
    return graph @ J.T @ y, graph, graph + (noise**2 - 1.0) * graph @ information @ graph


@pytest.fixture
def world():
    """Rows of two recordings: of mount and lidar only sums are seen, and one link not at all."""
    rng = np.random.default_rng(7)
    both = rng.normal(size=(2, 40, SIZE)) / 0.03
    both[:, :, DIM : 2 * DIM] = both[:, :, :DIM] @ np.diag([0.5, 2.0, 1.0])
    both[:, :, 3 * DIM :] = 0.0

    def draw(move, noise=1.0):
        truth = CAD * rng.normal(size=SIZE)
        first, second = both
        a = first @ truth + rng.normal(size=40)
        b = second @ (truth + move) + noise * rng.normal(size=40)
        return (first, a), (second, b)

    return draw


def found(draw, noise=1.0):
    """The links by name."""
    first, second = fitted(*draw[0]), fitted(*draw[1], noise)
    return {link.name: link for link in _apart(pair(first, second), RUN)}


@pytest.mark.parametrize("size", [0.0, 0.4])
def test_it_is_what_a_fit_from_the_first_finds(world, size):
    move = np.zeros(SIZE)
    move[2 * DIM] = size
    draw = world(move)
    (x, _, covariance), (J, y) = fitted(*draw[0]), draw[1]

    def from_the_rows(prior):
        weight = np.linalg.inv(prior.covariance)
        known = np.linalg.inv(weight + J.T @ J)
        return RefittedPrior(known @ (weight @ x + J.T @ y) - x, known, known)

    links = {
        link.name: link
        for link in let_go(JointPrior(unknowns(), values(x), covariance), from_the_rows)
    }
    assert [n for n, link in links.items() if link.moved] == (["arm"] if size else [])
    for name, link in found(draw).items():
        assert (link.moved, link.parameters) == (links[name].moved, links[name].parameters)
        assert link.change == pytest.approx(links[name].change, abs=1e-8)
        assert link.sigma == pytest.approx(links[name].sigma, rel=1e-6)
        p = links[name].p_value
        assert link.p_value == (p if p is None else pytest.approx(p, rel=1e-5))


@pytest.mark.parametrize("noise", [1.0, 2.0])
def test_chances_are_chances_where_nothing_moved(world, noise):
    """CAD, which both fits took, is counted once; rows may err more than their sigmas say."""
    draws = [found(world(np.zeros(SIZE), noise), noise) for _ in range(300)]
    for name in ("mount", "lidar", "arm"):
        assert kstest([links[name].p_value for links in draws], "uniform").pvalue > 1e-3
    assert np.mean([any(link.moved for link in links.values()) for links in draws]) < 0.03
    assert draws[0]["unseen"].p_value is None


@pytest.mark.long
def test_what_moved_has_an_honest_sigma(world):
    move = np.zeros(SIZE)
    move[2 * DIM : 3 * DIM] = [0.3, -0.2, 0.25]
    draws = [found(world(move)) for _ in range(200)]
    assert all([n for n in NAMES if links[n].moved] == ["arm"] for links in draws)
    z = [(links["arm"].change - move[2 * DIM : 3 * DIM]) / links["arm"].sigma for links in draws]
    assert np.abs(np.mean(z)) < 0.2
    assert np.std(z) == pytest.approx(1.0, abs=0.12)


def nested(rng, size, count=300):
    """Estimates of the same rows without and with a parameter more, of that size."""
    J = rng.normal(size=(60, SIZE)) / 0.1
    more = J @ np.repeat([0.4, 0.3, -0.5, 0.4], DIM) + rng.normal(size=60) / 0.1
    for _ in range(count):
        y = J @ (CAD * rng.normal(size=SIZE)) + size * more + rng.normal(size=60)
        without = fitted(J, y)
        A = np.column_stack([J, more])
        C = np.linalg.inv(A.T @ A + np.diag(np.append(CAD**-2, 1e-6)))
        graph = C[:SIZE, :SIZE]
        yield pair(without, ((C @ A.T @ y)[:SIZE], graph, graph))


def test_nested_models_of_the_same_rows_differ_as_hausman_says():
    """At the size that the larger model estimates as zero the difference is chance."""
    draws = [_differences(each, 0) for each in nested(np.random.default_rng(3), 0.0)]
    assert all(not bounds for _, bounds in draws)
    change = np.array([links[0].change for links, _ in draws])
    sigma = draws[0][0][0].sigma
    assert change.std(axis=0) / sigma == pytest.approx(np.ones(DIM), abs=0.15)
    assert np.mean([any(link.moved for link in links) for links, _ in draws]) < 0.03
    draws = [_differences(each, 0) for each in nested(np.random.default_rng(3), 2.0, 20)]
    assert all(any(link.moved for link in links) for links, _ in draws)


def test_where_it_is_not_known_how_two_runs_go_together_a_bound_is_given():
    for efficient in (None, 1):  # the larger model cannot be the efficient one: it knows less
        for each in nested(np.random.default_rng(3), 0.0, 3):
            links, bounds = _differences(each, efficient)
            assert bounds == NAMES
            at = slice(0, DIM)
            least = [np.sqrt(np.diag(k.reported))[at] for k in (each.first, each.second)]
            assert (links[0].sigma >= sum(least) - 1e-12).all()


def test_names_of_parameters_may_have_dots(tmp_path):
    """As those of an arm's geometry do: joint_2.tx of arm_geometry."""
    columns = {
        "unknown": np.array(["arm_geometry", "arm_geometry", "lidar"]),
        "parameter": np.array(["joint_2.tx", "joint_2.ty", "tx"]),
        "unit": np.array(["m"] * 3),
        "residual": np.array([0.1, 0.2, 0.3]),
        "sigma": np.array([1.0, 2.0, 3.0]),
        "whitened": np.array([0.1, 0.1, 0.1]),
    }
    (tmp_path / "residuals.parquet").mkdir()
    write_table(tmp_path / "residuals.parquet/_prior.parquet", columns)
    arm = [Key("arm_geometry", "joint_2.tx"), Key("arm_geometry", "joint_2.ty")]
    run = SimpleNamespace(
        folder=tmp_path, solution=SimpleNamespace(keys=(*arm, Key("lidar", "tx")), recordings={})
    )
    found = {unknown.name: (unknown.dofs, theta.tolist()) for unknown, theta in unknowns_of(run)}
    assert found == {
        "arm_geometry": (("joint_2.tx", "joint_2.ty"), [0.1, 0.2]),
        "lidar": (("tx",), [0.3]),
    }


@pytest.fixture(scope="module")
def runs(once):
    """Runs of a rig before and after somebody bumped into its LiDAR, by name."""
    folder = once(bumped)
    return {name: Run.open(folder / name) for name in ("a", "b", "from_a", "grown")}


@pytest.mark.slow
def test_two_plain_runs_tell_what_the_fit_from_the_first_tells(runs):
    """Of other recordings, to a tenth of a sigma; without reading one of them."""
    plain, told = moved(runs["a"], runs["b"]), moved(runs["a"], runs["from_a"])
    assert (plain.relation, told.relation) == ("independent", "prior")
    assert told.links == runs["from_a"].summary["links"]
    assert [link["name"] for link in plain.links] == [link["name"] for link in told.links]
    for link, other in zip(plain.links, told.links, strict=True):
        assert link["moved"] == other["moved"] == (link["name"] == "lidar")
        if link["moved"]:
            off = np.subtract(link["change"], other["change"]) / other["sigma"]
            assert np.abs(off).max() < 0.1
            # How far rows err together is estimated anew by each fit, here from nine stops.
            assert link["sigma"] == pytest.approx(other["sigma"], rel=0.15)
            assert np.abs((link["change"] - BUMP) / link["sigma"]).max() < 4
        else:
            assert link["p_value"] == pytest.approx(other["p_value"], abs=0.15)
    sentence = moved_document(plain)["sentence"]
    assert sentence.startswith("lidar moved ") and sentence.endswith("; nothing else moved.")


@pytest.mark.long
def test_a_body_that_was_knocked_far_is_told_and_its_cad_not_blamed(runs, tmp_path):
    """By 8 of CAD's sigmas. Only between its markers and the arm's base is the rig's base seen: it
    may be either, and no third."""
    shutil.copytree(runs["a"].folder.parent / "after", tmp_path / "after")
    scene, turn = Scene(tmp_path / "after", np.random.default_rng()), np.array([0.025, 0, 0])
    scene.move("base_markers", list(range(len(scene.names))), np.zeros(3), turn)
    run = calibrate([tmp_path / "after"], tmp_path / "run", hold_out="none", prior=runs["a"].folder)
    links = {link["name"]: link for link in run.summary["links"]}
    alike, moved = {"base_markers", "arm_base"}, [n for n in links if links[n]["moved"]]
    (base,) = alike.intersection(moved)
    assert set(moved) == {base, "lidar"} and {base, *links[base]["instead"]} == alike
    found = np.linalg.norm(np.array(links[base]["change"])[:3])
    assert found == pytest.approx(0.025, abs=0.0005)
    assert not links["lidar"]["instead"]
    assert f"(or, in its place, {links[base]['instead'][0]}: these" in moved_sentence(
        list(links.values())
    )
    assert run.summary["sigmas_widened_by"] == 1.0 and run.summary["misfit"]["cad"] < 1.7
    assert not [each for each in diagnose(run).blunders if each["kind"] == "frame"]
    # A week later all is where it was; CAD tells no better of what moved before.
    shutil.copytree(tmp_path / "after", tmp_path / "week")
    keep(tmp_path / "after", ("L03", "L04"))
    keep(tmp_path / "week", ("L05",))
    first, later = tmp_path / "first", tmp_path / "later"
    calibrate([tmp_path / "after"], first, hold_out="none", prior=runs["a"].folder)
    run = calibrate([tmp_path / "week"], later, hold_out="none", prior=first)
    assert not any(link["moved"] for link in run.summary["links"])
    assert set(run.summary["moved_since_cad"]) >= alike and run.summary["misfit"]["cad"] < 1.7
    assert not forbids(run) and not any("from CAD" in each for each in cautions(run))
    assert not diagnose(run).blunders


@pytest.mark.long
def test_what_moved_between_recordings_of_one_fit_is_no_chance(runs, tmp_path):
    """A LiDAR that sat elsewhere in the second of two seemed to sit anew at every stop."""
    folder = runs["a"].folder.parent
    both = [folder / "before", folder / "after"]
    found = diagnose(calibrate(both, tmp_path / "run", hold_out="none"))
    (moved,) = found.blunders
    assert (moved["kind"], moved["name"], moved["recording"]) == ("frame", "lidar", "after")
    assert moved["axis"] == "rz" and abs(moved["size"] - BUMP[2]) < 4 * moved["sigma"]
    by = f"{1e3 * moved['size']:.3g} ± {1e3 * moved['sigma']:.2g} mrad"
    assert found.sentences[0].startswith(f"Between before and after lidar moved, rz by {by}, and")
    assert not any("random as far as" in each for each in found.sentences)
    shutil.copytree(folder / "after", tmp_path / "again")
    bump(tmp_path / "again", -BUMP)
    found = diagnose(calibrate([both[0], tmp_path / "again"], tmp_path / "same", hold_out="none"))
    assert not found.blunders


def test_what_a_run_knows_is_no_news_to_a_fit_from_it(runs, tmp_path):
    """Its own recording, one that it knows by its own prior, and a part of one: data count once."""
    home = runs["a"].folder.parent
    part = shutil.copytree(home / "before", tmp_path / "part")
    keep(part, ("L00",))
    for recording, run in (("before", "a"), ("after", "from_a"), ("before", "from_a")):
        with pytest.raises(InputError, match=r"--prior .*rests on L0.*data count once"):
            calibrate(home / recording, tmp_path / "run", prior=home / run)
    with pytest.raises(InputError, match="rests on L00P00, L00P01, L00P02 of"):
        calibrate(part, tmp_path / "run", prior=home / "a")


@pytest.mark.slow
def test_runs_of_one_recording_have_moved_nothing(runs):
    found = moved(runs["a"], runs["grown"])
    assert (found.relation, found.bounds) == ("shared", ())
    said = " ".join([moved_document(found)["sentence"], *found.remarks])
    assert "moved." not in said and "due to the model" in said
    assert f"Only {runs['grown'].folder} has range_scale" in said
    assert all(link["p_value"] > 1e-3 for link in found.links)
    sigma = {link["name"]: np.max(link["sigma"]) for link in found.links}
    known = dict(
        zip(runs["a"].solution.names, np.sqrt(np.diag(runs["a"].solution.covariance)), strict=True)
    )
    assert sigma["lidar"] < 0.5 * known["lidar.tx"]
    found = moved(runs["from_a"], runs["b"])
    assert found.relation == "shared" and len(found.bounds) == len(found.links)


@pytest.mark.slow
def test_runs_that_cannot_be_compared_are_refused(runs, tmp_path):
    with pytest.raises(InputError, match="by its --prior"):
        moved(runs["from_a"], runs["a"])
    with pytest.raises(InputError, match="given twice"):
        moved(runs["a"], runs["a"])
    shutil.copytree(runs["b"].folder, tmp_path / "b")
    (tmp_path / "b/residuals.parquet/_prior.parquet").unlink()
    with pytest.raises(InputError, match="is missing; the run is incomplete"):
        moved(runs["a"], Run.open(tmp_path / "b"))


@pytest.mark.slow
def test_the_command_says_it(runs, rigcal):
    a, b, grown = (str(runs[name].folder) for name in ("a", "b", "grown"))
    code, out, err = rigcal("moved", a, b)
    assert (code, err) == (0, "")
    assert " ".join(out.split()).startswith("lidar moved +") and "Different recordings" in out
    code, out, _ = rigcal("moved", a, b, "--json")
    told = json.loads(out)
    assert told.keys() == {"runs", "relation", "sentence", "links", "upper_bounds", "remarks"}
    assert told["relation"] == "independent" and len(told["links"]) == 9
    code, out, _ = rigcal("moved", a, grown)
    assert code == 0 and "no estimate differs significantly" in out


def test_runs_of_different_arms_are_told_from_runs_of_one():
    """Of a recording that shows fewer labels, or of a joint that was fixed, nothing is said."""

    def run(name, *keys, fixed=()):
        model = {"recordings": [{"rig": "lab"}], "fixed": fixed}
        solution = SimpleNamespace(keys=[Key(*key) for key in keys])
        return SimpleNamespace(folder=name, effects=[], model=model, solution=solution)

    zeros = [("arm_joint_offset", f"joint_{n}") for n in range(1, 7)]
    label = ("moved_surface", "3_chair")
    six, four = run("six", *zeros, label), run("four", *zeros[:4])
    named = ", ".join(".".join(zero) for zero in zeros[4:])
    assert list(_models_differ(six, four)) == [
        f"Only six has {named}: joints of four differ, or are not read"
    ]
    held = run("held", *zeros[1:], ("moved_surface", "4_bin"), fixed=[".".join(zeros[0])])
    assert not list(_models_differ(six, held))
