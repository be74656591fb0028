"""Work side by side: results come in order, whoever does it and however many they are.

`over_stops` is for what is asked of each scan: on threads, in processes of this machine
(`processes`) or on a Dask cluster (`cluster`), as `executing` says. What it calls is a function of
a module, or a `partial` of one, so that it can be sent (`parcels`). `in_order` is for closures over
what lies here: on threads always.
"""

from __future__ import annotations

import os
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from contextvars import ContextVar
from functools import wraps
from typing import TYPE_CHECKING, Any, ParamSpec, TypeVar

from chains.errors import InputError

if TYPE_CHECKING:
    from calib.linear.parallel.crew import Crew

P, T = ParamSpec("P"), TypeVar("T")
_WORKERS: ContextVar[int | None] = ContextVar("workers", default=None)
_CREW: ContextVar[Crew | None] = ContextVar("crew", default=None)


def one_blas_thread(function: Callable[P, T]) -> Callable[P, T]:
    """The function, with every call of BLAS on one thread while it runs.

    The last digits of a product depend on the number of threads that share it; and on cores that
    stops keep busy already they cost many times what they save.
    """

    @wraps(function)
    def limited(*args: P.args, **kwargs: P.kwargs) -> T:
        from threadpoolctl import threadpool_limits

        with threadpool_limits(limits=1):
            return function(*args, **kwargs)

    return limited


@contextmanager
def workers(count: int | None) -> Iterator[None]:
    """Use so many threads within; all cores where None."""
    token = _WORKERS.set(count)
    try:
        yield
    finally:
        _WORKERS.reset(token)


@contextmanager
def executing(count: int | None = None, scheduler: str | None = None) -> Iterator[Crew | None]:
    """Ask stops of so many processes within, or of the workers of a Dask cluster; of threads on all
    cores where neither is given, and of this thread alone for a count of 1. Where a worker ends,
    another goes on with its stops, and the log of `rigcal` says so.

    Args:
        count: how many processes.
        scheduler: address of a Dask scheduler.

    Raises:
        InputError: both are given, or the cluster cannot do it.
    """
    if scheduler is not None and count is not None:
        raise InputError("--scheduler and --workers: give one; a cluster has workers of its own")
    if scheduler is None and (count or 1) == 1:
        with workers(count or _WORKERS.get()):
            yield None
        return
    from calib.linear.parallel.crew import Crew

    crew = Crew(_lines(count or 0, scheduler))
    token = _CREW.set(crew)
    try:
        with workers(count):
            yield crew
    finally:
        _CREW.reset(token)
        crew.close()


def _lines(count: int, scheduler: str | None) -> Sequence[Any]:
    if scheduler is None:
        from calib.linear.parallel.processes import ProcessLine

        return [ProcessLine(f"worker {k} of {count}") for k in range(1, count + 1)]
    from calib.linear.parallel.cluster import cluster_lines

    return cluster_lines(scheduler)


def over_stops(work: Callable[..., T], scans: Sequence[Any], *each: Sequence[Any]) -> Iterator[T]:
    """``work(scan, …)`` of every scan, in their order.

    Args:
        work: a function of a module, or a partial of one; what it is given but the scan is the same
            for all.
        scans: of the stops.
        each: further arguments of `work`, of each scan its own.
    """
    crew = _CREW.get()
    if crew is not None and len(scans) > 1:
        return crew.over(work, scans, each)
    return in_order(lambda i: work(scans[i], *(some[i] for some in each)), len(scans))


def cores() -> int:
    """How many cores this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def in_order(work: Callable[[int], T], count: int) -> Iterator[T]:
    """``work(0), work(1), …`` in this order, at most two per thread ahead of who takes them.

    The first is done before there are threads: what all share and compute when first asked (the ray
    caster, the surfaces of a mesh, the compiled loops) is there when they start.
    """
    threads = min(_WORKERS.get() or cores(), count)
    if threads < 2:
        yield from (work(i) for i in range(count))
        return
    yield work(0)
    with ThreadPoolExecutor(threads) as pool:
        waiting = deque(pool.submit(work, i) for i in range(1, min(2 * threads + 1, count)))
        try:
            for i in range(1 + len(waiting), count + len(waiting)):
                found = waiting.popleft().result()
                if i < count:
                    waiting.append(pool.submit(work, i))
                yield found
        finally:
            for future in waiting:
                future.cancel()
