"""Work over stops, side by side: results come in order, whatever the number of threads."""

from __future__ import annotations

import os
from collections import deque
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from contextvars import ContextVar
from functools import wraps
from typing import ParamSpec, TypeVar

P, T = ParamSpec("P"), TypeVar("T")
_WORKERS: ContextVar[int | None] = ContextVar("workers", default=None)


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
