"""Where nothing is hidden, is nothing found? Nulls of many kinds by a simulator of their own.

    python -m tests.bench.chance [--families plain,tracker] [--count 4] [--jobs 2]
                                 [-o FILE --resume]

Every case is a recording of `tests.worlds`, which shares no code with the program, fitted and
diagnosed as a user would. Nothing is missing from the model in any of them, yet the families are
worse than the plain one by chance: stops scatter, the tracker, the joints, targets or the mesh are
worse than on paper, stops or sweeps are few, things stand in the room that were not scanned. FILE
gets a line of JSON per case as it is done; with ``--resume`` those that it holds are not run again.
"""

from __future__ import annotations

import argparse
import json
import tempfile
import traceback
import zlib
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from rich.progress import track
from threadpoolctl import threadpool_limits

from calib.diagnosis.verdict import worth_adding
from sensors.documents import plain

from ..mishaps.judge import Said, blunders, names, off, read_truth, rigcal
from ..worlds import World, write
from ..worlds.knobs import LIDARS
from .blunders import read
from .chance_table import show

LIMIT_S = 120  # CPU, of a command; a fit takes 3 s, a diagnosis 5 s
WARP_M = 0.005  # ten times what the mesh's error is on paper
FAMILIES: dict[str, dict[str, Any]] = {
    "plain": {},
    "scatter-0.3": {"stop_scatter_m": 0.0003},
    "scatter-1": {"stop_scatter_m": 0.001},
    "scatter-3": {"stop_scatter_m": 0.003},
    "tracker": {"tracker_factor": 2.0},
    "joints": {"joint_factor": 3.0},
    "spheres": {"sphere_factor": 4.0},
    "mount": {"mount_shift_m": 0.001, "mount_turn_rad": 0.001},
    "mesh": {"mesh_error_factor": 3.0},
    "warped": {"warp_m": WARP_M},
    "stops-6": {"locations": 3, "stops": 2},
    "stops-8": {"locations": 4, "stops": 2},
    "stops-12": {"locations": 4, "stops": 3},
    "location": {"locations": 1, "stops": 30},
    "sweep": {"sweeps": 1},
    "clutter": {"clutter": 0.1},
}
KINDS = {
    "arm_link_length": "links",
    "arm_joint_offset": "zeros",
    "ring_range_offset": "rings",
    "faro": "alignment",
}


@dataclass(frozen=True)
class Case:
    """One world of a family."""

    family: str
    number: int

    @property
    def name(self) -> str:
        """Unique."""
        return f"{self.family}/{self.number:03d}"

    @property
    def world(self) -> World:
        """With one of the LiDARs after another, and a seed of its own."""
        seed, lidar = zlib.crc32(self.name.encode()), LIDARS[self.number % len(LIDARS)]
        return World(seed=seed, lidar=lidar, **FAMILIES[self.family])


def cases(families: Sequence[str], count: int) -> list[Case]:
    """So many of each family, in turn: what is cut short has some of all."""
    return [Case(family, number) for number in range(count) for family in families]


def run(case: Case) -> dict[str, Any]:
    """What the program says of a case, and how far its estimates are from the truth."""
    with threadpool_limits(1), tempfile.TemporaryDirectory() as folder:
        recording, fitted = Path(folder) / "recording", Path(folder) / "run"
        write(case.world, recording)
        fit = rigcal("fit", recording, "-o", fitted, limit_s=LIMIT_S)
        found = {"fit": fit}
        if fit.code in (0, 3) and fit.document:
            found["diagnose"] = rigcal("diagnose", fitted, limit_s=LIMIT_S)
        truth = read_truth(Path(f"{recording}.truth.json"))
        solved = (fitted / "solution.yaml").is_file()
        result = said(**found) | (errors(fitted, truth) if solved else {"z": {}, "z_untold": {}})
        document = found["diagnose"].document if "diagnose" in found else {}
        added = worth_adding(document.get("candidates", []))
        result |= {"added": added, "z_added": result["z"]}
        if added:
            grown = Path(folder) / "grown"
            last = rigcal("add", fitted, ",".join(added), "-o", grown, limit_s=LIMIT_S)
            result["z_added"] = errors(grown, truth)["z"] if last.code == 0 else {}
    about = {"case": case.name, "family": case.family, "lidar": case.world.lidar}
    return plain(about | result)


def said(fit: Said, diagnose: Said | None = None) -> dict[str, Any]:
    """Verdict and names of a diagnosis, or why there is none.

    Returns:
        `outcome`: the verdict, "too few stops", "not converged", "refused", "endless" or "fault";
        `names` of effects, covariates and scatter; `blunders`; `p`, by effect; `misfit`,
        `rms_mm`; `seconds`.
    """
    last = diagnose or fit
    document = diagnose.document if diagnose else {}
    outcome = document.get("verdict", "fault")
    if document.get("too_few_stops"):
        outcome = "too few stops"
    if fit.code == 3 or (fit.document and not fit.document["converged"]):
        outcome = "not converged"
    if last.code is None:
        outcome = "endless"
    elif last.refused:
        outcome = "refused"
    scatter = [each["effect"] for each in document.get("scatter", [])]
    return {
        "outcome": outcome,
        "names": list(dict.fromkeys([*names(document), *scatter])),
        "blunders": [first for first, *_ in blunders(document)],
        "p": {c["effect"]: c["p_value"] for c in document.get("candidates", [])},
        "p_adjusted": {c["effect"]: c["p_adjusted"] for c in document.get("candidates", [])},
        "unexplained": [
            [u["covariates"], u["rms_mm"], u["p_value"]] for u in document.get("unexplained", [])
        ],
        "sentences": document.get("sentences", [last.complaint.strip()])[:3],
        "misfit": fit.document.get("misfit", {}),
        "rms_mm": fit.document.get("rms_mm", {}),
        "seconds": [round(each.seconds, 2) for each in (fit, diagnose) if each],
    }


def errors(fitted: Path, truth: Mapping[str, Any]) -> dict[str, Any]:
    """Distances from the truth in sigmas, by kind: of what the data tell, and of the rest."""
    told: dict[str, list[float]] = {}
    untold: dict[str, list[float]] = {}
    for name, error in off(fitted, truth).items():
        kind = KINDS.get(name.partition(".")[0], "frames")
        (told if error.told else untold).setdefault(kind, []).append(round(error.sigmas, 3))
    return {"z": told, "z_untold": untold}


def main() -> None:
    """Run what is asked for, and print the table."""
    wanted = _arguments()
    known = read(wanted.out) if wanted.resume and wanted.out else {}
    if wanted.out and not wanted.resume:
        wanted.out.write_text("", encoding="utf-8")
    chosen = cases(wanted.families, wanted.count)
    left = [c for c in chosen if c.name not in known]
    for result in track(finished(left, wanted.jobs), "nulls", len(left)):
        known[result["case"]] = result
        if wanted.out:
            with wanted.out.open("a", encoding="utf-8") as file:
                file.write(json.dumps(result) + "\n")
    show([known[c.name] for c in chosen])


def _arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--families", help=f"with commas, of {', '.join(FAMILIES)}; all if none")
    parser.add_argument("--count", type=int, default=4, help="of each family")
    parser.add_argument("--jobs", type=int, choices=(1, 2), default=1)
    parser.add_argument("-o", dest="out", type=Path, help="a line of JSON per case is added here")
    parser.add_argument("--resume", action="store_true", help="keep what the file has")
    wanted = parser.parse_args()
    wanted.families = wanted.families.split(",") if wanted.families else list(FAMILIES)
    if unknown := [f for f in wanted.families if f not in FAMILIES]:
        parser.error(f"no such family: {', '.join(unknown)}; there are {', '.join(FAMILIES)}")
    return wanted


def finished(wanted: Sequence[Case], jobs: int) -> Iterator[dict[str, Any]]:
    """Results as they come."""
    if jobs == 1:
        yield from map(_guarded, wanted)
        return
    with ProcessPoolExecutor(jobs) as pool:
        yield from pool.map(_guarded, wanted)


def _guarded(case: Case) -> dict[str, Any]:
    try:
        return run(case)
    except Exception:
        return {"case": case.name, "family": case.family, "error": traceback.format_exc()}


if __name__ == "__main__":
    main()
