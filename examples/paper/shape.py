"""Whether what comes out has the shape of what the study found: claims, and what they rest on."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from .case import Columns
from .conditions import BIASED, TABLE_5
from .figures import by_distance, by_incidence, by_ring

Claim = dict[str, Any]


def shape(
    results: Mapping[str, Any],
    points: Mapping[str, Columns],
    rings: Mapping[str, Mapping[str, np.ndarray]],
) -> list[Claim]:
    """What the study says, whether it came out so, and the figures: `claim`, `holds`, `figures`.

    Claims about LiDARs that were not simulated are left out.
    """
    each = results["sensors"]
    claims = [*_means(each), *_degrading(points), *_planes(each)]
    if BIASED in each:
        claims += _ring_offsets(each[BIASED], points[BIASED], len(rings[BIASED]["true"]))
    return claims


def _claim(claim: str, holds: bool, figures: str) -> Claim:
    return {"claim": claim, "holds": bool(holds), "figures": figures}


def _means(each: Mapping[str, Any]) -> list[Claim]:
    mean = {s: row["table_5"]["signed_error_mm"]["mean"] for s, row in each.items()}
    std = {s: row["table_5"]["signed_error_mm"]["std"] for s, row in each.items()}
    wanted = sorted(mean, key=lambda s: -abs(TABLE_5[s][0]))
    ours = sorted(mean, key=lambda s: -abs(mean[s]))
    told = ", ".join(f"{s} {mean[s]:+.1f}" for s in wanted)
    claims = [_claim(f"mean errors in the order {' > '.join(wanted)}", ours == wanted, told)]
    if "XT" in each:
        told = ", ".join(f"{s} {v:.1f}" for s, v in std.items())
        claims.append(_claim("XT32 spreads least", min(std, key=std.get) == "XT", told))
    return claims


def _degrading(points: Mapping[str, Columns]) -> list[Claim]:
    """All worse beyond 70 degrees; Ousters with distance, Hesais not."""
    steep, far = {}, {}
    for sensor, table in points.items():
        angle, precision = by_incidence(table, "precision_m")
        steep[sensor] = precision[angle > 75].mean() / precision[angle < 30].mean()
        distance, precision = by_distance(table)
        near, beyond = distance < 2.5, distance > 4.5
        far[sensor] = precision[beyond].mean() / precision[near].mean()
    told = ", ".join(f"{s} x {v:.2f}" for s, v in steep.items())
    claims = [
        _claim("precision is worse beyond 75° than under 30°", min(steep.values()) > 1.1, told)
    ]
    ousters = [v for s, v in far.items() if s.startswith("Ouster")]
    others = [v for s, v in far.items() if not s.startswith("Ouster")]
    told = ", ".join(f"{s} x {v:.2f}" for s, v in far.items())
    falls = min(ousters, default=np.inf) > 1.1 > max(others, default=0.0)
    text = "precision beyond 4.5 m against under 2.5 m: Ousters lose, Hesais hardly"
    return [*claims, _claim(text, falls, told)]


def _planes(each: Mapping[str, Any]) -> list[Claim]:
    rows = [row["table_4"][material] for row in each.values() for material in ("wood", "metal")]
    rows = [row for row in rows if None not in row.values()]
    thinner = sum(row["Static"] <= row["Opti"] for row in rows)
    claims = [
        _claim("one pose is thinner than ten", thinner == len(rows), f"{thinner} of {len(rows)}")
    ]
    thinner = sum(row["Opti"] < row["Arm"] for row in rows)
    if len(rows) < 4:
        return claims
    text = "planes are thinner by OptiTrack than by arm, all rows but one or two"
    claims.append(_claim(text, thinner >= len(rows) - 2, f"{thinner} of {len(rows)}"))
    return claims


def _ring_offsets(row: Mapping[str, Any], points: Columns, rings: int) -> list[Claim]:
    """Figure 9 and Table 6."""
    median_mm = 1e3 * by_ring(points, rings)
    reach = float(np.nanmax(median_mm) - np.nanmin(median_mm))
    steps = {step["step"]: step for step in row["table_6"]}
    first, last = steps["origin, filtered"], steps["ring offsets"]
    told = f"mean {first['mean']:.1f} to {last['mean']:.2f}, std {first['std']:.1f} to "
    cured = abs(last["mean"]) < 0.15 * abs(first["mean"]) and last["std"] > 0.8 * first["std"]
    return [
        _claim("Ouster6's rings differ by centimetres", reach > 10, f"{reach:.0f} mm in all"),
        _claim(
            "ring offsets cure the mean and hardly the spread", cured, told + f"{last['std']:.1f}"
        ),
    ]
