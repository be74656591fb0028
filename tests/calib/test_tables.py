"""What people read: numbers in mm and mrad with their sigma, flags, and nothing too wide."""

import re
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.spatial.transform import RigidTransform

from calib.effects import CATALOGUE
from calib.problem.unknowns import Key
from calib.results.outstanding import outstanding
from calib.results.solution import EffectEstimate, FrameEstimate, Part, Solution
from calib.runs.run import Run
from calib.show import tables
from calib.show.comparison import comparison, print_comparison
from sensors.documents import json_text

from . import rigs

DOF = ("rx", "ry", "rz", "tx", "ty", "tz")
MOVED = np.array([0.0012, -0.0034, 0.0, 0.00123, -0.00456, 0.0])  # rad, m
SIGMA = np.array([0.0004, 0.0005, 0.00004, 0.00045, 0.00012, 0.000021])
WHY = "all that is measured changes alike; measure one of them directly to split it"
SUMMARY = {
    "points": 1234,
    "stops": 4,
    "residual": "range",
    "rms_mm": {"nominal": 24.31, "fit": 3.34, "held_out": 3.47, "noise_floor": 3.62},
    "mean_mm": {"nominal": 8.2, "fit": -0.001, "held_out": 0.02},
    "std_mm": {"nominal": 22.9, "fit": 3.3, "held_out": 3.4},
    "iterations": 9,
    "converged": True,
    "seconds": 5.2,
    "misfit": {"tracker": 1.0, "beams": 0.9},
}


@pytest.fixture(scope="module")
def box(tmp_path_factory):
    return rigs.write(tmp_path_factory.mktemp("tables") / "box")


@pytest.fixture
def run(box, tmp_path):
    """A run of the box rig whose lidar has moved by what `MOVED` says."""
    parent, xyz_m, rpy_rad, *_ = rigs.FRAMES["lidar"]
    T = (rigs.pose(xyz_m, rpy_rad) * RigidTransform.from_exp_coords(MOVED)).as_matrix()
    frames = {
        "lidar": FrameEstimate(parent, T, SIGMA[3:], SIGMA[:3]),
        "faro": FrameEstimate("opti", np.eye(4), SIGMA[3:], SIGMA[:3]),
    }
    rings = tuple(f"ring_{k:03d}" for k in range(16))
    effects = {
        "arm_link_length": EffectEstimate(
            "m", ("turn", "lift"), np.array([0.00211, 0.0]), np.array([0.00098, 0.0])
        ),
        "ring_range_offset": EffectEstimate(
            "m", rings, np.linspace(-0.007, 0.009, 16), np.full(16, 0.00031)
        ),
        "a_scale": EffectEstimate("1", ("s",), np.array([1.234e-5]), np.array([2e-6])),
    }
    keys = tuple(Key(frame, dof) for frame in frames for dof in DOF)
    untold = [
        {"name": "lidar (rx … rz, ty)", "why": f"tied to mount: {WHY}"},
        {"name": "arm_link_length.turn", "why": f"tied to faro.tz: {WHY}"},
        {"name": "opti", "why": "no tracker"},
    ]
    model = {
        "recordings": [{"path": str(box), "rig": "box", "sha256": "0"}],
        "effects": list(effects),
        "fixed": [],
        "prior": None,
    }
    covariance = np.diag(np.tile(np.square(SIGMA), 2))
    solution = Solution(
        shared=Part(frames, effects),
        recordings={},
        not_estimated=untold,
        keys=keys,
        covariance=covariance,
    )
    return Run(tmp_path / "first", model, SUMMARY, solution)


@pytest.fixture
def printed(capsys):
    """Print, and give the lines with runs of blanks squeezed, having checked their form."""

    def lines(function, *args):
        function(*args)
        out = capsys.readouterr().out.splitlines()
        assert max(len(line) for line in out if not line.startswith(("/", "next: "))) <= 80
        assert not any("\x1b" in line for line in out)
        return [re.sub(" +", " ", line).strip() for line in out]

    return lines


def after(lines, start):
    """The lines that follow the one starting so."""
    return lines[next(i for i, line in enumerate(lines) if line.startswith(start)) :]


def test_a_link_is_shown_as_its_move_from_cad_with_sigma_and_flags(run, printed):
    lines = printed(tables.print_run, run)
    at = next(i for i, line in enumerate(lines) if line.startswith("lidar +"))
    assert lines[at] == "lidar +1.23 ± 0.45 -4.56 ± 0.12 +0.000 ± 0.021 mm y"
    assert lines[at + 1] == "on mount +1.20 ± 0.40 -3.40 ± 0.50 +0.000 ± 0.040 mrad x y z"


def test_a_frame_that_no_cad_knows_is_shown_by_its_sigma(run, printed):
    assert "faro ± 0.45 ± 0.12 ± 0.021 mm" in printed(tables.print_run, run)


def test_a_recording_that_is_gone_leaves_the_sigmas(run, printed):
    gone = [{"path": "/nowhere", "rig": "box", "sha256": "0"}]
    lines = printed(tables.print_run, replace(run, model=run.model | {"recordings": gone}))
    assert "lidar ± 0.45 ± 0.12 ± 0.021 mm y" in lines


def test_what_belongs_to_one_rig_carries_its_name(run, printed):
    own = Part({"lidar": run.solution.shared.frames["lidar"]}, {})
    keys = tuple(Key(f"box/{key.unknown}", key.dof) for key in run.solution.keys)
    solution = replace(run.solution, shared=Part(), recordings={"box": own}, keys=keys)
    lines = printed(tables.print_run, replace(run, solution=solution))
    assert any(re.match(r"box/lidar \+1.23 ± 0.45", line) for line in lines)


def test_effects_are_listed_or_summed_up(run, printed):
    lines = printed(tables.print_run, run)
    assert "arm_link_length turn +2.11 ± 0.98 mm confounded" in lines
    assert not any("lift" in line for line in lines)  # held
    assert "a_scale s +1.23e-05 ± 2.0e-06 (no unit)" in lines
    text = " ".join(after(lines, "ring_range_offset"))
    assert "16 values mean +1.00, -7.00 to +9.00, mm" in text and "each ± 0.31" in text


def test_the_errors_before_and_after_stand_together(run, printed):
    lines = printed(tables.print_run, run)
    assert "all as in CAD 24.31 +8.20 22.90" in lines
    assert "after the fit 3.34 +0.00 3.30" in lines
    assert "of stops held out 3.47 +0.02 3.40" in lines
    assert "expected if the model is right 3.62" in lines


def test_an_error_that_was_not_taken_has_no_line(run, printed):
    summary = SUMMARY | {"rms_mm": {"fit": 3.34, "held_out": None, "noise_floor": 3.62}}
    text = "\n".join(printed(tables.print_run, replace(run, summary=summary)))
    assert "of stops held out" not in text and "none held out: 3.34 mm" in text
    assert "as in CAD" not in text


def test_a_fit_that_did_not_converge_says_so(run, printed):
    text = printed(tables.print_run, replace(run, summary=SUMMARY | {"converged": False}))
    assert any("NOT CONVERGED" in line for line in text)


def test_reasons_are_given_once(run, printed):
    text = " ".join(printed(tables.print_run, run, True))
    assert text.count(WHY) == 1
    assert "lidar (rx … rz, ty) tied to mount arm_link_length.turn tied to faro.tz" in text
    assert "not identifiable: no tracker opti" in text
    text = " ".join(printed(tables.print_run, run))
    assert "lidar (rx … rz, ty), arm_link_length.turn" in text and "tied to" not in text
    assert "not identifiable: no tracker opti" in text


def test_what_moved_is_told_from_what_did_not(run, printed):
    def link(name, moved, p_value, parameters=DOF, units=("rad",) * 3 + ("m",) * 3):
        n = len(parameters)
        return {
            "name": name,
            "moved": moved,
            "p_value": p_value,
            "parameters": list(parameters),
            "units": list(units),
            "change": (MOVED if n == 6 else np.full(n, 0.003)).tolist(),
            "sigma": (SIGMA if n == 6 else np.full(n, 1e-4)).tolist(),
        }

    many = [f"ring_{k:03d}" for k in range(16)]
    links = [
        link("lidar", True, 0.0),
        link("ring_range_offset", True, 2e-5, many, ["m"] * 16),
        link("mount", False, 0.41)
        | {"told_from": [2e-4, 2e-4, None, 5e-4, 1.234, 1e-3], "unchecked": ["ty"]},
        *(link("base_markers", False, 0.2), link("arm_base", False, None)),  # of an older run
    ]
    lines = printed(tables.print_run, replace(run, summary=SUMMARY | {"links": links}))
    text = " ".join(lines)
    assert "tx +1.23 ± 0.45, ty -4.56 ± 0.12, tz +0.000 ± 0.021 mm; rx +1.20 ± 0.40" in text
    assert "mrad; p < 1e-06" in text
    assert "16 values by 3.00 rms mm; p = 2e-05" in text
    seen = "seen from 0.5 mm (at worst 1200) and 0.2 mrad; never in rz; hardly checked: ty"
    assert f"not moved mount p = 0.41; {seen} base_markers p = 0.2" in text
    assert "lidar moved -4.56 ± 0.12 mm in y and turned -3.40 ± 0.50 mrad about y; ring" in text
    assert "changed by 3.00 mm rms; nothing else moved; the new data do not determine" in text
    assert "arm_base; a move as large as CAD's sigma would not be seen in mount (ty)." in text
    none = " ".join(printed(tables.print_run, replace(run, summary=SUMMARY | {"links": []})))
    assert "nothing moved significantly." in none


def test_comparison_has_an_entry_per_run(run, tmp_path):
    bare = replace(run.solution, shared=Part(run.solution.shared.frames, {}))
    compared = comparison([run, replace(run, folder=tmp_path / "second", solution=bare)])
    assert compared["runs"] == [str(tmp_path / "first"), str(tmp_path / "second")]
    assert compared["rms_mm"]["fit"] == [3.34, 3.34]
    lidar = [compared["parameters"]["lidar"][dof] for dof in DOF]
    np.testing.assert_allclose(
        [e["estimate"] for e in lidar], np.tile(MOVED[:, None], 2), atol=1e-12
    )
    np.testing.assert_allclose([e["sigma"] for e in lidar], np.tile(SIGMA[:, None], 2), rtol=1e-12)
    turn = compared["parameters"]["arm_link_length"]["turn"]
    assert turn == {"unit": "m", "estimate": [0.00211, None], "sigma": [0.00098, None]}
    assert '"faro"' in json_text(compared)


def test_comparison_is_printed_side_by_side(run, tmp_path, printed):
    bare = replace(run.solution, shared=Part(run.solution.shared.frames, {}))
    summary = SUMMARY | {"rms_mm": {"fit": 9.9}}
    other = replace(run, folder=tmp_path / "second", solution=bare, summary=summary)
    lines = printed(print_comparison, [run, other])
    assert "first second" in lines
    assert "rms after the fit mm 3.34 9.90" in lines
    assert "rms all as in CAD mm 24.31" in lines
    assert "lidar.tx mm +1.23 ± 0.45 +1.23 ± 0.45" in lines
    assert "arm_link_length.turn mm +2.11 ± 0.98" in lines
    assert "ring_range_offset, mean mm +1" in lines


def test_parameters_of_several_units_are_shown_each_in_its_own(run, printed):
    slip = EffectEstimate("rad, m", ("r", "t"), np.array([0.001, 0.002]), np.array([0.0005] * 2))
    names = tuple(f"p{k}" for k in range(14))
    units = ", ".join(["rad"] * 10 + ["m"] * 4)
    many = EffectEstimate(units, names, np.repeat([0.003, 0.005], [10, 4]), np.full(14, 0.0004))
    effects = {"slip": slip, "many": many}
    told = replace(run.solution, shared=Part({}, effects), not_estimated=[])
    run = replace(run, solution=told)
    lines = printed(tables.print_run, run)
    assert "slip r +1.00 ± 0.50 mrad" in lines and "t +2.00 ± 0.50 mm" in lines
    assert "many 10 values mean +3.00, +3.00 to +3.00, each ± 0.4 mrad" in lines
    assert "4 values mean +5.00, +5.00 to +5.00, each ± 0.4 mm" in lines
    lines = printed(print_comparison, [run])
    assert "slip.r mrad +1.00 ± 0.50" in lines and "slip.t mm +2.00 ± 0.50" in lines
    assert "many, mean mrad +3" in lines and "many, mean mm +5" in lines


def test_the_ladder_is_printed_below_the_comparison(run, printed):
    model = run.model | {"effects": ["ring_range_offset", {"name": "lean"}]}
    below = replace(run, folder=run.folder.with_name("00"), model=model)
    rms = {"fit": 2.22, "held_out": 2.31, "noise_floor": 2.2}
    grown = model | {"effects": ["ring_range_offset", "mount_slip@150", "arm_backlash"]}
    above = replace(
        run,
        folder=run.folder.with_name("01"),
        model=grown | {"grown_from": str(below.folder)},
        summary=SUMMARY | {"rms_mm": rms},
    )
    lines = after(printed(print_comparison, [above, below]), "ladder")
    assert lines[1] == "00 start 3.47 3.34 3.62"
    assert lines[2] == "01 + mount_slip@150, + arm_backlash, - 3.47 -> 2.31 2.22 2.20"
    assert lines[3] == "lean"
    unheld = replace(below, summary=SUMMARY | {"rms_mm": rms | {"held_out": None}})
    lines = after(printed(print_comparison, [unheld, above]), "ladder")
    assert lines[1] == "00 start 2.22 2.20"
    alone = printed(print_comparison, [below])
    assert not any(line.startswith("ladder") for line in alone)
    lines = after(printed(print_comparison, [above]), "ladder")
    assert lines[1].startswith("01 grew from 00, which is gone 2.31")


def test_what_was_left_out_stands_in_the_comparison_and_on_the_ladder(run, printed):
    tokens = [f"s{k}:base" for k in range(6)]
    first = replace(run, model=run.model | {"without": tokens[:1]})
    summary = SUMMARY | {"set_aside": {"s9:scan": "0/9"}}
    model = run.model | {"without": tokens, "grown_from": str(run.folder)}
    second = replace(run, folder=run.folder.with_name("01"), model=model, summary=summary)
    compared = comparison([first, second])
    assert compared["left_out"] == [tokens[:1], tokens]
    assert compared["set_aside"] == [[], ["s9:scan"]]
    lines = printed(print_comparison, [first, second])
    at = lines.index("left out s0:base s0:base")
    assert lines[at + 1 : at + 5] == [*tokens[1:4], "and 2 more"]
    assert lines[at + 5] == "set aside s9:scan"
    assert any(line.startswith("first start, without s0:base") for line in lines)
    text = " ".join(lines)
    assert "without s1:base, s2:base, s3:base" in text and "and 2 more" in text
    lines = printed(print_comparison, [replace(run, model=run.model)])
    assert not any("left out" in line or "set aside" in line for line in lines)


def test_many_runs_are_broken_into_tables(run, printed):
    runs = [replace(run, folder=run.folder.with_name(f"run{i}")) for i in range(7)]
    lines = printed(print_comparison, runs)
    heads = [line for line in lines if re.fullmatch(r"(run\d ?)+", line)]
    assert " ".join(heads).split() == [f"run{i}" for i in range(7)]


def test_the_catalogue_is_printed(printed):
    text = " ".join(printed(tables.print_catalogue, CATALOGUE, False))
    assert all(effect.name in text for effect in CATALOGUE)


@pytest.mark.parametrize("effect", CATALOGUE, ids=lambda e: e.name)
def test_an_effect_has_its_page(effect, printed):
    page = tables.effect_page(effect)
    assert page["name"] == effect.name
    assert page["site"] == effect.site.value
    for key in ("what", "formula", "typical", "source"):
        assert page[key], f"{effect.name} does not say its {key}"
    text = " ".join(printed(tables.print_catalogue, [effect], True))
    assert effect.formula in text
    assert all(name in text for name in effect.confounded_with)


def test_a_check_is_printed(printed):
    check = SimpleNamespace(
        contents=[("stops", "12 at 4 locations")],
        problems=["stops.csv:3: no such thing [red]"],
        odd=["joint_1 hardly moves"],
        command="",
        can=["lidar: 0.6 mm"],
        cannot=[{"name": "mount.tz", "why": f"tied to lidar.tz: {WHY}"}],
    )
    text = " ".join(printed(tables.print_check, check, True))
    assert "stops 12 at 4 locations" in text
    assert "stops.csv:3: no such thing [red]" in text
    assert "joint_1 hardly moves" in text
    assert "lidar: 0.6 mm" in text
    assert "mount.tz tied to lidar.tz" in text


def test_what_does_not_fit_is_told_the_worst_first(run, printed):
    move = {"move_sigmas": 100.2, "worst": "tz", "change": -0.133, "sigma": 0.001, "unit": "m"}
    stops = {f"s{k}": {"bodies": {"base": 3.1 + k}, "joints": None, "beams": 1.0} for k in range(8)}
    stops |= {f"t{k}": {"bodies": {"base": 1.0}} for k in range(9)}
    found = {"stop": stops, "body": {"base": 1.1}, "target": {"t": 2.9}, "prior": {"lidar": move}}
    spoilt = replace(run, summary=run.summary | {"misfit_by": found})
    text = " ".join(printed(tables.print_run, spoilt))
    assert text.index("s7, base: residuals 10.1 times larger") < text.index("s6, base")
    assert "s2, base" in text and "and 2 more" in text and "s1, base" not in text
    assert "t0, base" not in text
    assert "target" not in text.partition("what does not fit")[2].partition("not identifi")[0]
    assert "lidar.tz: -133 mm from CAD, 100 of its sigmas" in text
    compared = " ".join(printed(print_comparison, [run, spoilt]))
    assert all(t in compared for t in ("s7, base 10.1", "sigma, 2.90", "sigmas, 100.20"))
    assert "what does not fit" not in " ".join(printed(tables.print_run, run))


def test_what_all_stops_have_stands_out_at_none():
    def summary(*ratios):
        stops = {f"s{k}": {"bodies": {"tool": x}} for k, x in enumerate(ratios)}
        return {"misfit_by": {"stop": stops, "body": {}, "target": {"a": 1.0}, "prior": {}}}

    assert list(outstanding(summary(8.0, 9.0, 24.0, 10.0))) == []
    assert list(outstanding(summary(24.0, 25.0, 4000.0, 27.0))) == ["s2, tool"]
    assert list(outstanding(summary(1.0, 0.2, 3.1, 0.9))) == ["s2, tool"]


def test_an_error_says_of_how_many_beams_it_speaks(run, printed):
    rms = {"nominal": 20.0, "fit": 2.7, "held_out": 2.9, "noise_floor": 2.8}
    told = {"rms_all_mm": 8.6, "rejected_share": 0.116, "residual": "range", "rms_mm": rms}
    told |= {"held_out_rms_all_mm": 8.8, "held_out_rejected_share": 0.12}
    text = " ".join(printed(tables.print_run, replace(run, summary=run.summary | told)))
    assert "after the fit: 2.70 mm over 88.4 % of the beams; 8.60 mm over all" in text
    assert "of stops held out: 2.90 mm over 88.0 % of the beams; 8.80 mm over all" in text
    alone = replace(run, summary=run.summary | told | {"residual": "tracked position"})
    assert "of the beams" not in " ".join(printed(tables.print_run, alone))


def test_a_misfit_is_said_and_named(run, capsys):
    """Sigmas that residuals do not bear out are widened, and the reader is told why."""
    tables.print_run(run)
    assert "larger than their sigmas" not in capsys.readouterr().out
    misfit = {"misfit": {"beams": 0.9, "tracker": 4.4}, "sigmas_widened_by": 4.4}
    tables.print_run(replace(run, summary=run.summary | misfit))
    assert "residuals of tracker are 4.4 times larger than their sigmas" in capsys.readouterr().out


def test_cad_that_is_not_as_good_as_it_says_is_told(run, capsys):
    misfit = {"misfit": {"beams": 0.9, "cad": 2.2}, "cad_widened_by": 2.2}
    tables.print_run(replace(run, summary=run.summary | misfit))
    told = " ".join(capsys.readouterr().out.split())
    assert "frames are 2.2 times further from CAD than its sigmas allow: a value of CAD is" in told
    assert "larger than their sigmas" not in told
    misfit = {"misfit": {"beams": 0.9, "cad": 1.4}, "cad_widened_by": 1.4}  # as chance may have it
    tables.print_run(replace(run, summary=run.summary | misfit))
    assert "further from CAD" not in " ".join(capsys.readouterr().out.split())


def test_rows_that_err_together_are_told(run, capsys):
    wider = {"median": 1.87, "most": 2.4, "parameter": "ring_range_offset.ring_045"}
    tables.print_run(replace(run, summary=run.summary | {"intervals_wider_by": wider}))
    told = " ".join(capsys.readouterr().out.split())
    assert "sigmas are 1.9 times what single rows would give (median; 2.4 for ring_range" in told
    wider["median"] = 1.1
    tables.print_run(replace(run, summary=run.summary | {"intervals_wider_by": wider}))
    assert "single rows" not in capsys.readouterr().out
