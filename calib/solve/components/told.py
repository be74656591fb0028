"""What all rows say of values that chance draws anew."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import pairwise

import numpy as np

from calib.linear.elimination import inverse_and_log_det
from calib.linear.symmetric import pinv
from calib.problem.spread import spread_keys
from calib.problem.unknowns import Unknown

PRECISE = {"ftol": 1e-15, "gtol": 1e-7}  # of twice a log-likelihood: sds to some 1e-6 of theirs
LEAST_SD = 1e-3  # of the sd that a group starts from: what is smaller counts as none
LARGEST_SD = 1e6  # times that: far from an optimum scores are of any size, and squares overflow
DIRECTION_SEEN = 1e-9  # of the largest information, below which a direction of values is not seen


@dataclass(frozen=True)
class Told:
    """What all rows but their priors say of values by chance (Q,), or of such values at each of
    some stops that tell nothing of each other.

    Args:
        score: (..., Q) at zero, all else being estimated there.
        information: (..., Q, Q), all else being estimated.
        group: (Q,) which group each belongs to, from 0.
    """

    score: np.ndarray
    information: np.ndarray
    group: np.ndarray

    @classmethod
    def fitted(
        cls, values: np.ndarray, covariance: np.ndarray, variance: np.ndarray, group: np.ndarray
    ) -> Told:
        """From the values (Q,) as fitted, their covariance (Q, Q) and the variances (Q,) that they
        were held by; the group (Q,) of each is a number from 0."""
        root = np.sqrt(variance)
        scaled = np.linalg.inv(covariance / np.outer(root, root))
        information = (scaled - np.eye(len(values))) / np.outer(root, root)
        score = (scaled @ (values / root)) / root
        return cls(score, (information + information.T) / 2, group)

    def about_means(self, of_each: Iterable[slice]) -> Told:
        """The same of how far some values, those of each unknown, are from their mean, of which
        nothing is known: that belongs to what they have in common, as the range zero of a LiDAR,
        however little its prior allows. A single value has no mean beside itself."""
        out = self
        for which in of_each:
            out = out._about_mean(which) if which.stop - which.start > 1 else out
        return out

    def _about_mean(self, which: slice) -> Told:
        of_mean = self.information[:, which].sum(axis=1)
        seen = float(of_mean[which].sum())
        if seen <= DIRECTION_SEEN * float(np.trace(self.information)):
            return self
        score = self.score - of_mean * (self.score[which].sum() / seen)
        information = self.information - np.outer(of_mean, of_mean) / seen
        return replace(self, score=score, information=information)

    def of_noisier(self, times: float) -> Told:
        """The same of rows that scatter so many times as widely as their sigmas say."""
        return replace(self, score=self.score / times**2, information=self.information / times**2)

    def spread(self, start: np.ndarray, earlier: Sequence[tuple[float, float]] = ()) -> np.ndarray:
        """The sd (G,) of each group.

        Args:
            start: (G,) sd to start from.
            earlier: (G,) what other rows say of each, and the sigma of that; of sigma 0, nothing.
                They count as so many values as have that sigma.
        """
        if not earlier:
            return _likeliest(self.unlikely, start)
        sd, sigma = np.array(earlier).T
        dof = np.divide(sd**2, 2.0 * sigma**2, out=np.zeros(len(sd)), where=sigma > 0)

        def unlikely(log_variance: np.ndarray) -> tuple[float, np.ndarray]:
            value, slope = self.unlikely(log_variance)
            ratio = sd**2 / np.exp(log_variance)
            return value + float(dof @ (log_variance + ratio)), slope + dof * (1.0 - ratio)

        return _likeliest(unlikely, start)

    def unlikely(self, log_variance: np.ndarray) -> tuple[float, np.ndarray]:
        """Minus the restricted log-likelihood, twice, and its derivative (G,) by the logs of the
        variances: nought where the squares of the values are as many variances as all rows tell of
        (MacKay 1992)."""
        variance = np.exp(log_variance)
        values, covariance, log_det = self.given(variance)
        known = np.diagonal(covariance, axis1=-2, axis2=-1)
        seen = 1.0 - (known + np.square(values)) / variance[self.group]
        slope = np.bincount(self.group, _summed(seen), minlength=len(variance))
        of_values = float(np.vdot(self._by_themselves, values / variance[self.group]))
        return log_det + of_values, slope

    @cached_property
    def _by_themselves(self) -> np.ndarray:
        """The values (..., Q) as all rows have them that know of no spread: with u as they are
        given one, ``g^T (M + M D M)^-1 g`` is this times ``D^-1 u``, without a difference of large
        numbers."""
        inverse = pinv(self.information, DIRECTION_SEEN)
        return (inverse @ self.score[..., None])[..., 0]

    def of(self, *groups: int) -> Told:
        """Of one group, or of some, all others being 0; numbered from 0 as they are given."""
        at = np.flatnonzero(np.isin(self.group, groups))
        number = np.array([groups.index(group) for group in self.group[at].tolist()], int)
        return Told(self.score[..., at], self.information[..., at[:, None], at], number)

    def statistic(self, sd: np.ndarray) -> float:
        """Twice the log of the likelihood ratio of the sds (G,) against none."""
        most = float(np.vdot(self.score, self._by_themselves))
        return most - self.unlikely(2.0 * np.log(sd))[0]

    def given(self, variance: np.ndarray) -> tuple[np.ndarray, np.ndarray, float]:
        """The values (..., Q) and their covariance, given the variances of the groups; and by how
        much the log of the determinant of what is told of them grows, of all stops together."""
        root = np.sqrt(variance)[self.group]
        inner = np.eye(len(root)) + root[:, None] * self.information * root
        of_inner, log_det = inverse_and_log_det(inner)
        covariance = root[:, None] * of_inner * root
        values = (covariance @ self.score[..., None])[..., 0]
        return values, covariance, float(np.sum(log_det))

    def sigma(self, sd: np.ndarray) -> np.ndarray:
        """Of the sds (G,), from the expected information of the variances: ``tr(P E_i P E_j) / 2``
        with ``P = M - M C M``; of one that is no more than that, the sd of such a variance."""
        return _sigma(sd, self.of_variances(sd))

    def of_variances(self, sd: np.ndarray) -> np.ndarray:
        """Expected information (G, G) of the variances at these sds (G,)."""
        _, covariance, _ = self.given(np.square(sd))
        P = self.information - self.information @ covariance @ self.information
        sums = np.zeros((len(sd), len(sd)))
        np.add.at(sums, (self.group[:, None], self.group), _summed(np.square(P), axes=2) / 2)
        return sums


@dataclass(frozen=True)
class ToldApart:
    """The same of values in parts between which next to nothing goes together.

    Args:
        parts: what is told of each; their groups are the same.
    """

    parts: Sequence[Told]

    @classmethod
    def at_stops(cls, some: Sequence[Told]) -> ToldApart:
        """Of values (Q,) at each of some stops: those of the same groups are one part."""
        alike: dict[bytes, list[Told]] = {}
        for each in some:
            alike.setdefault(each.group.tobytes(), []).append(each)
        parts = (
            Told(
                np.stack([one.score for one in each]),
                np.stack([one.information for one in each]),
                each[0].group,
            )
            for each in alike.values()
        )
        return cls(list(parts))

    def of(self, *groups: int) -> ToldApart:
        """As of `Told`."""
        return ToldApart([part.of(*groups) for part in self.parts])

    def spread(self, start: np.ndarray, least: np.ndarray | None = None) -> np.ndarray:
        """As of `Told`; the sds (G,) are no less than some, or than next to nothing."""

        def unlikely(log_variance: np.ndarray) -> tuple[float, np.ndarray]:
            values, slopes = zip(*(part.unlikely(log_variance) for part in self.parts), strict=True)
            return sum(values), np.sum(slopes, axis=0)

        return _likeliest(unlikely, start, least)

    def statistic(self, sd: np.ndarray) -> float:
        """As of `Told`."""
        return sum(part.statistic(sd) for part in self.parts)

    def sigma(self, sd: np.ndarray) -> np.ndarray:
        """As of `Told`."""
        return _sigma(sd, np.sum([part.of_variances(sd) for part in self.parts], axis=0))


def _summed(values: np.ndarray, axes: int = 1) -> np.ndarray:
    """Over all stops: over all but the last axes."""
    return values.sum(axis=tuple(range(values.ndim - axes)))


def _likeliest(
    unlikely: Callable[[np.ndarray], tuple[float, np.ndarray]],
    start: np.ndarray,
    least: np.ndarray | None = None,
) -> np.ndarray:
    """The sd (G,) of each group, from a start (G,); no less than `least` (G,)."""
    from scipy.optimize import minimize  # late: it loads much, and most fits need none

    lowest = 2.0 * np.log(LEAST_SD * start if least is None else least)
    first = 2.0 * np.log(start)
    most = first + 2.0 * np.log(LARGEST_SD)

    def at(log_variance: np.ndarray) -> tuple[float, np.ndarray]:
        return unlikely(np.minimum(log_variance, most))

    # With bounds above as well, the first step would be as long as the slope.
    best = minimize(
        at,
        first,
        jac=True,
        method="L-BFGS-B",
        bounds=[(low, None) for low in lowest],
        options=PRECISE,
    )
    return np.exp(np.minimum(best.x, most) / 2.0)


def _sigma(sd: np.ndarray, of_variances: np.ndarray) -> np.ndarray:
    """Of sds (G,), from the information (G, G) of their variances."""
    scale = np.sqrt(np.maximum(np.diag(of_variances), 1e-300))
    inverse = pinv(of_variances / np.outer(scale, scale)) / np.outer(scale, scale)
    of_variance = np.sqrt(np.maximum(np.diag(inverse), 0.0))
    beyond = np.sqrt(np.square(sd) + of_variance) - sd
    return np.where(of_variance < 2 * np.square(sd), of_variance / (2 * sd), beyond)


def told(some: Sequence[Unknown], values: Mapping[str, np.ndarray], covariance: np.ndarray) -> Told:
    """What all rows say of some unknowns by chance; `covariance` is their joint one, as fitted.
    Ranges count about their mean; of poses, priors of frames say where that is."""
    out = Told.fitted(
        np.concatenate([values[u.name] for u in some]),
        covariance,
        np.square(np.concatenate([u.sigma for u in some])),
        groups(some),
    )
    pairs = zip(some, slices(u.dim for u in some), strict=True)
    return out.about_means(which for u, which in pairs if len(spread_keys(u)) == 1)


def slices(sizes: Iterable[int]) -> list[slice]:
    """Where the values of each of some unknowns of these sizes stand among those of all."""
    ends = np.cumsum([0, *sizes]).tolist()
    return [slice(*each) for each in pairwise(ends)]


def groups(some: Sequence[Unknown]) -> np.ndarray:
    """Which spread (Q,) each value of some unknowns by chance has, in the order of their keys."""
    out, count = [], 0
    for unknown in some:
        of = np.zeros(unknown.dim, int)
        for at in spread_keys(unknown).values():
            of[at] = count
            count += 1
        out.append(of)
    return np.concatenate(out)


def sds(some: Sequence[Unknown]) -> dict[str, float]:
    """Key of each spread of some unknowns by chance -> what it is."""
    return {key: float(u.sigma[at[0]]) for u in some for key, at in spread_keys(u).items()}
