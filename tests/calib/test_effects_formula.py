"""Users' own effects: formulas that are parsed, never run, and classes in files."""

import json
from dataclasses import replace

import numpy as np
import pytest
import yaml

from calib import effects
from calib.effects import OneHot, Site, View, load_effects, read, trust_in
from calib.effects.own.expression import Expression
from calib.effects.own.formula import FormulaEffect
from calib.problem import build
from calib.problem.model import Model, Source
from calib.runs.calibrate import calibrate
from calib.simulation import Spec, simulate
from chains.errors import InputError

from . import rigs

DAMP = {
    "name": "damp",
    "site": "range",
    "unit": "m",
    "sigma": 0.01,
    "basis": ["(humidity - 0.45) * range"],
}


@pytest.fixture(scope="module")
def source(tmp_path_factory):
    return Source.open(rigs.write(tmp_path_factory.mktemp("formula") / "box"))


def made(**changes):
    return FormulaEffect.read(DAMP | changes, "mine.yaml", {})


def view_of(source, rows, **columns):
    return View(source.rig, rows, columns, np.zeros((1, 3)))


# ----------------------------------------------------------------------------------------- parsing


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("1 + 2*x - 6/y", lambda x, y: 1 + 2 * x - 6 / y),
        ("-x**2 + +y", lambda x, y: -(x**2) + y),
        ("(x + 1)**0.5 * pi", lambda x, y: np.sqrt(x + 1) * np.pi),
        ("sin(x) * cos(y) + tan(x)", lambda x, y: np.sin(x) * np.cos(y) + np.tan(x)),
        ("exp(-x) + log(y) + sqrt(y) + abs(-x)", lambda x, y: np.exp(-x) + np.log(y) + y**0.5 + x),
        ("minimum(x, y) - maximum(x, 1)", lambda x, y: np.minimum(x, y) - np.maximum(x, 1)),
        ("where(x > y, x, -y)", lambda x, y: np.where(x > y, x, -y)),
        ("(x < 1) - (y >= 2) + (x != y)", lambda x, y: (x < 1) * 1.0 - (y >= 2) + (x != y)),
        ("x / 2e-1 - .5", lambda x, y: x / 0.2 - 0.5),
        ("2", lambda x, y: 2.0),
    ],
)
def test_arithmetic(text, expected):
    x, y = np.array([0.0, 0.5, 3.0]), np.array([2.0, 0.5, 4.0])
    found = Expression(text, "it").value({"x": x, "y": y}.__getitem__)
    np.testing.assert_allclose(found, expected(x, y))


def test_names_are_columns_and_their_aliases():
    text = (
        "range + incidence + azimuth + elevation + intensity + ring + time + moved.turn + range_m"
    )
    assert Expression(text, "it").names == (
        "range_m",
        "incidence_rad",
        "azimuth_rad",
        "elevation_rad",
        "intensity",
        "ring",
        "time_s",
        "moved.turn",
    )


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("2 +", "no arithmetic"),
        ("", "at least 1"),
        ("   ", "no arithmetic"),
        ("range range", "position"),
        ("x = 3", "position 3"),
        ("sine(x)", "position 1: sine is no function here; did you mean sin?"),
        ("1 + cbrt(x)", "position 5: cbrt is no function here; known are sin, cos"),
        ("sin(x, y)", "sin takes 1 value"),
        ("where(x > 1, y)", "where takes 3 values"),
        ("sin(x=1)", "sin takes 1 value"),
        ("sin", "write sin(...)"),
        ("1 < x < 2", "position 1"),
        ("x if y else 1", "position 1"),
        ("x and y", "position 1"),
        ("'a'", "no number"),
        ("True", "no number"),
        ("2j", "no number"),
        ("[x]", "position 1"),
        ("x[0]", "position 1"),
        ("x // 2", "position 1"),
        ("lambda: x", "position"),
        ("__import__('os').system('true')", "no function here"),
        ("(1).real", "a name is letters"),
        ("x.y()", "no function here"),
        ("-" * 60 + "x", "nested more than 50 deep"),
        ("(" * 500, "no arithmetic"),
        ("x" + "+x" * 1000, "longer than"),
        ("1/0", "no finite number"),
        ("9**9**9", "no finite number"),
        ("1" + "0" * 400, "larger than"),
        ("x\0", "no arithmetic"),
    ],
)
def test_what_is_no_arithmetic_is_refused(text, words):
    with pytest.raises(InputError) as refused:
        made(basis=[text])
    assert words in str(refused.value)
    assert "damp" in str(refused.value) or "mine.yaml" in str(refused.value)


def test_an_absent_column_is_named_with_the_nearest(source):
    view = view_of(source, 2, range_m=np.ones(2), humiditty=np.ones(1), normal=np.ones((2, 3)))
    with pytest.raises(
        InputError, match=r"'\(humidity - 0.45\) \* range' of effect 'damp'.*humiditty"
    ):
        made().basis(view)
    with pytest.raises(InputError, match="normal has more than one number a row"):
        made(basis=["normal * 2"]).basis(view)


# ----------------------------------------------------------------------------------------- effects


@pytest.mark.parametrize(("site", "axis"), [("range", 0), ("azimuth", 1), ("elevation", 2)])
def test_a_formula_of_a_beam(source, site, axis):
    effect = made(site=site, basis=["range", "1"], parameters=["k", "a"])
    assert [p.name for p in effect.params(source.rig)] == ["k", "a"]
    found = effect.basis(view_of(source, 3, range_m=np.array([1.0, 2.0, np.inf])))
    np.testing.assert_array_equal(found[:, axis], [[1, 1], [2, 1], [0, 1]])
    found[:, axis] = 0
    assert not found.any() and effect.of_lidar and effect.site is Site.BEAM


def test_a_formula_of_noise_a_joint_or_a_frame(source):
    view = view_of(source, 2, temperature_c=np.array([20.0, 24.0]))
    noise = made(site="noise", basis=["temperature_c"], unit="1")
    np.testing.assert_array_equal(noise.basis(view), [[[20]], [[24]]])
    for site in ("lift", "joint:lift"):
        joint = made(site=site, basis="temperature - 20")
        np.testing.assert_array_equal(joint.basis(view)[:, :, 0], [[0, 0, 0], [0, 4, 0]])
    frame = made(site="mount.tz", basis="temperature - 20")
    found = frame.basis(view)
    edge = source.rig.tree.edge_names.index("mount")
    np.testing.assert_array_equal(found[:, edge, 5, 0], [0, 4])
    assert np.count_nonzero(found) == 1 and frame.site is Site.EDGE
    assert frame.params(source.rig)[0].name == "amount"
    constant = made(site="lift", basis="1")
    assert constant.basis(view).shape == (1, 3, 1)


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"site": "mont.tz"}, "did you mean mount.tz?"),
        ({"site": "lft"}, "did you mean lift?"),
        ({"site": "joint:lifft"}, "no site joint:lifft"),
        ({"site": "rang"}, "did you mean range?"),
    ],
)
def test_a_site_that_the_rig_has_not_is_refused(source, changes, words):
    with pytest.raises(InputError) as refused:
        made(**changes).params(source.rig)
    assert words in str(refused.value) and "damp" in str(refused.value)


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"name": "two words"}, "name"),
        ({"sigma": 0}, "sigma"),
        ({"sigma": "0.1"}, "sigma"),
        ({"basis": []}, "basis"),
        ({"basis": [3]}, "basis.0"),
        ({"parameters": ["a", "b"]}, "2 parameters are named, and basis has 1 formulas"),
        ({"basis": ["1", "range"], "parameters": ["a", "a"]}, "its own"),
        ({"unti": "m"}, "did you mean unit?"),
    ],
)
def test_a_bad_key_is_refused(changes, words):
    with pytest.raises(InputError, match=r"mine\.yaml") as refused:
        made(**changes)
    assert words in str(refused.value)


def test_a_formula_is_spelled_and_read_back(source):
    effect = made(basis=["range", "1"], parameters=["k", "a"], what="Damp air.", typical="1 mm")
    again = read(yaml.safe_load(yaml.safe_dump(effect.document())))
    assert again.document() == effect.document() and again.file == effect.file
    assert again.params(source.rig) == effect.params(source.rig)
    assert again.__doc__ == "Damp air." and "k * (range)" in again.formula


def test_the_catalogue_is_spelled_and_read_back():
    for name in ("range_offset", "range_cyclic@1.3"):
        assert read(effects.find(name).document()).name == name


# ------------------------------------------------------------------------------------------- files


CLASSES = '''
import numpy as np
from calib.effects import Effect, Param, Site

class Base(Effect):
    site = Site.BEAM
    def params(self, rig):
        return (Param("a", "m", 0.01),)

class Lean(Base):
    """Leans."""
    name, shape_name, shape = "lean", "times", 1.0
    def basis(self, view):
        basis = np.zeros((view.rows, 3, 1))
        basis[:, 0, 0] = np.sin(self.shape * view["azimuth_rad"])
        return basis

class Flat(Base):
    name = "flat"
    def basis(self, view):
        return np.array([1.0, 0, 0]).reshape(1, 3, 1)
'''


def test_effects_come_by_name_and_from_files(tmp_path):
    one, many, code = tmp_path / "one.yaml", tmp_path / "many.yml", tmp_path / "mine.py"
    one.write_text(yaml.safe_dump(DAMP))
    many.write_text(yaml.safe_dump([DAMP | {"name": "x"}, DAMP | {"name": "y"}]))
    code.write_text(CLASSES)
    found = load_effects(["range_offset", f"{one}", f" {many}", f"{code}", "range_cyclic@0.7"])
    assert [e.name for e in found] == [
        "range_offset", "damp", "x", "y", "lean", "flat", "range_cyclic@0.7",
    ]  # fmt: skip
    assert [e.name for e in load_effects(f"{code}:Flat, range_offset,,range_offset")] == [
        "flat",
        "range_offset",
    ]
    trust = trust_in(found)
    for effect in found:
        again = read(yaml.safe_load(yaml.safe_dump(effect.document())), trust=trust)
        assert again.name == effect.name and again.document() == effect.document()
    lean = next(e for e in found if e.name == "lean").at(2.0)
    again = read(lean.document(), trust=trust)
    assert (again.name, again.shape) == ("lean@2", 2.0)
    assert load_effects("") == () and load_effects([]) == ()


@pytest.mark.parametrize(
    ("file", "text", "item", "words"),
    [
        ("a.yaml", None, "a.yaml", "does not exist"),
        ("a.yaml", "name: [", "a.yaml", "a.yaml"),
        ("a.yaml", "[]", "a.yaml", "lists no effect"),
        ("a.yaml", "3", "a.yaml", "mapping"),
        ("a.yaml", "- {name: x}", "a.yaml", "is missing"),
        ("a.yaml", yaml.safe_dump(DAMP | {"name": "range_cyclic"}), "a.yaml", "in the catalogue"),
        ("a.yaml", yaml.safe_dump([DAMP, DAMP | {"unit": "1"}]), "a.yaml", "called 'damp' too"),
        ("a.py", None, "a.py", "does not exist"),
        ("a.py", "1/0", "a.py", "ZeroDivisionError"),
        ("a.py", "def", "a.py", "SyntaxError"),
        ("a.py", "x = 1", "a.py", "no effect"),
        ("a.py", CLASSES, "a.py:Flatt", "did you mean Flat?"),
        ("a.py", CLASSES.replace('"flat"', '"range_offset"'), "a.py:Flat", "in the catalogue"),
        ("a.py", CLASSES.replace('name = "flat"', ""), "a.py:Flat", "needs a name"),
        ("a.py", CLASSES.replace("site = Site.BEAM", ""), "a.py:Flat", "needs a site"),
        ("a.py", CLASSES.replace("params(self", "__init__(self"), "a.py:Flat", "no effect"),
        ("a.py", f"{CLASSES}    __init__ = lambda self, x: None", "a.py:Flat", "TypeError"),
    ],
)  # fmt: skip
def test_a_bad_file_is_refused_by_name(tmp_path, file, text, item, words):
    if text is not None:
        (tmp_path / file).write_text(text)
    with pytest.raises(InputError) as refused:
        load_effects([str(tmp_path / item)])
    assert words in str(refused.value)
    assert file in str(refused.value) or "catalogue" in words


@pytest.mark.parametrize(
    "document", [{"python": "a.py"}, {"python": "a.py", "name": "x", "shape": "y"}]
)
def test_a_bad_document_is_refused(document):
    with pytest.raises(InputError, match=r"model\.yaml"):
        read(document)


def test_a_formula_is_fitted_like_any_effect(source):
    """Its rows move with its parameters; its name is that of its variable."""
    effect = made(basis=["0.1 * range", "where(azimuth > 0, 1, 0)"], parameters=["k", "half"])
    problem = build([source], Model((effect,)))
    scan, values = problem.scans[0], problem.initial
    association = scan.associate(values, near_edges=False)
    before = scan.rows(values, association)
    theta = np.array([0.02, 0.003])
    after = scan.rows({**values, "damp": theta}, association)
    view = before.view
    longer = 0.002 * view["range_m"] + 0.003 * (view["azimuth_rad"] > 0)
    moved = (before.residual_m - after.residual_m)[before.usable]
    np.testing.assert_allclose(moved, longer[before.usable], atol=1e-9)


# ------------------------------------------------------------------------------------------- sites


@pytest.mark.parametrize(
    ("catalogue", "place", "formula", "column"),
    [
        ("body_slip@100", "tracker:mount_markers.ty", "where(elapsed > 100, 1, 0)", 4),
        ("target_rod_tilt", "target.y", "0.18", 1),
        ("target_sphere_offset", "target.z", "-1", 0),
        ("moved_surface", "reference", "where(label == 7, 1, 0)", 1),
    ],
)
def test_a_formula_at_a_site_is_the_catalogues_effect_there(
    source, catalogue, place, formula, column
):
    """One parameter of each, as the catalogue's own class has it."""
    rig = replace(source.rig, labels={3: "floor", 7: "wall"})
    rng = np.random.default_rng(0)
    columns = {"elapsed_s": np.array([0.0, 99.0, 101.0, 300.0]), "label": np.array([3, 7, 9, 7])}
    columns["normal"] = rng.standard_normal((4, 3))
    view = View(rig, 4, columns, np.zeros((4, 3)))
    mine, theirs = made(site=place, basis=[formula]), effects.find(catalogue)
    assert mine.site is theirs.site and len(mine.params(rig)) == 1
    wanted = theirs.basis(view)
    if isinstance(wanted, OneHot):
        wanted = np.where(wanted.index == column, wanted.values.T, 0.0).T[..., None]
    else:
        wanted = wanted[..., [column]]
    found = np.broadcast_to(mine.basis(view), (4, *wanted.shape[1:]))
    np.testing.assert_allclose(found, np.broadcast_to(wanted, found.shape), atol=1e-15)
    assert found.any()


def test_a_site_that_the_rig_has_no_hardware_for_has_nothing_to_act_on(source):
    bare = replace(source.rig, tracker=None, target=None, lidar=None)
    for place in ("tracker:mount_markers.ty", "target.z", "reference", "noise", "range"):
        assert made(site=place).params(bare) == ()
        assert made(site=place).params(source.rig)


@pytest.mark.parametrize(
    ("place", "words"),
    [
        ("tracker:mount_marker.ty", "did you mean tracker:mount_markers.ty?"),
        ("tracker:mount_markers.y", "did you mean tracker:mount_markers."),
        ("target.zz", "did you mean target.z?"),
        ("referenc", "did you mean reference?"),
    ],
)
def test_a_site_that_is_none_is_refused_with_the_nearest(source, place, words):
    with pytest.raises(InputError, match="there is no site") as refused:
        made(site=place).params(source.rig)
    assert words in str(refused.value)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("place", "unit", "formula", "size"),
    [
        ("tracker:mount_markers.tx", "m", "where(elapsed > 900, 1, 0)", 0.002),
        ("target.x", "m", "1", 0.004),
        ("reference", "m", "where(label == 4, 1, 0)", 0.008),
        ("mount.tz", "m", "(temperature - 22) / 5", 0.002),
    ],
)
def test_a_formula_anywhere_is_simulated_and_found_again(tmp_path, place, unit, formula, size):
    effect = DAMP | {"site": place, "unit": unit, "sigma": size, "basis": [formula]}
    (tmp_path / "mine.yaml").write_text(yaml.safe_dump(effect))
    spec = Spec(lidar="hesai_pandarxt32", locations=4, stops_per_location=3, column_step=200)
    simulate(spec, tmp_path / "rec", 3, {str(tmp_path / "mine.yaml"): 1.0})
    truth = json.loads((tmp_path / "rec.truth.json").read_text())["effects"]["damp"]
    assert abs(truth[0]) == pytest.approx(size)
    chosen = load_effects([*effects.DEFAULT, str(tmp_path / "mine.yaml")])
    run = calibrate([tmp_path / "rec"], tmp_path / "run", Model(chosen), hold_out="none")
    found = run.solution.shared.effects["damp"]
    assert abs(found.estimate[0] - truth[0]) < 4 * found.sigma[0] < 2 * size
