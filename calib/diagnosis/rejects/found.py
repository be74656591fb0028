"""What was found of the beams that a fit rejected: numbers for scripts, sentences for people."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from calib.blunders import told
from calib.diagnosis.rejects.moved import MOST_NAMED, MovedPart
from calib.diagnosis.rejects.rejected import MOSTLY_SHORT
from calib.diagnosis.suggest import words
from calib.problem.model import Source
from calib.residuals.groups import (
    ALONG_BEAMS,
    ALONG_NORMAL,
    MESH_PARTS,
    SURFACE,
    part_of_mesh,
)
from calib.rig.suspect import listed

# Parts of the mesh, where more of which seem to have moved the rig may have: choices. Of two
# cupboards five sides were seen; where rigs that should stand still were pushed by 30 mm and by
# 50 mm, 18 parts and four walls seemed to have moved.
MOST_MOVED, MOST_BESIDE_A_STAND = 6, 3
# Share of beams that makes a place structured, whatever their residuals do: a choice, ten times
# what mixed pixels reach.
STRUCTURED_SHARE = 0.5
# Share that mixed pixels may explain, in all or at one place. They are 0.3 to 0.4 % in recordings
# of two simulators, 1 % at grazing incidence, and 4 % where the simulator does as a paper's rooms.
CLUTTER = 0.05
CROWDED = 2.0  # times the share of all, from which a place without structure is named: a choice
# Ending of a column -> its own unit, the one that people are shown, and the factor between.
INTERVAL_UNITS = {
    "_rad": ("rad", "deg", 180.0 / np.pi),
    "_m": ("m", "m", 1.0),
    "_s": ("s", "s", 1.0),
    "_c": ("degC", "°C", 1.0),
}


@dataclass(frozen=True)
class Place:
    """Where beams are rejected more than elsewhere.

    Args:
        covariate: a column; "stop", "surface" or "region".
        lower, upper: of its interval, in the column's own unit; an azimuth interval with
            ``lower > upper`` runs through pi. Of things, the first and the last.
        names: of things: stops, surfaces, labels; else empty.
        p_adjusted: after all looks.
        share: rejected share of its beams; rejected: share of all beams that is rejected there.
        beams: share of all beams that is there.
        residual_m: median residual of the rejected beams; along: these, or the normal of a part of
            the mesh, along which they agree better.
        sigma_m: of their mean, by stops and surfaces; NaN where there is one of them only.
        coherent: whether most would not be rejected were their median taken off, and not as well
            with the other sign.
        short: share of the rejected that reads short.
        meshed: whether surfaces are those of a mesh, and not planes found in the scans.
    """

    covariate: str
    lower: float
    upper: float
    names: tuple[str, ...]
    p_adjusted: float
    share: float
    rejected: float
    beams: float
    residual_m: float
    sigma_m: float
    coherent: bool
    short: float
    along: str = ALONG_BEAMS
    meshed: bool = True

    @property
    def structured(self) -> bool:
        """Whether neither mixed pixels nor things that stand in the way explain it."""
        odd = self.coherent or self.share > STRUCTURED_SHARE
        return odd and self.share > CLUTTER and not self.harmless

    @property
    def of_mesh(self) -> bool:
        """Whether it is parts of a mesh, each of which may have moved by itself."""
        return self.covariate in MESH_PARTS

    @property
    def in_the_way(self) -> bool:
        """Whether its beams hit something nearer than the mesh, at all distances."""
        return not self.coherent and self.short > MOSTLY_SHORT

    @property
    def of_a_plane(self) -> bool:
        """Whether it is the beams near a plane found in the scans."""
        return self.covariate == SURFACE and not self.meshed

    @property
    def beside_a_plane(self) -> bool:
        """Whether it is the lesser part of the beams near a plane, and all of them end as far from
        it: on a board before a wall, as nothing says that there is none."""
        return self.of_a_plane and self.coherent and self.share <= STRUCTURED_SHARE

    @property
    def no_plane(self) -> bool:
        """Whether it is most of the beams near a plane, and they end anywhere: a curtain, that wide
        cells take for flat."""
        return self.of_a_plane and not self.coherent and self.share > STRUCTURED_SHARE

    @property
    def harmless(self) -> bool:
        """Whether things explain it that nothing says are not there."""
        return self.in_the_way or self.beside_a_plane or self.no_plane

    @property
    def where(self) -> str:
        """In words: azimuth -40 to 0 deg."""
        if self.names:
            return f"{words(self.covariate)} {listed(self.names, MOST_NAMED)}"
        _, unit, scale = unit_of(self.covariate)
        lower, upper = scale * self.lower, scale * self.upper
        if self.covariate == "ring":
            lower, upper = np.ceil(lower), np.floor(upper)
        low, high = f"{lower:.4g}", f"{upper:.4g}"
        ends = low if low == high else f"{low} to {high}"
        return f"{words(self.covariate)} {ends} {unit}".rstrip()

    @property
    def what(self) -> str:
        """In words, what becomes of its beams."""
        if self.beside_a_plane:
            side = "before" if self.residual_m < 0 else "behind"
            return f"they end on another surface, {self.size} mm {side} that plane"
        if self.no_plane:
            return "what was taken for a plane is none"
        if self.coherent and self.along == ALONG_NORMAL:
            return f"they end {self.size} mm {'before' if self.residual_m < 0 else 'behind'} it"
        if self.coherent:
            return f"they read {self.size} mm {'short' if self.residual_m < 0 else 'long'}"
        if self.in_the_way:
            return "they hit something that is nearer than the mesh"
        return "they scatter over all values"

    @property
    def size(self) -> str:
        """Its median residual and the sigma of that, mm."""
        sigma = f" ± {1e3 * self.sigma_m:.2g}" if np.isfinite(self.sigma_m) else ""
        return f"{1e3 * abs(self.residual_m):.1f}{sigma}"

    def document(self) -> dict[str, Any]:
        """As in diagnosis.json: ends in the unit that is named."""
        ends = (self.names[0], self.names[-1]) if self.names else (self.lower, self.upper)
        return {
            "covariate": self.covariate,
            "from": ends[0],
            "to": ends[1],
            "names": list(self.names),
            "unit": "" if self.names else unit_of(self.covariate)[0],
            "residual_mm": 1e3 * self.residual_m,
            "sigma_mm": 1e3 * self.sigma_m,
            "share": self.share,
            "coherent": self.coherent,
            "along": self.along,
            "p_adjusted": self.p_adjusted,
        }

    def formula(self) -> dict[str, Any] | None:
        """An effect for it as a formula, where it is an interval of a column."""
        if self.names or not self.coherent:
            return None
        name, ends = self.covariate, (self.lower, self.upper)
        above, below = f"({name} > {ends[0]:.6g})", f"({name} < {ends[1]:.6g})"
        both = f"{above} * {below}" if ends[0] < ends[1] else f"maximum({above}, {below})"
        bare = name.removesuffix("_rad").removesuffix("_m").replace(".", "_")
        return {
            "name": f"rejected_{bare}",
            "site": "range",
            "unit": "m",
            "sigma": max(0.01, 2.0 * abs(self.residual_m)),
            "basis": [both],
            "what": f"Empirical, without a known cause: an interval of {name} whose "
            "beams were rejected.",
        }


@dataclass(frozen=True)
class Rejects:
    """What a fit threw away.

    Args:
        share: of all beams that meet a surface.
        expected: the same, of the beams outside what is structured: what mixed pixels may explain,
            never more than `CLUTTER`, and clutter.
        p_adjusted: of the least likely place.
        places: where more is rejected than elsewhere, most first.
        meshed: whether surfaces are those of a mesh, and not planes found in the scans.
        clutter: share of all beams that hit something that is not in the mesh; clutter_stops: the
            stops of these.
        moved: parts of the mesh that stand elsewhere, which no place tells.
        beyond: whether more is rejected elsewhere than mixed pixels may explain; beyond_m: the
            median residual of that, where it agrees on one.
    """

    share: float
    expected: float
    p_adjusted: float
    places: Sequence[Place]
    meshed: bool
    clutter: float
    clutter_stops: tuple[str, ...]
    beyond: bool
    beyond_m: float | None
    moved: Sequence[MovedPart] = ()

    @property
    def structured(self) -> Sequence[Place]:
        """The places that chance does not explain, nor mixed pixels, nor clutter."""
        return [place for place in self.places if place.structured]

    @property
    def wrong(self) -> Sequence[Place]:
        """Those of them that are surfaces of a mesh, or parts, most of whose beams were rejected:
        they stand elsewhere than the mesh has them, or beams do not end there."""
        mine = (place for place in self.structured if place.of_mesh)
        return [place for place in mine if self.meshed and place.share > STRUCTURED_SHARE]

    def blunders(self, sources: Sequence[Source], alone: bool = True) -> list[dict[str, Any]]:
        """What moved, and these where no effect was named that may explain them, as blunders in
        diagnosis.json, to be left out; of these recordings."""
        wrong = [
            told.of_part(
                part_of_mesh(place.covariate, name),
                sources,
                told.Elsewhere(place.residual_m, place.sigma_m, place.along)
                if place.coherent
                else None,
                place.p_adjusted,
            )
            for place in (self.wrong if alone else ())
            for name in place.names
        ]
        stands = any(source.rig.moves != "stop" for source in sources)
        if len(parts := self.moved_parts) > (MOST_BESIDE_A_STAND if stands else MOST_MOVED):
            return [*wrong, told.of_many_parts(parts, self.moved[0].when)]
        return [*wrong, *(each.blunder(sources) for each in self.moved)]

    @property
    def moved_parts(self) -> list[str]:
        """Names of what moved; each once, though it may stand in two places."""
        return list(dict.fromkeys(each.part for each in self.moved))

    @property
    def explained(self) -> bool:
        """Whether all that was rejected is what mixed pixels and clutter explain."""
        return not self.structured and not self.beyond and not self.moved

    @property
    def sentence(self) -> str:
        """What was rejected, in words."""
        said = f"{percent(self.share)} % of the beams that meet a surface were rejected"
        if self.beyond:
            said += f", more than the {100 * CLUTTER:.0f} % that mixed pixels may explain"
            said += f", by {1e3 * self.beyond_m:+.1f} mm" if self.beyond_m else ""
        least = max(CLUTTER, CROWDED * self.share)
        crowded = [place for place in self.places if place.share > least]
        for place in (self.structured or crowded)[:2]:
            there = f"of the beams at {place.where} it is {percent(place.share)} %"
            said += f"; {there}, and {place.what}"
        if self.moved:
            parts = listed(self.moved_parts, MOST_NAMED)
            share = percent(sum(each.rejected for each in self.moved))
            said += f"; {share} % end at {parts}, elsewhere than the mesh has it"
        if self.clutter_stops:
            nowhere = "not in the mesh" if self.meshed else "on no plane found in the scans"
            said += f"; {percent(self.clutter)} % hit something that is {nowhere}, at stop "
            said += listed(self.clutter_stops, MOST_NAMED)
        return said + "."

    def unexplained(self) -> list[dict[str, Any]]:
        """Its structure as diagnosis.json lists residual structure."""
        return [
            {
                "covariates": [place.covariate],
                "rms_mm": 1e3 * abs(place.residual_m) * float(np.sqrt(place.rejected)),
                "p_value": place.p_adjusted,
                "p_adjusted": place.p_adjusted,
                "formula": place.formula(),
            }
            for place in self.structured
            if place not in self.wrong
        ]

    def document(self) -> dict[str, Any]:
        """As in diagnosis.json."""
        return {
            "share": self.share,
            "expected": self.expected,
            "covariates": list(dict.fromkeys(p.covariate for p in self.structured)),
            "p_adjusted": self.p_adjusted,
            "where": [place.document() for place in self.places],
            "moved": [each.document() for each in self.moved],
            "clutter": {"share": self.clutter, "stops": list(self.clutter_stops)},
            "explained": self.explained,
            "sentence": self.sentence,
        }


def unit_of(covariate: str) -> tuple[str, str, float]:
    """Unit of a column, the unit in which people are shown it, and the factor between the two."""
    return next((u for end, u in INTERVAL_UNITS.items() if covariate.endswith(end)), ("", "", 1.0))


def percent(share: float) -> str:
    """A share in percent, with two digits."""
    return f"{100 * share:.0f}" if share >= 0.1 else f"{100 * share:.2g}"
