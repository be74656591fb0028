"""What changed between two runs: ``rigcal moved``.

Two runs of different recordings are compared as ``fit --prior`` does it: the first stands for what
was known, and what the data of the second say is taken out of its solution, so that CAD, which both
began with, counts once. With C the graph's covariance of the second, x its estimate from CAD, and L
the precision of CAD, its data alone have the information ``I = C^-1 - L`` and the normal equations
``I z = C^-1 x``. The fit from the first is then one Gauss-Newton step, and needs no recording.

Two runs that share recordings do not err independently. What differs is due to the model, or to the
data that only one has. Where one is efficient, as it has all data of the other and no parameter
that the other lacks, the covariance of the difference is the difference of the covariances (Hausman
1978, Specification tests in econometrics). Else how the two go together is not known, and
``2 (C_a + C_b)`` is an upper bound whatever it is.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.linalg import block_diag
from scipy.special import chdtrc

from calib.effects import GEOMETRY
from calib.linear.symmetric import eigh
from calib.problem.prior import JointPrior
from calib.recalibration.letgo import ALARM, let_go
from calib.recalibration.links import Link
from calib.recalibration.newer import NewerData, blocks_of
from calib.recalibration.prior import change
from calib.runs.asked.pair import Covariances, Pair
from calib.runs.run import Run, solution_digest
from calib.solve.descent import LAST
from chains.errors import InputError

PRIOR, INDEPENDENT, SHARED = "prior", "independent", "shared"  # how two runs go together
# A fit ends where a step would lower half the chi-square by less than LAST: by so much of its
# variance may an estimate be off, and so by twice as much the difference of two.
UNSETTLED = 4 * LAST
NAMED_ALONE = 3  # parameters of one arm alone: a choice


@dataclass(frozen=True)
class Moved:
    """What changed between two runs.

    Args:
        runs: the first and the second.
        relation: "prior" where the second was fitted from the first, "independent" of different
            recordings, "shared" where a recording is in both.
        links: as ``links`` in the `summary.json` of a fit from a prior; where recordings are shared
            ``moved`` says that a difference is beyond chance.
        bounds: names of links whose sigmas are upper bounds.
        remarks: how the two go together, a sentence each.
    """

    runs: tuple[Run, Run]
    relation: str
    links: list[dict[str, Any]]
    bounds: tuple[str, ...]
    remarks: tuple[str, ...]

    def document(self) -> dict[str, Any]:
        """As ``rigcal moved --json`` gives it, but for the sentence."""
        return {
            "runs": [str(run.folder) for run in self.runs],
            "relation": self.relation,
            "links": self.links,
            "upper_bounds": self.bounds,
            "remarks": self.remarks,
        }


def moved(a: Run, b: Run) -> Moved:
    """What changed from one run to another, of the frames and effects that both estimate.

    Args:
        a: the earlier run.
        b: the later one.

    Raises:
        InputError: the two have nothing in common; one knows the other's recordings by its prior,
            in a way that does not say how they go together; or a run is incomplete.
    """
    if a.folder.resolve() == b.folder.resolve():
        raise InputError(f"{a.folder} is given twice; give two runs")
    differ = tuple(_models_differ(a, b))
    if b.prior is not None and _is_prior(a, b):
        told = f"{b.folder} was fitted from {a.folder}: this is what that fit found"
        links = list(b.summary["links"])
        return Moved((a, b), PRIOR, links, bounds=(), remarks=(told, *differ))
    _refuse_known_by_prior(a, b)
    _refuse_known_by_prior(b, a)
    if _digests(a) & _digests(b):
        links, bounds = _differences(Pair.of(a, b), _efficient(a, b))
        told = (*_shared(a, b, bounds, len(links)), *differ)
        return Moved((a, b), SHARED, _documents(links), bounds=bounds, remarks=told)
    if b.prior is not None:
        recordings = " ".join(str(path) for path in b.recordings)
        raise InputError(
            f"{b.folder} was fitted from another run than {a.folder}; fit its recordings from that "
            f"one: rigcal fit {recordings} -o NEW --prior {a.folder}"
        )
    told = (
        "Different recordings: their errors, those of a mesh that both rest on too, are taken for "
        "independent, and CAD counts once"
    )
    links = _documents(_apart(Pair.of(a, b), b))
    return Moved((a, b), INDEPENDENT, links, bounds=(), remarks=(told, *differ))


def _documents(links: Sequence[Link]) -> list[dict[str, Any]]:
    return [link.document() for link in links]


# ------------------------------------------------------------------------- how two runs go together


def _digests(run: Run) -> set[str]:
    """What its recordings held, by their hash."""
    return {recording["sha256"] for recording in run.model["recordings"]}


def _is_prior(a: Run, b: Run) -> bool:
    """Whether the second run was fitted from the first, as that is now."""
    told, there = b.model.get("prior_sha256"), b.prior == a.folder.resolve()
    if told is None:
        return there
    if there and told != solution_digest(a.folder):
        raise InputError(
            f"{a.folder} has changed since {b.folder} was fitted from it; fit that again"
        )
    return told == solution_digest(a.folder)


def _refuse_known_by_prior(run: Run, other: Run) -> None:
    """Raise InputError where a run knows recordings of the other by its prior alone."""
    before, seen = run.prior, {run.folder.resolve()}
    while before is not None and before not in seen:
        seen.add(before)
        earlier = Run.open(before)
        if (_digests(earlier) - _digests(run)) & _digests(other):
            raise InputError(
                f"{run.folder} knows the recordings of {other.folder} by its --prior, so their "
                f"difference is no move; give a run, and then one that was fitted from it"
            )
        before = earlier.prior


def _efficient(a: Run, b: Run) -> int | None:
    """Which of two runs that share recordings has all data that the other has, and no parameter
    that the other lacks: 0, 1, or None for neither."""
    if a.model.get("prior_sha256") != b.model.get("prior_sha256"):
        return None
    for i, (one, other) in enumerate(((a, b), (b, a))):
        data = _digests(one) >= _digests(other)
        data = data and {*one.left_out, *one.set_aside} <= {*other.left_out, *other.set_aside}
        fewer = set(one.effects) <= set(other.effects)
        if data and fewer and set(one.model["fixed"]) >= set(other.model["fixed"]):
            return i
    return None


def _models_differ(a: Run, b: Run) -> Iterator[str]:
    for one, other in ((a, b), (b, a)):
        if more := [name for name in one.effects if name not in other.effects]:
            yield (
                f"Only {one.folder} has {', '.join(more)}; estimates of {other.folder} may have "
                f"absorbed it"
            )
    rigs = [list(dict.fromkeys(r["rig"] for r in run.model["recordings"])) for run in (a, b)]
    if rigs[0] != rigs[1]:
        yield f"The rigs have different names: {', '.join(rigs[0])}, and {', '.join(rigs[1])}"
    for one, other in ((a, b), (b, a)):
        theirs, held = {*other.solution.keys}, {*other.model["fixed"]}
        of_both = {key.unknown for key in theirs} & {*GEOMETRY}
        alone = [k for k in one.solution.keys if k.unknown in of_both and k not in theirs]
        if own := [key.name for key in alone if key.name not in held]:
            named = ", ".join(own[:NAMED_ALONE]) + (", …" if len(own) > NAMED_ALONE else "")
            yield f"Only {one.folder} has {named}: joints of {other.folder} differ, or are not read"


def _shared(a: Run, b: Run, bounds: Sequence[str], links: int) -> Iterator[str]:
    """How differences of runs that share recordings are to be read."""
    if _digests(a) == _digests(b):
        yield "The recordings are the same: nothing moved, what differs is due to the model"
    else:
        yield "The runs share recordings: what differs is due to the model and to the other data"
    if len(bounds) < links:
        yield "Covariance of a difference: the difference of the two covariances (Hausman)"
    if bounds:
        which = "All sigmas" if len(bounds) == links else f"The sigmas of {', '.join(bounds)}"
        yield f"{which} are upper bounds: how the errors of the two correlate is not known"


# ----------------------------------------------------------------------------- different recordings


def _apart(pair: Pair, b: Run) -> list[Link]:
    """What became of each link between runs of different recordings; all in sigmas of CAD."""
    sigma = np.concatenate([u.prior_sigma for u in pair.held])
    scale = np.outer(sigma, sigma)
    # Of a pose next to nothing was known.
    roots = (u.prior_root * (u.kind != "pose") for u in pair.held)
    cad = block_diag(*(root.T @ root for root in roots)) * scale
    then = [np.zeros(u.dim) if u.kind == "pose" else pair.then[u.name] for u in pair.held]
    prior = JointPrior(pair.held, pair.then, pair.first.reported)
    _, turned = change(prior, pair.now)
    about_then = (turned @ each @ turned.T for each in (pair.second.graph, pair.second.reported))
    graph, reported = (each / scale for each in about_then)
    weight = np.linalg.inv(graph)
    information = _nowhere_negative(weight - cad)
    force = weight @ (pair.change / sigma) + cad @ (np.concatenate(then) / sigma)
    wider = (b.summary.get("cad_widened_by", 1.0) ** 2 - 1.0) * pair.is_frame
    beyond = _nowhere_negative(weight @ (reported - graph) @ weight - cad * wider)

    data = NewerData(information / scale, force / sigma, beyond / scale)
    return let_go(prior, data.fitted)


def _nowhere_negative(matrix: np.ndarray) -> np.ndarray:
    """The nearest symmetric matrix without negative eigenvalues: those that it has are rounding."""
    values, axes = eigh((matrix + matrix.T) / 2)
    return (axes * np.maximum(values, 0.0)) @ axes.T


# -------------------------------------------------------------------------------- shared recordings


def _differences(pair: Pair, efficient: int | None) -> tuple[list[Link], tuple[str, ...]]:
    """How estimates of runs that share recordings differ, and the links whose sigmas are bounds."""
    links, bounds, blocks = [], [], blocks_of(pair.held)
    for unknown in pair.held:
        k = blocks[unknown.name]
        first, second = (
            Covariances(*(m[k, k] for m in each)) for each in (pair.first, pair.second)
        )
        V = None if efficient is None else _hausman(*((first, second), (second, first))[efficient])
        if V is None:
            V = 2.0 * (first.reported + second.reported)
            bounds.append(unknown.name)
        change = pair.change[k]
        p = float(chdtrc(unknown.dim, change @ np.linalg.solve(V, change)))
        links.append(
            Link(
                name=unknown.name,
                moved=p < ALARM / len(pair.held),
                p_value=p,
                change=change,
                sigma=np.sqrt(np.diag(V)),
                parameters=unknown.dofs,
                units=unknown.units,
            )
        )
    return links, tuple(bounds)


def _hausman(efficient: Covariances, other: Covariances) -> np.ndarray | None:
    """Covariance of the difference of two estimates, as much wider as those of the estimates are;
    None where it would be negative somewhere."""
    scale = np.sqrt(np.diag(other.graph))
    V = (other.graph - efficient.graph) / np.outer(scale, scale) + UNSETTLED * np.eye(len(scale))
    if np.linalg.eigvalsh(V)[0] <= 0.0:
        return None
    ratios = [np.diag(each.reported) / np.diag(each.graph) for each in (efficient, other)]
    root = scale * np.sqrt(np.maximum(*ratios))
    return V * np.outer(root, root)
