"""targets.csv: spheres as the scanner saw them, joined with the markers of their rods."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from sensors.readers.base import Array, Columns, Spheres, Track

_PARTS = ("upper", "lower")
_MARKS = ".:_ -/"


def join(spheres: Spheres | None, tracks: Sequence[Track]) -> tuple[Columns | None, list[str]]:
    """The columns of targets.csv, or None, and what is missing for it.

    A rod's markers are tracked points named after their target: ``T1.upper`` and ``T1.lower``,
    or with a colon, a blank, a slash or the like. The median over the log is taken; targets hang
    still.
    """
    rods: dict[str, dict[str, Array]] = {}
    for track in tracks:
        target, part = _rod(track)
        if part:
            rods.setdefault(target, {})[part] = np.nanmedian(track.values, axis=0)
    whole = {name: rod for name, rod in rods.items() if len(rod) == len(_PARTS)}
    if spheres is None:
        return None, [f"{len(rods)} targets were tracked, and no source has their spheres"] * bool(
            rods
        )
    centres = dict(zip(spheres.names, spheres.centre_m, strict=True))
    names = [name for name in centres if name in whole]
    missing = [name for name in {**centres, **whole} if name not in names]
    odd = []
    if missing:
        odd.append(
            f"targets {', '.join(missing)} lack a sphere, or a tracked point NAME.upper or "
            "NAME.lower (--body POINT=NAME.upper)"
        )
    if len(names) < 3:
        return None, [
            *odd,
            f"{len(names)} targets are whole, and it takes 3; targets.csv is left out",
        ]
    out: Columns = {"target": np.array(names)}
    for part, at in (("faro", centres), *((p, {n: whole[n][p] for n in names}) for p in _PARTS)):
        for k, axis in enumerate("xyz"):
            out[f"{part}_{axis}"] = np.array([at[name][k] for name in names])
    return out, odd


def is_rod(track: Track) -> bool:
    """Whether a track is a marker of a target's rod, and no body of the rig."""
    return bool(_rod(track)[1])


def _rod(track: Track) -> tuple[str, str]:
    if track.kind == "point":
        for part in _PARTS:
            name = track.name[: -len(part)]
            if track.name.lower().endswith(part) and name and name[-1] in _MARKS:
                return name.strip(_MARKS), part
    return track.name, ""
