"""Recordings with a range error of a formula's: three rigs, and what a real log holds besides."""

from __future__ import annotations

import json
import shutil
import zlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pandas as pd

from ..worlds import World, write
from ..worlds.knobs import LIDARS
from .formulas_effects import PAIRS, SINGLES, covariates, value
from .formulas_size import Absorbs, rms

RIGS = ("arm", "head", "planes")
SCATTER_M = 0.0003
LOCATIONS, STOPS = 6, 5  # of the arm's rigs; a tracked head, 6 x 4
FOR_PLANES = 4000  # with half as many, some stops of OS0 and XT32 have no flat patch
LEAST_LEFT = 0.3  # of an effect, that rings and motions do not absorb: else it is none to look for


@dataclass(frozen=True)
class Case:
    """One recording.

    Args:
        name: unique.
        formulas: hidden ones; none of a null.
        rig: of `RIGS`.
        number: which LiDAR and which seed.
        times: size of what is hidden, rms over the beams after what the model absorbs, in sigmas of
            a single shot.
        scatter_m: of the stops' own range zeros.
        seed: of all cases.
        beams: of a stop, about; at least `FOR_PLANES` where planes must be found in them.
    """

    name: str
    formulas: tuple[str, ...]
    rig: str
    number: int
    times: float = 0.0
    scatter_m: float = 0.0
    seed: int = 0
    beams: int = 2000

    @property
    def world(self) -> World:
        """Without what is hidden."""
        seed = zlib.crc32(f"{self.seed} {self.rig} {self.number}".encode())
        return World(
            seed=seed,
            lidar=LIDARS[(self.number // len(RIGS)) % len(LIDARS)],
            locations=LOCATIONS,
            stops=4 if self.rig == "head" else STOPS,
            beams=max(self.beams, FOR_PLANES) if self.rig == "planes" else self.beams,
            stop_scatter_m=self.scatter_m,
        )


def cases(
    count: int, nulls: int, rigs: Sequence[str], times: Sequence[float], seed: int
) -> list[Case]:
    """So many hidden ones of each size, a fifth of them two at once; then nulls."""
    pairs = [tuple(SINGLES[i] for i in pair) for pair in PAIRS]
    left, chosen = [(each,) for each in SINGLES], []
    # Spread over the list: a short run has some of all kinds.
    left = [left[i] for i in np.argsort((np.arange(len(left)) * GOLDEN) % 1)]
    while len(chosen) < count and (left or pairs):
        chosen.append((pairs if (pairs and len(chosen) % 5 == 4) or not left else left).pop(0))
    out = []
    for k, formulas in enumerate(chosen):
        fit = [rig for rig in (*rigs[k % len(rigs) :], *rigs) if has_all(rig, formulas)]
        if fit:
            scatter = SCATTER_M * (k // 3 % 2)
            case = Case("", formulas, fit[0], k, scatter_m=scatter, seed=seed)
            out += [replace(case, name=f"{k:02d}x{size:g}", times=size) for size in times]
    for k in range(nulls):
        scatter = SCATTER_M * (k // 3 % 2)
        rig = rigs[k % len(rigs)]
        out.append(Case(f"null{k:03d}", (), rig, 1000 + k, scatter_m=scatter, seed=seed))
    return out


GOLDEN = (np.sqrt(5) - 1) / 2


def has_all(rig: str, formulas: Sequence[str]) -> bool:
    """Whether a rig has all that formulas look at: the arm's joints, or a mesh's labels."""
    names = frozenset().union(*map(covariates, formulas))
    lacks = {"head": "joint_", "planes": "label"}.get(rig)
    return lacks is None or not any(name.startswith(lacks) for name in names)


@dataclass(frozen=True)
class Written:
    """A recording on disk, and what is true of its beams.

    Args:
        folder: of the recording.
        beams: one row per beam: ``stop``, ``ring``, ``column``, and all that formulas look at.
        error_m: (N,) what was added to ranges.
        size_m: its rms after what the model absorbs.
        shot_m: standard deviation of a single shot, rms over the beams.
    """

    folder: Path
    beams: pd.DataFrame
    error_m: np.ndarray
    size_m: float
    shot_m: float


def written(case: Case, folder: Path) -> Written:
    """Write a case's recording; ValueError where the model absorbs what is hidden."""
    truth, recording = folder / "beams", folder / "recording"
    truth.mkdir(parents=True)
    write(case.world, recording, truth)
    stops = _logged(pd.read_csv(recording / "stops.csv"), case.world.rng("log"))
    stops = as_rig(case.rig, recording, stops)
    stops.to_csv(recording / "stops.csv", index=False)
    scans = {name: _scan(recording, truth, name, case.world) for name in stops["stop"]}
    beams = pd.concat(scans.values(), ignore_index=True)
    further = stops.drop(columns="location").select_dtypes("number").columns
    beams = beams.merge(stops[["stop", *further]], on="stop", how="left")
    columns = {name: beams[name].to_numpy() for name in beams}
    shot_m = rms(beams["range_std_m"].to_numpy(float))
    error_m = _scaled(case, columns, Absorbs.of(beams), shot_m) if case.formulas else 0.0
    error_m = np.broadcast_to(error_m, len(beams))
    _lengthen(recording, beams, error_m)
    left_m = rms(Absorbs.of(beams).off(error_m)) if case.formulas else 0.0
    return Written(recording, beams, error_m, size_m=left_m, shot_m=shot_m)


def _scaled(
    case: Case, columns: Mapping[str, np.ndarray], absorbs: Absorbs, shot_m: float
) -> np.ndarray:
    """The errors (N,) m of a case's formulas, together of its size, each of the same share."""
    total = 0.0
    for formula in case.formulas:
        error = value(formula, columns) * np.ones(len(columns["ring"]))
        left = rms(absorbs.off(error))
        if left < LEAST_LEFT * np.std(error):
            raise ValueError(f"{formula}: the model absorbs all but {left / np.std(error):.2f}")
        total = total + error / left
    return total * case.times * shot_m / rms(absorbs.off(total))


def _logged(stops: pd.DataFrame, rng: np.random.Generator) -> pd.DataFrame:
    """Stops with the columns of a log: each goes its own way, none with the time alone."""
    hours = stops["time_s"].to_numpy() / 3600
    count, free = len(stops), rng.uniform(0, 2 * np.pi, 3)
    waves = [
        np.sin(2 * np.pi * hours / t + f) for t, f in zip((0.35, 0.62, 0.48), free, strict=True)
    ]
    steps = rng.standard_normal((3, count))
    stops["temperature_c"] = 26 + 3 * waves[0] + 0.8 * steps[0]
    stops["humidity"] = 0.45 + 0.08 * waves[1] + 0.03 * steps[1]
    # The battery empties, and is changed twice.
    spent = (hours / hours.max() * 2.7 + rng.uniform(0, 1)) % 1
    stops["battery_v"] = 25.2 - 2.6 * spent + 0.08 * steps[2]
    stops["fan_rpm"] = np.round(rng.uniform(2200, 4200, count))
    return stops


def _scan(recording: Path, truth: Path, name: str, world: World) -> pd.DataFrame:
    """Beams of a stop as they are, with one more column that the maker writes: ambient light."""
    file = recording / "scans" / f"{name}.parquet"
    scan, true = pd.read_parquet(file), pd.read_parquet(truth / file.name)
    rng = world.rng(f"ambient {name}")
    x, y, z = (scan[c].to_numpy(float) for c in "xyz")
    flat = np.hypot(x, y)
    # Brighter towards lamps, whose bearing from the LiDAR changes from stop to stop.
    lamp = np.exp(1.5 * np.cos(np.arctan2(y, x) - rng.uniform(-np.pi, np.pi)))
    scan["ambient"] = np.round(60 * lamp * rng.gamma(4, 0.25, len(scan))).astype(np.float32)
    scan.to_parquet(file, index=False)
    extra = true.drop(columns=["ring", "column"])
    extra["azimuth_rad"], extra["elevation_rad"] = np.arctan2(y, x), np.arctan2(z, flat)
    return pd.concat([scan, extra], axis=1).assign(stop=name)


def _lengthen(recording: Path, beams: pd.DataFrame, error_m: np.ndarray) -> None:
    """Add errors to the ranges of all scans."""
    for name, rows in beams.groupby("stop").indices.items():
        file = recording / "scans" / f"{name}.parquet"
        scan = pd.read_parquet(file)
        xyz = scan[["x", "y", "z"]].to_numpy(float)
        longer = 1 + error_m[rows] / np.linalg.norm(xyz, axis=1)
        scan[["x", "y", "z"]] = (xyz * longer[:, None]).astype(np.float32)
        scan.to_parquet(file, index=False)


def as_rig(rig: str, recording: Path, stops: pd.DataFrame) -> pd.DataFrame:
    """Take away what a rig has not: the arm of a tracked head, the mesh of planes only."""
    file = recording / "rig.yaml"
    said = json.loads(file.read_text())
    if rig == "head":
        del said["arm"]
        (recording / "arm.urdf").unlink()
        frames = {name: said["frames"][name] for name in ("mount_markers", "lidar")}
        said["frames"] = {name: frame | {"parent": "base"} for name, frame in frames.items()}
        said["tracker"]["bodies"] = ["mount_markers"]
        seen = stops["mount_markers.x"].notna()
        for name in stops["stop"][~seen]:
            (recording / "scans" / f"{name}.parquet").unlink()
        arm = [c for c in stops if c.startswith(("joint_", "base_markers."))]
        stops = stops[seen].drop(columns=arm).reset_index(drop=True)
    elif rig == "planes":
        del said["reference"], said["target"]
        shutil.rmtree(recording / "reference")
        (recording / "targets.csv").unlink()
    file.write_text(json.dumps(said, indent=1) + "\n")
    return stops
