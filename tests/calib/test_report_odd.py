"""Reports of rigs that lack something, and of several recordings at once."""

import re
from pathlib import Path

import pytest

from calib.problem.model import Model
from calib.report import plot, report
from calib.report.evidence import Evidence
from calib.runs.calibrate import calibrate
from calib.simulation import Spec, simulate

HUMID = '{name: humid_air, site: range, unit: "1", sigma: 0.01, basis: ["humidity * range"]}'


def odd(folder: Path, name: str) -> tuple[list[Path], Model]:
    """Recordings of rigs that lack something, and what to fit to them."""
    lean = {"locations": 2, "stops_per_location": 2, "column_step": 200, "room": "box"}
    xt32 = {"lidar": "hesai_pandarxt32", **lean}
    model = Model()
    if name == "arm and tracker":
        specs = [Spec(lidar=None, mesh=False, targets=0, tracker="points", stops_per_location=6)]
        model = Model(("arm_link_length", "arm_joint_offset", "arm_axis_tilt"))
    elif name == "no arm":
        specs = [Spec(**xt32, arm=False, occluded_share=0)]
    elif name == "no tracker":
        specs = [Spec(**xt32, tracker=None, targets=0, base_moves="location")]
    elif name == "planes":
        finer = lean | {"stops_per_location": 3, "column_step": 24}
        specs = [Spec(**finer, mesh=False, targets=0)]
    else:
        lean |= {"stops_per_location": 3, "world_seed": 3}
        specs = [Spec(lidar=lidar, **lean) for lidar in ("hesai_pandarxt32", "velodyne_vlp16")]
        (folder / "mine.yaml").write_text(HUMID)
        model = Model.of(f"ring_range_offset,{folder / 'mine.yaml'}", [])
    for i, spec in enumerate(specs):
        simulate(spec, folder / f"rec{i}", seed=i)
    return [folder / f"rec{i}" for i in range(len(specs))], model


@pytest.mark.long
@pytest.mark.parametrize(
    ("name", "has", "lacks"),
    [
        (
            "arm and tracker",
            {"tracker", "chain", "budget"},
            {"map", "variance", "rings", "targets"},
        ),
        ("no arm", {"map", "rings", "tracker", "targets"}, {"effects"}),
        ("no tracker", {"map", "chain"}, {"tracker", "targets"}),
        ("planes", {"map", "residual-incidence"}, {"targets", "residual-label"}),
        ("two recordings", {"chain-1", "chain-2", "rings-2", "residual-recording"}, set()),
    ],
)
def test_odd_rigs_have_a_page(tmp_path, name, has, lacks):
    recordings, model = odd(tmp_path, name)
    run = calibrate(recordings, tmp_path / "run", model, hold_out="none")
    written = report([run], tmp_path / "page.html")
    assert written.verdict.light in ("amber", "red")
    assert has <= {chart.id for chart in written.contents.charts}
    assert lacks <= {absent.id for absent in written.contents.absent}
    text = (tmp_path / "page.html").read_text(encoding="utf-8")
    assert "nan" not in re.findall(r">([^<]*\bnan\b[^<]*)<", text)
    assert all(f"<code>{absent.id}</code>" in text for absent in written.contents.absent)


def test_a_ladder_without_any_error_has_a_page(tmp_path):
    """One body that a tracker sees is where it was seen, and no axis by powers begins at 0."""
    spec = Spec(lidar=None, mesh=False, targets=0, arm=False, locations=2, stops_per_location=2)
    simulate(spec, tmp_path / "rec", seed=2)
    run = calibrate(tmp_path / "rec", tmp_path / "run")
    assert run.summary["rms_mm"]["fit"] < 1e-9 < run.summary["rms_mm"]["noise_floor"]
    chart = plot(Evidence.of([run]), "ladder", tmp_path / "ladder.svg")
    assert chart.id == "ladder" and (tmp_path / "ladder.svg").stat().st_size > 1000
    assert "ladder" in {each.id for each in report([run], tmp_path / "page.html").contents.charts}
