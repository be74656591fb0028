"""What the data could not tell: found from the joint covariance, said in a roboticist's words."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from scipy.linalg import block_diag, qr

from calib.linear.symmetric import eigh
from calib.problem.unknowns import Unknown
from calib.residuals.groups import Group
from calib.residuals.surfaces import PlaneSurface
from calib.rig.inventory import odd_numbers, odd_rig
from calib.rig.suspect import listed
from calib.solve.estimate import Estimate
from calib.solve.otherwise.rooms import rooms_turned

UNTOLD = 0.98  # of the prior's variance left: a choice; the data took 1 % off the prior's sigma
# Of a scan's beams on planes: from which it sees a plane, up to which the others hardly do, and how
# many of them lie on such planes where it is alone; choices. Of two exchanged scans it was 95 %, of
# others none.
SEEN_SHARE, HARDLY_SEEN, ALONE_SHARE = 0.05, 0.02, 0.5
# Of the leading parameter's share, in units of the priors, from which another is named beside it: a
# choice; one with less changes what the data see by a hundredth, in squares.
PARTNER = 0.1
LEADS_LAST = 1e-3  # of a preference: any other parameter of a direction leads it
# Why a parameter is not estimated that is tied to no other.
UNMEASURED = (
    "no measurement that has weight depends on it, so its estimate and sigma are what is known "
    "without one"
)
REJECTED_BEAMS = (
    "half or more of the beams that depend on it are rejected; the others may agree by chance, "
    "so its sigma is that from before the fit; what do these beams see?"
)
TOLD_LESS = (
    "the data tell it less exactly than what was known before, by themselves or as the pose of the "
    "rig's root is unknown too; track a body on the root, or measure it directly"
)


def odd(estimate: Estimate) -> list[str]:
    """Which numbers, scans and guesses are hardly what they are taken for, or might be others;
    clauses."""
    sources = [(s.rig, s.recording) for s in estimate.problem.sources]
    numbers = [each for rig, stops in sources for each in (*odd_rig(rig), *odd_numbers(rig, stops))]
    alone = seen_alone(estimate)
    rooms = [room.sentence for room in rooms_turned(estimate.problem, estimate.values)]
    return [*numbers, *([shown_by_no_other(alone)] if alone else []), *rooms]


def not_heard(not_estimated: Sequence[Mapping[str, str]]) -> list[str]:
    """Parameters of beams that were rejected, so that nobody knows them; a sentence, or none."""
    names = [each["name"] for each in not_estimated if each["why"] == REJECTED_BEAMS]
    if not names:
        return []
    several = len(names) > 1
    return [
        f"Half or more of the beams of {listed(names)} were rejected, so "
        f"{'they are' if several else 'it is'} as known before the fit, and no better: what do "
        "these beams see?"
    ]


def seen_alone(estimate: Estimate) -> list[Group]:
    """Scans that see planes of their own, where planes are what was found in the scans: such a scan
    tells nothing, and one that belongs to another stop is such a scan."""
    found: list[Group] = []
    rooms: dict[int, list[int]] = {}
    for i, scan in enumerate(estimate.scans):
        if isinstance(scan.meeting, PlaneSurface):
            rooms.setdefault(id(scan.meeting), []).append(i)
    for some in rooms.values():
        parts = [estimate.associations[i].part + 1 for i in some]
        planes = max(part.max(initial=0) for part in parts) + 1
        beams = np.stack([np.bincount(part, minlength=planes)[1:] for part in parts])
        share = beams / np.maximum(beams.sum(axis=1, keepdims=True), 1)
        others = np.sort(share, axis=0)[-2] if len(share) > 1 else np.ones(share.shape[1])
        own = np.where((share > SEEN_SHARE) & (others < HARDLY_SEEN), share, 0.0)
        alone = own.sum(axis=1) > ALONE_SHARE
        found += [estimate.scans[i].group for i, mine in zip(some, alone, strict=True) if mine]
    return found


def shown_by_no_other(scans: Sequence[Group]) -> str:
    """What is said of such scans; a clause."""
    return (
        f"most of what the scan of stop {listed([scan.where for scan in scans])} shows, no other "
        "scan does: it tells nothing of the rig; does it belong to another stop?"
    )


def not_estimated(
    variables: Sequence[Unknown],
    covariance: np.ndarray,
    effects: frozenset[str],
    touched: np.ndarray,
    lost: Mapping[str, np.ndarray],
) -> list[dict[str, str]]:
    """Parameters whose estimate is the prior's doing, and why.

    In units of the priors the covariance is ``(I + information)^-1``, so directions in which its
    eigenvalue is near 1 are those the data say nothing about, gauges included. They are brought to
    echelon form, one leading parameter each, an effect's rather than a frame's.

    Args:
        variables: those of the covariance, in order.
        covariance: (P, P) joint marginal.
        effects: names of those that are effects, not frames.
        touched: (P,) whether any measurement that has weight depends on the parameter.
        lost: unknown -> (n,) which of its parameters are not trusted; see `Estimate`.

    Returns:
        A `name` and a `why` for each.
    """
    names = [f"{v.name}.{dof}" for v in variables for dof in v.dofs]
    root = block_diag(*(v.prior_root for v in variables))
    values, vectors = eigh(root @ covariance @ root.T)
    untold = vectors[:, values > UNTOLD]
    of_rejected = np.concatenate([lost.get(v.name, np.zeros(v.dim, bool)) for v in variables])
    dims = [v.dim for v in variables]
    owner = np.repeat([v.name for v in variables], dims)
    first = np.repeat(np.cumsum([0, *dims[:-1]]), dims)
    preference = np.where(np.isin(owner, sorted(effects)), 1.0, 0.3)
    preference[of_rejected] = LEADS_LAST
    directions, leading = echelon(untold, preference)
    found: dict[tuple[str, str], list[int]] = {}
    for i in np.flatnonzero(of_rejected):
        found.setdefault((str(owner[i]), REJECTED_BEAMS), []).append(int(i - first[i]))
    for column, lead in sorted(zip(directions.T, leading, strict=True), key=lambda pair: pair[1]):
        if of_rejected[lead]:
            continue
        share = np.abs(column)
        partners = np.flatnonzero((share > PARTNER) & (np.arange(len(share)) != lead))
        tied_to = _grouped(owner[partners], [names[i] for i in partners])
        alone = TOLD_LESS if touched[lead] else UNMEASURED
        why = _tied(tied_to) if tied_to else alone
        found.setdefault((str(owner[lead]), why), []).append(int(lead - first[lead]))
    whole = {v.name: v.dofs for v in variables}
    return [
        {"name": _name(variable, at, whole[variable]), "why": why}
        for (variable, why), at in found.items()
    ]


def echelon(space: np.ndarray, preference: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The directions (P, r) that span a space (P, r) and have one leading parameter each, in which
    no other has a part; and which these (r,) are. Where eigenvalues are equal their eigenvectors
    are any mixture, but these are always the same.

    Args:
        space: orthonormal directions.
        preference: (P,) for a parameter to lead.
    """
    if not space.shape[1]:
        return space, np.zeros(0, int)
    _, _, order = qr((space * preference[:, None]).T, mode="economic", pivoting=True)
    leading = order[: space.shape[1]]
    return space @ np.linalg.inv(space[leading]), leading


def _name(variable: str, at: list[int], dofs: tuple[str, ...]) -> str:
    """A variable, or those of its dofs that stand at some places."""
    if len(at) == len(dofs):
        return variable
    return f"{variable}.{dofs[at[0]]}" if len(at) == 1 else f"{variable} ({_runs(at, dofs)})"


def _runs(at: list[int], dofs: tuple[str, ...]) -> str:
    """The names with commas; three or more that follow each other as first … last."""
    runs = np.split(at, np.flatnonzero(np.diff(at) != 1) + 1)
    parts = [
        f"{dofs[run[0]]} … {dofs[run[-1]]}" if len(run) > 2 else ", ".join(dofs[i] for i in run)
        for run in runs
    ]
    return ", ".join(parts)


def _grouped(owner: Sequence[str], names: Sequence[str]) -> str:
    """The partners, a frame or effect each, with the parameter where there is one only."""
    by_owner: dict[str, list[str]] = {}
    for variable, name in zip(owner, names, strict=True):
        by_owner.setdefault(variable, []).append(name)
    listed = [found[0] if len(found) == 1 else variable for variable, found in by_owner.items()]
    return " and ".join(listed)


def _tied(partners: str) -> str:
    return (
        f"tied to {partners}: the data determine only their combination, and how it is divided "
        f"follows from the sigmas in rig.yaml; to separate them, measure one of them directly"
    )
