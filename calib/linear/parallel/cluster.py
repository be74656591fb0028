"""Workers of a Dask cluster that runs already; the one door to `distributed`."""

from __future__ import annotations

import importlib.metadata
import logging
import warnings
from threading import Lock
from time import sleep
from typing import Any

from calib.linear.parallel.crew import WorkerGoneError, serve
from chains.errors import CutShortError, InputError

SECONDS_TO_ANSWER = 20  # a choice: of a scheduler
SECONDS_TO_WAIT = 5  # a choice: for an answer, before it is asked whether there are still workers

SECONDS_BETWEEN = 0.2  # a choice: between looks whether a scheduler is back

_LOG = logging.getLogger("rigcal")


class Cluster:
    """A cluster as its client sees it, and what was said of it.

    Args:
        client: of the cluster.
        scheduler: its address.
    """

    def __init__(self, client: Any, scheduler: str) -> None:
        self.client, self.scheduler = client, scheduler
        self.deserted, self._lock = False, Lock()

    def check(self) -> None:
        """Say when no worker is left, and when one is back.

        Raises:
            CutShortError: the scheduler has ended.
        """
        while self.client.status == "connecting":  # until it is back, or Dask gives up
            sleep(SECONDS_BETWEEN)
        if self.client.status != "running":
            raise CutShortError(f"--scheduler {self.scheduler}: the scheduler has ended")
        try:
            deserted = not self.client.nthreads()
        except Exception:  # whatever Dask raises where a connection breaks; the next ask sees it
            return
        with self._lock:
            changed, self.deserted = deserted != self.deserted, deserted
        if changed:
            state = "no worker is left; it goes on when one is" if deserted else "goes on"
            _LOG.warning("the cluster at %s: %s", self.scheduler, state)


class ClusterLine:
    """The way to one thread of a worker, or to whoever takes its place.

    Args:
        cluster: of the worker.
        address: of the worker.
    """

    def __init__(self, cluster: Cluster, address: str) -> None:
        self.cluster, self.address, self.name = cluster, address, f"the worker {address}"

    def ask(self, message: bytes) -> bytes:
        """Its answer to a message. Where it ends, Dask sends the message to another, which says
        what it lacks.

        Raises:
            CutShortError: the scheduler has ended.
        """
        from distributed import CancelledError, KilledWorker, TimeoutError
        from distributed.client import ClosedClientError

        how = {"workers": [self.address], "allow_other_workers": True, "pure": False}
        try:
            with warnings.catch_warnings():  # a mesh in a message is large, and is sent once
                warnings.simplefilter("ignore", UserWarning)
                future = self.cluster.client.submit(serve, message, **how)
            while True:
                try:
                    found = future.result(timeout=SECONDS_TO_WAIT)
                except TimeoutError:
                    self.cluster.check()
                    continue
                if self.cluster.deserted:
                    self.cluster.check()
                return found
        except (KilledWorker, CancelledError, ClosedClientError, OSError) as error:
            self.cluster.check()
            raise WorkerGoneError(f"ended ({type(error).__name__})") from None

    def renew(self) -> None:
        """Leave it to Dask who takes its place."""

    def close(self) -> None:
        """Leave the cluster as it was."""
        self.cluster.client.close()


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
    logging.getLogger("distributed.client").setLevel(logging.CRITICAL)  # what it raises is told
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
    cluster = Cluster(client, scheduler)
    return [ClusterLine(cluster, at) for at in sorted(threads) for _ in range(threads[at])]


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
