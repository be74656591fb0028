"""Names with dots, slashes and @ in them: nothing that a name means is read out of it."""

from types import SimpleNamespace

import numpy as np
import pytest

from calib.diagnosis.weak import hardly_known
from calib.forward import named
from calib.planning.purpose import components
from calib.problem.model import Model
from calib.problem.unknowns import Key, Owner, vector_unknown
from calib.report.charts.knowledge import tied
from calib.results.solution import Part, Solution
from calib.runs.run import COVARIANCE, SOLUTION, read_solution
from calib.show.plan import _together, known_rows
from chains.errors import InputError
from sensors.documents import write_yaml

from .exports import none_of

# Each name is the start, or the end, of another.
EFFECTS = {
    "range_cyclic@1": ("cos", "sin"),
    "range_cyclic@1.2": ("cos", "joint_2.tx", "joint_2.tx@0.5"),
    "cyclic@1": ("cos",),
}
KEYS = [Key(named(n, "box"), dof) for n, dofs in EFFECTS.items() for dof in dofs]
UNKNOWNS = {
    named(n, "box"): vector_unknown(
        named(n, "box"),
        np.full(len(dofs), 0.01),
        dofs=dofs,
        units=["m"] * len(dofs),
        owner=Owner(effect=n, rig="box"),
    )
    for n, dofs in EFFECTS.items()
}
STAND = SimpleNamespace(
    estimate=SimpleNamespace(problem=SimpleNamespace(calibration=[*UNKNOWNS], variables=UNKNOWNS))
)


@pytest.mark.parametrize("gone", ["range_cyclic@1", "range_cyclic@1.2"])
def test_a_model_without_an_effect_holds_what_it_held_of_another(gone):
    held = ("range_cyclic@1.cos", "range_cyclic@1.2", "range_cyclic@1.2.joint_2.tx", "lidar.tz")
    of = ("range_cyclic@1", "range_cyclic@1.2", "range_cyclic@1.2", "")
    left = Model(("range_cyclic@1", "range_cyclic@1.2"), held).minus([gone])
    assert left.fixed == tuple(h for h, effect in zip(held, of, strict=True) if effect != gone)


def test_stops_are_planned_for_what_goes_by_a_name_and_nothing_like_it():
    for name in EFFECTS:
        of_it = [key for key in KEYS if key.unknown == f"box/{name}"]
        assert components(STAND, name) == components(STAND, f"box/{name}") == of_it
    for key in KEYS:
        assert components(STAND, key.name) == [key]
    assert components(STAND, "range_cyclic") == components(STAND, "box/range_cyclic@1.tx") == []


def test_one_effect_has_one_owner_however_its_parameters_are_called():
    """Told apart they are by measuring one of them, not by where two effects act differently."""
    both = np.array([1, 2])
    (direction,) = hardly_known([KEYS[i + 2] for i in both], np.full((2, 2), 0.5), np.ones(2))
    names = [f"box/range_cyclic@1.2.{dof}" for dof in ("joint_2.tx", "joint_2.tx@0.5")]
    assert direction["parameters"] == names
    assert direction["needs"].startswith(f"a measurement of {' or '.join(names)} itself")
    other = hardly_known([KEYS[0], KEYS[2]], np.full((2, 2), 0.5), np.ones(2))[0]["needs"]
    assert "box/range_cyclic@1 and box/range_cyclic@1.2 act differently" in other


def test_the_mean_of_a_large_effect_is_of_that_alone_and_of_one_unit():
    units = {"arm@1": "m", "arm@1.2": ", ".join(["m", "rad"] * 8), "arm@1.2.3": "rad"}
    names = tuple(f"joint_{k}.{way}" for k in range(8) for way in ("a", "b"))
    effects = {n: none_of(unit, names) for n, unit in units.items()}
    keys = tuple(Key(n, dof) for n in units for dof in names)
    solution = Solution(
        shared=Part(effects=effects),
        recordings={},
        not_estimated=[],
        keys=keys,
        covariance=np.full((48, 48), 0.9) + 0.1 * np.eye(48),
    )
    mixed = [f"arm@1.2.{dof}" for dof in names]
    assert tied(solution, None)[0] == ["mean of arm@1", *mixed, "mean of arm@1.2.3"]


def test_a_plan_tells_parameters_of_one_unknown_together():
    """Of an effect with many of one unit their rms; else each."""
    many = [Key("arm@1", f"joint_{k}.a") for k in range(12)]
    keys = [*many, Key("arm@1.2", "joint_1.a"), Key("arm@1.2", "joint_2.a@3")]
    sigma = np.arange(1.0, 15.0)
    known = SimpleNamespace(sigma=sigma)
    rows = list(known_rows(SimpleNamespace(keys=keys, units=["m"] * 14, now=known, after=known)))
    assert [row.name for row in rows] == ["arm@1, rms of 12", *(key.name for key in keys[12:])]
    assert rows[0].now == pytest.approx(np.sqrt(np.mean(sigma[:12] ** 2)))
    assert _together(rows) == "arm@1, rms of 12; arm@1.2 joint_1.a, joint_2.a@3"


def test_a_solution_is_read_as_it_was_written(tmp_path):
    own = {n: none_of("m", dofs) for n, dofs in EFFECTS.items()}
    solution = Solution(
        shared=Part(),
        recordings={"box": Part(effects=own)},
        not_estimated=[],
        keys=tuple(KEYS),
        covariance=np.eye(len(KEYS)),
    )
    write_yaml(tmp_path / SOLUTION, solution.document())

    def read(names):
        np.savez(tmp_path / COVARIANCE, names=np.array(names), covariance=np.eye(len(KEYS)))
        return read_solution(tmp_path)

    assert read(solution.names).keys == solution.keys
    with pytest.raises(InputError, match="no solution of this version"):
        read([name.replace("box/", "") for name in solution.names])
