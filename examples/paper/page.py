"""The study's page: every table with the study's own figures beside ours."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

from sensors.documents import write_atomically

from .conditions import (
    BIASED,
    REASONS,
    SENSORS,
    SPHERES_MM,
    TABLE_3,
    TABLE_4,
    TABLE_5,
    TABLE_6,
    Scale,
)

INTRODUCTION = """\
# The study, again

"Pushing the Limits of LiDAR: Accurate Performance Analysis of Indoor 3D LiDARs" calibrated four
LiDARs on one arm step by step and measured them in one furnished room. Its recordings could not be
had, so rigcal's simulator stands in for them: {locations} locations of the robot x {stops} poses of
the arm, holds of 100 sweeps, averaged; every {step}th azimuth column. Beside noise, mean offset and
ring pattern, which the catalogue of LiDARs states, this acts in them:

{acting}

Bold figures are ours, figures in brackets the study's. Lengths are in mm. Where ours
differ, the last section says why. Sizes are those of the literature; they and their signs were set
before any table was seen.
"""

DIFFERS = """\
## Where this differs from the study, and why

- **Room and recordings are simulated.** The room has 16 materials on flat panels and a curtain, the
  study's 28 on real furniture. Every 25th return (4 %) is spoilt, by edges or for no visible
  reason: a share that the simulator's presets have because clouds scatter about a mesh far too
  little without.
- **Spreads of range, Tables 5 and 6**, are about twice the study's. With the mount from CAD, poses
  are off by milliradians, and beams beside a depth edge are predicted to meet the surface before or
  behind it: a few directions err by decimetres, all LiDARs alike. With the graph's poses the same
  returns spread half as much. Distances from the nearest point know nothing of that, and spread a
  little less than the study's.
- **Means, Table 5.** The catalogue's mean offsets are the study's own, and the two effects on range
  come on top.
- **FARO column of Table 5** (0.2 ± 0.8): no FARO cloud is simulated. The mesh errs by 0.6 mm
  (1 sigma), smoothly along each surface.
- **Table 3** is smaller, as CAD and URDF of the simulated rig are better than the study's seem to
  have been: 1 mm and 2 to 3 mrad of each mount, 3 mm of each length. So is the spheres' distance.
  What errs in motion is a delay of the encoders of 20 ms at joint speeds of 0.25 rad/s (1 sigma),
  as long in motion as in holds; the study does not say how fast its arm was.
- **Table 4.** That planes are thinner by OptiTrack than by arm comes out in some rows only: much of
  what the simulated arm has wrong is alike at all poses of a location, which moves a plane and does
  not thicken it, and both ways share the LiDAR's own mount from CAD. The surfaces are a panelled
  wall and a cabinet of the simulated room. RANSAC takes returns within 50 mm of its plane; the
  study does not say how far it went.
- **The URDF's first length** lies along its own joint's axis, so no circle's radius tells it, and
  the sequence leaves it as drawn.
- **The study's offsets** come from and are judged by the same stops; here all methods learn from
  the same stops and are judged by others.
"""

METHODS = """\
## What the joint graph buys

The same recordings and the same metrics for every method. All learn from {learnt_from} stops and
are judged by {judged} at other locations. `on paper`: CAD and URDF at their word, poses by chassis
markers and arm. `the study's sequence`: lengths from circles, FARO from spheres, CAD for mount and
LiDAR, poses by mount markers, ring offsets by averaging. Then the joint graph, and what its
diagnosis found missing. `held out`: rms of inliers; mean, std and half of the central 68 % of all
returns; mean thickness of the large planes; then errors against the truth, rms: pose of the LiDAR
at the judged stops, lengths of the arm, range zeros of the rings, and these about their mean.
"""


def write_page(
    path: Path, results: Mapping[str, Any], captions: Mapping[str, str], scale: Scale
) -> None:
    """Write the page.

    Args:
        path: of the Markdown file; figures lie in ``figures/`` beside it.
        results: as `study` returns.
        captions: file name -> caption of the figures.
        scale: what was simulated.
    """
    each = results["sensors"]
    first = next(iter(each.values()))
    acting = "\n".join(f"- `{name}`: {why}" for name, why in REASONS.items())
    parts = [
        INTRODUCTION.format(
            locations=scale.locations, stops=scale.stops, step=scale.column_step, acting=acting
        ),
        "## Does it come out as in the study?\n",
        _table(("", "claim", "figures"), map(_claim, results["shape"])),
        METHODS.format(**first["stops"]),
        *(f"**{sensor}**\n\n{_methods(row['methods'])}" for sensor, row in each.items()),
        _table_3(each, first["spheres_mm"]),
        _table_4(each),
        _table_5(each),
        *([_table_6(each[BIASED]["table_6"])] if BIASED in each else []),
        "## Figures\n",
        *(f"![{text}](figures/{name})\n\n{text}\n" for name, text in captions.items()),
        DIFFERS,
    ]
    with write_atomically(path) as temporary:
        temporary.write_text("\n".join(parts), encoding="utf-8")


def _table(heading: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    lines = [heading, ["---"] * len(heading), *rows]
    return "\n".join(f"| {' | '.join(cells)} |" for cells in lines) + "\n"


def _claim(claim: Mapping[str, Any]) -> tuple[str, str, str]:
    return "yes" if claim["holds"] else "**no**", claim["claim"], claim["figures"]


def _beside(ours: float | None, theirs: float) -> str:
    return f"**{ours:.1f}** ({theirs:g})" if ours is not None else f"- ({theirs:g})"


def _methods(methods: Mapping[str, Mapping[str, Any]]) -> str:
    heading = ("", "held out", "mean ± std", "68 %", "cloud to mesh", "planes")
    heading += ("pose", "lengths", "rings", "pattern")
    rows = []
    for name, m in methods.items():
        to_mesh = m["cloud_to_mesh"]
        rows.append(
            (
                name,
                f"**{m['held_out_rms']:.2f}**",
                f"{m['mean']:+.2f} ± {m['std']:.1f}",
                f"{m['half_68']:.2f}",
                f"{to_mesh['mean']:+.2f} ± {to_mesh['std']:.1f}",
                f"{m['plane']:.1f}",
                f"{m['pose_mm']:.2f} mm, {m['pose_mrad']:.2f} mrad",
                f"{m['lengths_mm']:.2f}",
                f"{m['rings_mm']:.2f}",
                f"{m['ring_pattern_mm']:.2f}",
            )
        )
    return _table(heading, rows)


def _table_3(each: Mapping[str, Any], spheres_mm: float) -> str:
    names = list(SENSORS)
    rows = []
    for kind in ("static", "all"):
        theirs = dict(zip(names, TABLE_3[kind], strict=True))
        for method in ("on paper", "the study's sequence", "joint graph"):
            ours = {s: row["table_3"][method][kind] for s, row in each.items()}
            last = method == "the study's sequence"
            cells = (_beside(v, theirs[s]) if last else f"**{v:.1f}**" for s, v in ours.items())
            rows.append((kind, method, *cells))
    return (
        "## Table 3: OptiTrack against arm\n\nMean distance of the mount's markers by the two ways,"
        " with the arm as each method has it. The spheres lie "
        f"**{spheres_mm:.2f}** ({SPHERES_MM}) from where the alignment puts them.\n\n"
        + _table(("", "arm", *each), rows)
    )


def _table_4(each: Mapping[str, Any]) -> str:
    columns = ("Static", "Opti", "Arm", "All Opti")
    rows = []
    for material in ("wood", "metal"):
        for sensor, row in each.items():
            ours, theirs = row["table_4"][material], TABLE_4[material, sensor]
            cells = [_beside(ours[c], v) for c, v in zip(columns, theirs, strict=True)]
            graph = ours["All graph"]
            rows.append((material, sensor, *cells, "-" if graph is None else f"**{graph:.1f}**"))
    return (
        "## Table 4: thickness of planes\n\nStandard deviation of returns across a RANSAC plane;"
        " `All graph`: all locations, poses and corrections of the joint graph as grown.\n\n"
        + _table(("", "", *columns, "All graph"), rows)
    )


def _table_5(each: Mapping[str, Any]) -> str:
    rows = []
    for sensor, row in each.items():
        ours, (mean, std) = row["table_5"], TABLE_5[sensor]
        near = ours["cloud_to_mesh_mm"]
        signed = ours["signed_error_mm"]
        rows.append(
            (
                sensor,
                _beside(signed["mean"], mean),
                _beside(signed["std"], std),
                f"{signed['median']:.1f}, {signed['half_68']:.1f}",
                _beside(near["mean"], mean),
                _beside(near["std"], std),
                f"{ours['accuracy_mm']:.1f}",
                f"{ours['precision_mm']:.1f}",
            )
        )
    heading = ("", "mean", "std", "median, half of 68 %", "nearest, mean", "nearest, std")
    return (
        "## Table 5: cloud to mesh\n\nSigned range error along the beam, of all returns,"
        " uncorrected, at the study's poses; then the distance from the nearest point of the"
        " mesh (`nearest`), which the study's name of the table may mean as well.\n\n"
        + _table((*heading, "accuracy", "precision"), rows)
    )


def _table_6(steps: Sequence[Mapping[str, Any]]) -> str:
    rows = []
    for s in steps:
        theirs = TABLE_6.get(s["step"])
        mean = f"**{s['mean']:.2f}**" + (f" ({theirs[0]:g})" if theirs else "")
        std = f"**{s['std']:.1f}**" + (f" ({theirs[1]:g})" if theirs else "")
        cells = (s["step"], mean, std, f"{s['half_68']:.2f}", f"{s['near']:.1f}")
        rows.append((*cells, f"{100 * s['far_share']:.1f} %", f"{s['noise']:.1f}"))
    return (
        f"## Table 6: {BIASED}, and what cures the spread\n\nOn stops that no method learnt from."
        " `filtered`, and all rows below: under 70° of incidence, without the tenth of lowest"
        " intensity. `68 %`: half the width of the central 68 % of directions. `near`: the spread"
        " without directions that err by more than 5 cm, whose share is `far`. `noise`: of returns"
        " about their direction's mean.\n\n"
        + _table(("", "mean", "std", "68 %", "near", "far", "noise"), rows)
        + _lesson(steps)
    )


def _lesson(steps: Sequence[Mapping[str, Any]]) -> str:
    """What takes the spread of Table 6 down, step by step, and what is left of it."""
    rows = {s["step"]: s for s in steps}
    first, rings, last = rows["origin, filtered"], rows["ring offsets"], steps[-1]
    after = steps[steps.index(rings) + 1 :]
    falls = [
        f"{s['step']} takes it from {b['std']:.1f} to {s['std']:.1f} (central 68 %: ±"
        f"{b['half_68']:.2f} to ±{s['half_68']:.2f})"
        for b, s in zip((rings, *after), after, strict=False)
    ]
    left, far = last["std"] ** 2, last["std"] ** 2 - last["near"] ** 2
    noise, rest = last["noise"] ** 2, last["near"] ** 2 - last["noise"] ** 2
    return (
        f"\nRing offsets take the mean from {first['mean']:.1f} to {rings['mean']:.2f} and the"
        f" spread from {first['std']:.1f} to {rings['std']:.1f} only. What cures the spread: "
        f"{'; '.join(falls)}. Of the {left:.0f} mm² that are left, {100 * far / left:.0f} % comes"
        f" from the {100 * last['far_share']:.1f} % of directions that err by more than 5 cm"
        " (spoilt returns, which no calibration moves: leave them out),"
        f" {100 * noise / left:.0f} % is noise about each direction's mean (average it), and"
        f" {100 * rest / left:.0f} % everything else.\n"
    )
