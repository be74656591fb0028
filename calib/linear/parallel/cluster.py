"""Workers of a Dask cluster that runs already; the one door to `distributed`."""

from __future__ import annotations

import importlib.metadata
import warnings
from typing import Any

from calib.linear.parallel.crew import WorkerGoneError, serve
from chains.errors import InputError

SECONDS_TO_ANSWER = 20  # a choice: of a scheduler


class ClusterLine:
    """The way to one thread of a worker, or to whoever takes its place.

    Args:
        client: of the cluster.
        address: of the worker.
    """

    def __init__(self, client: Any, address: str) -> None:
        self.client, self.address, self.name = client, address, f"the worker {address}"

    def ask(self, message: bytes) -> bytes:
        """Its answer to a message. Where it ends, Dask sends the message to another, which says
        what it lacks."""
        from distributed import CancelledError, KilledWorker, TimeoutError

        how = {"workers": [self.address], "allow_other_workers": True, "pure": False}
        try:
            with warnings.catch_warnings():  # a mesh in a message is large, and is sent once
                warnings.simplefilter("ignore", UserWarning)
                future = self.client.submit(serve, message, **how)
            return future.result()
        except (KilledWorker, CancelledError, TimeoutError, OSError) as error:
            raise WorkerGoneError(f"ended ({type(error).__name__})") from None

    def renew(self) -> None:
        """Leave it to Dask who takes its place."""

    def close(self) -> None:
        """Leave the cluster as it was."""
        self.client.close()


def cluster_lines(scheduler: str) -> list[ClusterLine]:
    """A line to every thread of every worker of a cluster.

    Raises:
        InputError: `distributed` is not installed, no scheduler answers, it has no workers, or
            these have another rigcal.
    """
    try:
        from distributed import Client
    except ImportError:
        raise InputError(
            "--scheduler needs distributed, which is not installed; pip install 'rigcal[cluster]'"
        ) from None
    try:
        client = Client(scheduler, timeout=SECONDS_TO_ANSWER, set_as_default=False)
    except (OSError, ValueError) as error:
        raise InputError(
            f"--scheduler {scheduler}: no Dask scheduler answers there ({error}); give the address "
            "that 'dask scheduler' prints, as in tcp://127.0.0.1:8786"
        ) from None
    try:
        _check_versions(client, scheduler)
        threads = client.nthreads()
    except BaseException:
        client.close()
        raise
    return [ClusterLine(client, at) for at in sorted(threads) for _ in range(threads[at])]


def _version() -> str:
    return importlib.metadata.version("rigcal")


def _check_versions(client: Any, scheduler: str) -> None:
    """Refuse a cluster that cannot do what is asked, before anything is."""
    found = client.run(_version, on_error="return")
    if not found:
        raise InputError(f"--scheduler {scheduler}: the cluster has no workers; start some")
    mine = _version()
    for address, theirs in sorted(found.items()):
        if theirs != mine:
            said = theirs if isinstance(theirs, str) else f"none ({type(theirs).__name__})"
            raise InputError(
                f"--scheduler {scheduler}: rigcal is {mine} here and {said} on the worker "
                f"{address}; install the same on both"
            )
