"""Which mechanisms could be behind a formula: a formula describes, physics explains.

Known effects that depend on the same covariates look like it under other conditions; mechanisms and
experiments are those of calibration practice.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from typing import Any

from calib.effects import CATALOGUE, Site

# Covariate -> a mechanism by which ranges depend on it, and the experiment that would confirm it.
# Range, ring, azimuth, incidence and intensity after Lichti 2007 and Glennie and Lichti 2010,
# temperature after Glennie and Lichti 2011; the others from how the instruments are built.
MECHANISMS = {
    "range_m": (
        "the timing circuit is not linear, or changes its gain or firing mode at a distance",
        "one board of one material at many distances, along one beam",
    ),
    "incidence_rad": (
        "an oblique surface stretches the returned pulse, and the threshold is crossed later",
        "one board at one distance, turned from 0 to 75 degrees",
    ),
    "azimuth_rad": (
        "a part of the window is scratched or dirty, or the housing reflects into the receiver",
        "the same wall with the LiDAR turned on its mount by 90 degrees; a cleaned window",
    ),
    "elevation_rad": (
        "every channel has its own electronics and its own path through the window",
        "the LiDAR rolled by 90 degrees, so that each ring sees the same wall",
    ),
    "ring": (
        "channels share chips and power supplies in groups, and each has its own delay",
        "the LiDAR rolled by 90 degrees, so that each ring sees the same wall",
    ),
    "intensity": (
        "a weak return crosses the detector's threshold later than a strong one",
        "a grey-scale card at one distance",
    ),
    "label": (
        "light penetrates some materials before it returns, and others reflect as a mirror does",
        "the same surface sprayed matt, or another material hung in its place",
    ),
    "time_s": (
        "something drifts or settles: electronics that warm up, a mount that creeps",
        "the first pose again at the end, and once more after a restart",
    ),
    "temperature_c": (
        "delays of laser and detector change with temperature, and housings grow",
        "one pose while the LiDAR warms up from cold, and once more while it cools",
    ),
    "humidity": (
        "condensation on the window, or a column that only changes along with time",
        "one pose in dry and in moist air at one temperature",
    ),
}
WHY_JOINT = (
    "cables pull on the LiDAR or its supply sags as the arm moves, or the arm bends",
    "the same view reached with other values of this joint",
)
# The same of what depends on an arm's joint: Hollerbach, Khalil and Gautier 2016.
OF_ARM = {
    "payload_kg": (
        "gears and links bend under the load",
        "the same poses with the load and without it",
    ),
    "temperature_c": (
        "links grow and gears change with temperature",
        "the same poses cold and after an hour of work",
    ),
    "time_s": (
        "the base, the tracker or a mount creeps or warms up",
        "the first poses again at the end",
    ),
}
ARM_JOINT = (
    "encoders and gears err by parts of a turn, and gears and links bend under the arm's weight",
    "this joint alone moved through its range, up and down, with the arm stretched and folded",
)
WHY_OTHER = (
    "no mechanism is known for this column; it may stand in for another that changes along with it",
    "this column changed on purpose while nothing else does",
)


def why(
    covariates: Sequence[str], joints: Collection[str] = (), of_arm: bool = False
) -> dict[str, Any]:
    """What could be behind a formula over some covariates of the range, or of a joint.

    Args:
        covariates: these.
        joints: which of them are joints of the arm.
        of_arm: whether the formula is one of a joint.

    Returns:
        ``known``: effects of the catalogue that depend on some of them and on nothing else;
        ``mechanisms``: covariate -> one, and ``experiments``: covariate -> what would confirm it.
    """
    mine = set(covariates)
    known = {
        e.family
        for e in CATALOGUE
        if e.site is (Site.JOINTS if of_arm else Site.BEAM)
        and e.covariates
        and (mine | {"joints"} if of_arm and joints else mine).issuperset(e.covariates)
    }
    by_name, of_joint = (OF_ARM, ARM_JOINT) if of_arm else (MECHANISMS, WHY_JOINT)
    found = {n: of_joint if n in joints else by_name.get(n, WHY_OTHER) for n in covariates}
    return {
        "known": sorted(known),
        "mechanisms": {name: mechanism for name, (mechanism, _) in found.items()},
        "experiments": {name: experiment for name, (_, experiment) in found.items()},
    }
