"""How good a design is, from the information of its stops; each is larger for a better one.

In M, the information of all stops and priors, n components are of interest and the others not.

- D: minus the log of the volume of the ellipsoid in which the n components lie.
- A: minus the log of the mean of their variances, each in units of what was known before.
- T: how far apart the data put rivals (Atkinson and Fedorov 1975): how much of the one is left once
  the other, and all that the model can take on, is taken off. Of all pairs the hardest counts most:
  minus the log of the mean of the squared sizes from which one is told from the other, each in
  units of the size from which it is found now, had it no rival.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from itertools import permutations

import numpy as np
from scipy import special

from calib.blunders.chance import KNOWN, enough
from calib.diagnosis.linear import WIDENED
from calib.diagnosis.search.confirmed import ALPHA_EFFECT
from calib.linear.parallel import in_order
from calib.linear.symmetric import eigh
from calib.planning.information import Information, inverse

DESIGNS_AT_ONCE = 32  # designs whose matrices are held at once
INFORMATION_ROUNDING = 1e-13  # of a component's information
LEAST_INFORMATION = 1e-9  # information, in squared sigmas: less is none


class Criterion:
    """What a design is chosen by.

    Args:
        start: what is known without the planned stops.
    """

    start: np.ndarray

    def of(self, M: np.ndarray) -> np.ndarray:
        """Of designs (n,), from the information (n, S, S) of all their stops and priors."""
        raise NotImplementedError

    def each(
        self, base: np.ndarray, more: np.ndarray, others: Sequence[np.ndarray] = ()
    ) -> np.ndarray:
        """Of designs (n,) that add one stop each, (n, S, S), to the same others.

        Args:
            base: (S, S) of all those others and priors.
            more: (n, S, S) of the stops that are added.
            others: (S, S) of each planned stop in `base`.
        """
        cuts = range(0, len(more), DESIGNS_AT_ONCE)
        return np.concatenate(
            list(
                in_order(
                    lambda i: self.of(base + more[cuts[i] : cuts[i] + DESIGNS_AT_ONCE]), len(cuts)
                )
            )
        )


class Volume(Criterion):
    """D-optimality of some components (n,)."""

    def __init__(self, known: Information, of: np.ndarray) -> None:
        self.start = known.data + known.paper
        self.rest = np.setdiff1d(np.arange(len(known.keys)), of)

    def of(self, M: np.ndarray) -> np.ndarray:
        out = np.linalg.slogdet(M)[1]
        if len(self.rest):
            out = out - np.linalg.slogdet(M[:, self.rest[:, None], self.rest])[1]
        return out


class Variance(Criterion):
    """A-optimality of some components (n,), in units of the sigmas (n,) that are wanted of them."""

    def __init__(self, known: Information, of: np.ndarray, wanted: np.ndarray) -> None:
        self.start, self.at = known.data + known.paper, of
        self.wanted = np.zeros((len(known.keys), len(of)))
        self.wanted[of, np.arange(len(of))] = 1.0 / np.square(wanted)

    def of(self, M: np.ndarray) -> np.ndarray:
        found = np.linalg.solve(M, np.broadcast_to(self.wanted, (len(M), *self.wanted.shape)))
        return -np.log(np.einsum("kjj->k", found[:, self.at]) / len(self.at))


class PredictionVariance(Criterion):
    """I-optimality (Box and Draper 1959): the mean variance of what is predicted, of which errors
    of the S components of `known` make ``W`` (S, S) times their covariance."""

    def __init__(self, known: Information, W: np.ndarray) -> None:
        values, turn = eigh(W)
        some = values > INFORMATION_ROUNDING * values[-1]
        self.start, self.root = known.data + known.paper, turn[:, some] * np.sqrt(values[some])

    def of(self, M: np.ndarray) -> np.ndarray:
        found = np.linalg.solve(M, np.broadcast_to(self.root, (len(M), *self.root.shape)))
        return -np.log(np.einsum("kij,ij->k", found, self.root))


class Apart(Criterion):
    """T-optimality: each of some effects against each of its rivals.

    Args:
        known: with the columns of all of them.
        of: of each effect its components (q,) and the size (q,) that it is taken to have.
        added: components of all of them that the model lacks; beside a pair the others play no
            part.
        pairs: numbers of an effect and of that which it is to be told from: its own, where that is
            the model alone. Every pair where None.
    """

    def __init__(
        self,
        known: Information,
        of: Sequence[tuple[np.ndarray, np.ndarray]],
        added: np.ndarray,
        pairs: Sequence[tuple[int, int]] | None = None,
    ) -> None:
        self.start, self.effects, self.added = _of_rows(known), of, added
        self.every = np.unique(np.concatenate([*(at for at, _ in of), added]).astype(int))
        self.pairs = every_pair(len(of)) if pairs is None else pairs
        # An effect of its usual size is to be found at least, where now none is.
        self.wanted = [1.0 + self.told(self.start[None], i, i)[0] for i, _ in self.pairs]

    def of(self, M: np.ndarray) -> np.ndarray:
        left = information_left(M, self.every)
        told = [self._of_pair(left, *pair) for pair in self.pairs]
        short = [
            w / np.maximum(x, LEAST_INFORMATION) for w, x in zip(self.wanted, told, strict=True)
        ]
        return -np.log(np.mean(short, axis=0))

    def told(self, M: np.ndarray, effect: int, rival: int) -> np.ndarray:
        """Information (n,) that tells an effect from a rival, in the mean over its components."""
        return self._of_pair(information_left(M, self.every), effect, rival)

    def _of_pair(self, left: np.ndarray, effect: int, rival: int) -> np.ndarray:
        """The same from that (n, E, E) on all of them beside the model."""
        (at, size), (other, _) = self.effects[effect], self.effects[rival]
        without = np.setdiff1d(self.added, np.concatenate([at, other]))
        places = (np.searchsorted(self.every, each) for each in (at, without))
        own = information_left(left, *places)
        return np.einsum("nii,i->n", own, np.square(size)) / len(at)


def every_pair(count: int) -> list[tuple[int, int]]:
    """Numbers of an effect and of a rival, of all of them; a single one against the model."""
    return list(permutations(range(count), 2)) if count > 1 else [(0, 0)]


def _of_rows(known: Information) -> np.ndarray:
    """Information (S, S) against which rivals are told: paper hardly counts."""
    return known.data + known.paper / WIDENED**2


def information_left(
    M: np.ndarray, at: np.ndarray, without: Sequence[int] | np.ndarray = ()
) -> np.ndarray:
    """Information (n, q, q) on some components that no other can take on; some play no part.

    Args:
        M: (n, S, S) of designs.
        at: (q,) the components.
        without: those that play no part.
    """
    others = np.setdiff1d(np.arange(M.shape[1]), np.concatenate([at, without]).astype(int))
    block, cross = M[:, others[:, None], others], M[:, others[:, None], at]
    scale = np.einsum("nii->ni", block)
    scale = np.where(scale > 0, 1.0 / np.sqrt(np.where(scale > 0, scale, 1.0)), 0.0)
    block = block * scale[:, :, None] * scale[:, None]
    # As in `calib.diagnosis.score`: a direction that rows leave open must not stop the elimination,
    # nor a component that no row feels.
    block += np.einsum(
        "ni,ij->nij", np.where(scale > 0, INFORMATION_ROUNDING, 1.0), np.eye(len(others))
    )
    cross = cross * scale[:, :, None]
    left = M[:, at[:, None], at] - cross.mT @ np.linalg.solve(block, cross)
    return (left + left.mT) / 2


def found_from(
    known: Information, of: np.ndarray, without: Sequence[int] | np.ndarray = (), looks: int = 1
) -> float:
    """The size of an effect from which it is found; see `smallest`.

    Args:
        known: what is known.
        of: (q,) the effect's components.
        without: those that play no part.
        looks: how many effects are looked for.
    """
    own = np.outer(known.unit[of], known.unit[of])
    left = information_left(_of_rows(known)[None], of, without)[0]
    return smallest(left / own, known.data[np.ix_(of, of)] / own, looks)


def smallest(left: np.ndarray, whole: np.ndarray, looks: int = 1) -> float:
    """The root mean square size of an effect's parameters at which it is found.

    With a power of 80 % at the level of a diagnosis, in the effect's unit, on average over the
    directions of its parameters; infinite where nothing tells it from what is in the model.

    Args:
        left: (q, q) its information that nothing else can take on.
        whole: (q, q) all of it.
        looks: how many effects are looked for.
    """
    size = np.sqrt(np.maximum(np.diag(whole), 1e-300))
    values = np.linalg.eigvalsh(left / np.outer(size, size))
    dof = int((values > 1e-6).sum())
    if not dof:
        return float("inf")
    limit = special.fdtri(dof, KNOWN, (1.0 - ALPHA_EFFECT) ** (1.0 / looks))
    return float(np.sqrt(enough(dof, KNOWN, limit) / (np.trace(left) / len(left))))


def indices(known: Information, at: np.ndarray, stops: int) -> dict[str, float]:
    """The observability indices O1 to O5 of a calibration; see `observability`.

    Args:
        known: what all stops say.
        at: (n,) the components of the calibration.
        stops: how many there are.
    """
    s = 1.0 / np.sqrt(np.linalg.eigvalsh(inverse(known.data + known.paper, at)))
    return {name: float(value) for name, value in observability(s, stops).items()}


def observability(s: np.ndarray, stops: int) -> dict[str, np.ndarray]:
    """The observability indices of robots, of designs (...).

    Of the singular values s of a calibration's Jacobian, all else eliminated, in units of what was
    known before, priors counted as rows (so that each s is at least about 1).

    O1 = (s_1 ... s_n)^(1/n) / sqrt(stops) (Borm and Menq 1989), O2 = s_n / s_1 (Driels and Pathre
    1990), O3 = s_n (Nahvi, Hollerbach and Hayward 1994), O4 = s_n^2 / s_1 (Nahvi and Hollerbach
    1996), O5 = 1 / (1/s_1 + ... + 1/s_n) (Sun and Hollerbach 2008).

    Args:
        s: (..., n).
        stops: how many there are.
    """
    least, most = s.min(axis=-1), s.max(axis=-1)
    return {
        "O1": np.exp(np.mean(np.log(s), axis=-1)) / np.sqrt(max(stops, 1)),
        "O2": least / most,
        "O3": least,
        "O4": least**2 / most,
        "O5": 1.0 / np.sum(1.0 / s, axis=-1),
    }


def chosen(
    criterion: Criterion,
    each: np.ndarray,
    count: int,
    tell: Callable[[int, int], None],
    exchange: bool = True,
) -> list[int]:
    """Which stops to measure, from what each of them says: the best one after another (greedy), and
    then each in turn against all others, as long as that gains (exchange: Fedorov 1972).

    Args:
        criterion: of the design.
        each: (n, S, S) information of each.
        count: how many.
        tell: called with how many are chosen, and of how many.
        exchange: whether to; without, the first are the best of fewer, too.
    """
    base, found = criterion.start.copy(), []
    for k in range(count):
        tell(k, count)
        value = criterion.each(base, each, each[found])
        value[found] = -np.inf
        found.append(int(np.argmax(value)))
        base += each[found[-1]]
    for _ in range(ROUNDS if exchange else 0):
        before = list(found)
        for i, old in enumerate(before):
            rest = base - each[old]
            value = criterion.each(rest, each, each[found[:i] + found[i + 1 :]])
            now = value[old]
            value[found] = -np.inf
            best = int(np.argmax(value))
            if value[best] > now + GAIN:
                found[i], base = best, rest + each[best]
        if found == before:
            break
    return found


ROUNDS = 3  # of exchange: in the designs of tests/bench/bench_plan.py a third changed nothing
GAIN = 1e-9  # of a criterion: less is rounding
