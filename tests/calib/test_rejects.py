"""What a fit throws away: a structured error is found there, and clutter is told from one."""

import json
import re
import shutil

import numpy as np
import pytest

from calib.diagnosis.rejects import _p_values, _View, rejects
from calib.diagnosis.rejects.counts import CellAxis
from calib.diagnosis.rejects.found import Place, Rejects
from calib.runs.calibrate import calibrate
from calib.runs.diagnose import diagnose
from calib.runs.reopen import stand_of
from calib.simulation import Spec, simulate

from .rescans import Change, change_ranges, sector

SMALL = Spec(lidar="hesai_pandarxt32", locations=4, stops_per_location=3, column_step=40)


def quiet(what, done, total):
    pass


@pytest.fixture(scope="module")
def studied(tmp_path_factory):
    """A function: the rejects, and the run, of a recording whose ranges were changed."""
    folder = tmp_path_factory.mktemp("rejects")
    simulate(SMALL, folder / "rec", 1)

    def study(name: str, change: Change | None = None):
        copy = shutil.copytree(folder / "rec", folder / name)
        if change:
            change_ranges(copy, change)
        run = calibrate([copy], folder / f"{name}-run", hold_out="none")
        return rejects(stand_of(run, quiet), quiet), run

    return study


def person(stop, range_m, azimuth, elevation):
    """Somebody 0.5 m wide stands 1.5 m from the LiDAR, at two of the stops."""
    there = (np.abs(azimuth - stop / 2) < 0.17) & (np.abs(elevation) < 0.4) & (range_m > 1.5)
    rough = 1.5 + 0.05 * np.sin(50 * elevation)
    return np.where(there & (stop in (2, 5)), rough, range_m)


def carried(stop, range_m, azimuth, elevation):
    """A part of the rig stands 0.6 m from the LiDAR, in its view at every stop."""
    there = (azimuth > 1.0) & (azimuth < 1.3) & (range_m > 0.6)
    return np.where(there, 0.6 + 0.05 * np.sin(50 * elevation), range_m)


@pytest.mark.long
def test_nothing_is_found_where_only_mixed_pixels_are_thrown_away(studied):
    found, run = studied("null")
    assert found.explained and not found.structured
    assert 0.001 < found.share < 0.01 and found.expected == pytest.approx(found.share)
    assert diagnose(run).rejected.document() == found.document()


@pytest.mark.parametrize(
    ("first", "last", "by_m"), [(0.3, 1.0, 0.025), (-0.9, -0.4, -0.01), (2.9, -2.8, 0.1)]
)
def test_a_sector_is_found_with_its_azimuths_and_its_size(studied, first, last, by_m):
    found, _ = studied(f"sector{first}", sector(first, last, by_m))
    (place,) = found.structured
    assert place.covariate == "azimuth_rad" and found.p_adjusted < 0.01
    step = np.radians(360 / 2000 * SMALL.column_step) + np.radians(1.5)
    assert abs((place.lower - first + np.pi) % (2 * np.pi) - np.pi) < step
    assert abs((place.upper - last + np.pi) % (2 * np.pi) - np.pi) < step
    assert place.residual_m == pytest.approx(by_m, abs=1e-3)
    width = (last - first) % (2 * np.pi) / (2 * np.pi)
    assert place.rejected == pytest.approx(width, rel=0.3)
    assert found.expected < 0.01 < found.share
    assert ("short" if by_m < 0 else "long") in found.sentence


@pytest.mark.long
def test_a_sector_is_no_adequate_model_and_its_formula_takes_it_up(studied, tmp_path):
    from calib.runs.add import add
    from sensors.documents import write_yaml

    _, run = studied("added", sector(0.3, 1.0, 0.025))
    diagnosis = diagnose(run)
    assert diagnosis.verdict == "unexplained_structure"
    (size,) = re.findall(r"^Its formula: range = true \+ ([\d.]+)", diagnosis.sentences[1])
    assert float(size) == pytest.approx(25.0, abs=0.1)
    told = next(each for each in diagnosis.sentences if "rejected; of the beams" in each)
    assert "azimuth 21 to 51 deg" in told and "25.0 ±" in told
    document = json.loads((run.folder / "diagnosis.json").read_text())
    assert document["rejected"]["covariates"] == ["azimuth_rad"]
    assert document["rejected"]["p_adjusted"] >= 1e-6
    formula = document["unexplained"][0]["formula"]
    write_yaml(tmp_path / "mine.yaml", formula)
    grown = add(run, [str(tmp_path / "mine.yaml")], tmp_path / "grown")
    assert grown.solution.document()["effects"][formula["name"]]["estimate"] == pytest.approx(
        [0.025], abs=1e-3
    )
    left = rejects(stand_of(grown, quiet), quiet)
    assert left.explained and left.share < 0.02


@pytest.mark.long
@pytest.mark.parametrize("by_m", [-0.016, 0.025])
def test_a_step_whose_beams_were_rejected_has_its_name(tmp_path, by_m):
    """Of the beams beyond it 98 % have no weight, and no test of `range_step` is left; a formula is
    found, and does what the effect of the catalogue does."""
    simulate(SMALL.model_copy(update={"column_step": 80}), tmp_path / "rec", 1)
    change_ranges(tmp_path / "rec", lambda _, range_m, *__: range_m + by_m * (range_m > 4.4))
    found = diagnose(calibrate([tmp_path / "rec"], tmp_path / "run"))
    assert found.verdict == "missing_effect" and not found.formulas
    (name,) = found.worth_adding
    family, shape = name.split("@")
    assert family == "range_step" and float(shape) == pytest.approx(4.4, abs=0.02)
    first = found.candidates[0]
    (amount,), (sigma,) = (first["parameters"][key] for key in ("estimate", "sigma"))
    assert abs(amount - by_m) < 3 * max(sigma, 1e-4)
    before, after = (first["rejected_share"][key] for key in ("before", "after"))
    assert after < 0.015 < before - 0.03
    assert 2.0 < first["rms_mm"] < 1e3 * abs(by_m)


def test_somebody_in_the_room_is_no_error_of_the_lidar(studied):
    found, _ = studied("person", person)
    assert found.explained and not found.structured
    assert len(found.clutter_stops) == 2 and found.clutter > 0.001
    assert "not in the mesh" in found.sentence


def test_what_is_carried_along_is_no_error_of_the_lidar(studied):
    found, _ = studied("carried", carried)
    assert found.explained
    assert found.places[0].covariate == "azimuth_rad" and found.places[0].in_the_way
    assert "nearer than the mesh" in found.sentence


def test_many_beams_off_by_one_size_are_no_mixed_pixels_wherever_they_are(studied):
    def glitch(stop, range_m, azimuth, elevation):
        return range_m + 0.03 * (np.random.default_rng(stop).random(len(range_m)) < 0.1)

    found, _ = studied("glitch", glitch)
    assert not found.explained and found.beyond_m == pytest.approx(0.03, abs=1e-3)


@pytest.mark.parametrize(("share", "explained"), [(0.03, True), (0.07, False)])
@pytest.mark.long
def test_returns_from_anywhere_are_told_where_they_are_many(studied, share, explained):
    """Though near walls read long and far ones short, which no range explains."""

    def spurious(stop, range_m, azimuth, elevation):
        rng = np.random.default_rng(stop)
        anything = rng.uniform(0.5, 8.0, len(range_m))
        return np.where(rng.random(len(range_m)) < share, anything, range_m)

    found, run = studied(f"spurious{share}", spurious)
    assert found.explained == explained and found.share == pytest.approx(share, rel=0.2)
    assert "of the beams at" not in found.sentence, "it is the same everywhere"
    assert ("mixed pixels may explain" in found.sentence) != explained
    if not explained:
        assert diagnose(run).verdict == "unexplained_structure"


@pytest.mark.parametrize(
    ("share", "coherent", "short", "sigma_m", "said"),
    [
        (0.98, True, 0.0, 5.1e-4, "where it was scanned: its beams read 12.5 ± 0.51 mm long"),
        (0.98, True, 0.0, np.nan, "where it was scanned: its beams read 12.5 mm long"),
        (0.98, False, 0.4, 5.1e-4, "but at all distances, as they do at glass or a mirror"),
        (0.98, False, 0.95, 5.1e-4, None),  # something stands in the way
        (0.065, True, 0.0, 5.1e-4, ""),  # of a wall that stands where it was few are rejected
    ],
)
def test_a_part_of_the_mesh_is_wrong_where_most_of_its_beams_are(
    share, coherent, short, sigma_m, said, monkeypatch
):
    monkeypatch.setattr("calib.blunders.told._at_m", lambda group, sources: None)
    place = Place(
        covariate="surface",
        lower=5.0,
        upper=5.0,
        names=("5",),
        p_adjusted=1e-4,
        share=share,
        rejected=0.5 * share,
        beams=0.5,
        residual_m=0.0125,
        sigma_m=sigma_m,
        coherent=coherent,
        short=short,
    )
    found = Rejects(
        share=0.02,
        expected=0.01,
        p_adjusted=1e-4,
        places=[place],
        meshed=True,
        clutter=0.0,
        clutter_stops=(),
        beyond=False,
        beyond_m=None,
    )
    assert found.explained == (said is None)
    blunders, left = found.blunders([]), found.unexplained()
    assert len(blunders) == bool(said) and len(left) == (said == "")
    for each in blunders:
        assert said in each["sentence"] and each["without"] == "mesh:surface_5"
        assert all((each[key] is None) == (not coherent) for key in ("size", "sigma", "axis"))


def test_too_few_stops_or_no_scans_claim_nothing(tmp_path):
    simulate(Spec(lidar=None, mesh=False, targets=0, stops_per_location=8), tmp_path / "rec", 1)
    run = calibrate([tmp_path / "rec"], tmp_path / "run", hold_out="none")
    assert rejects(stand_of(run, quiet), quiet) is None


def test_p_values_hold_their_level_where_beams_of_one_place_err_together():
    """Shares that scatter from stop to stop and from place to place, and hang on nothing else."""
    rng, stops, places, bins = np.random.default_rng(0), 20, 40, 12
    small = []
    for _ in range(200):
        n = rng.poisson(30, (stops, places, bins))
        rate = 0.02 * rng.gamma(1.0, 1.0, (stops, 1, 1)) * rng.gamma(0.5, 2.0, (1, places, 1))
        k = rng.binomial(n, np.minimum(rate, 1.0))
        stop, place, at = (np.repeat(i.ravel(), k.ravel()) for i in np.indices(k.shape))
        ways = (
            (stop, n.sum(axis=1), n.sum(axis=(1, 2))),
            (place, n.sum(axis=0), n.sum(axis=(0, 2))),
        )
        axis = CellAxis.of("ring", np.arange(bins))
        view = _View(axis=axis, rows=n.sum(axis=(0, 1)), bin=at, cell=at, ways=ways)
        small.append(_p_values(view, np.ones(len(at), bool)))
    assert (np.array(small) < 0.05).mean() < 0.05
    assert (np.array(small) < 0.001).mean() < 0.001


def boxes(stop, range_m, azimuth, elevation):
    """Boxes that the mesh lacks, 0.4 rad wide and 0.15 rad high, stand before 14 % of the walls."""
    cell = np.floor(azimuth / 0.4).astype(int), np.floor(elevation / 0.15).astype(int)
    inside = np.random.default_rng(stop).random((40, 40))[cell] < 0.14
    return np.where(inside, range_m * (0.4 + 0.2 * np.abs(np.sin(7.0 * azimuth + stop))), range_m)


def short(stop, range_m, azimuth, elevation):
    """Of all beams 9 % read 5 % short, each by itself."""
    alone = np.random.default_rng(stop).random(len(range_m)) < 0.09
    return np.where(alone, 0.95 * range_m, range_m)


def test_things_everywhere_that_the_mesh_lacks_are_clutter(studied, monkeypatch):
    """They are wider than a beam, which errors of single beams are not."""
    found, run = studied("boxes", boxes)
    assert found.explained and found.share > 0.1 and found.clutter > 0.08

    def nowhere(counts, rejected):
        return np.zeros(counts.met.shape, bool)

    monkeypatch.setattr("calib.diagnosis.rejects._crowded", nowhere)  # as where beams are few
    found = rejects(stand_of(run, quiet), quiet)
    assert found.explained and found.clutter == pytest.approx(found.share)
    assert len(found.clutter_stops) == 12
    assert "hit something that is not in the mesh" in found.sentence


def test_single_beams_that_read_short_everywhere_are_no_clutter(studied):
    found, _ = studied("short", short)
    assert found.beyond and not found.explained
