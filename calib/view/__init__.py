"""The browser workbench: ``rigcal view``."""

from __future__ import annotations

import os
import signal
import sys
import threading
import webbrowser
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from calib.view.bench import Bench
    from calib.view.page import Page
    from calib.view.server import Served, Visitor


def view(
    runs: Sequence[Path | str],
    port: int = 0,
    show: bool = True,
    tell: Callable[[str, str], None] = lambda url, look_url: None,
    trust: Iterable[str | Path] = (),
) -> None:
    """Serve the workbench on this machine alone, until Ctrl-C.

    Args:
        runs: run folders; those that they grew from come along.
        port: where; 0 is any that is free.
        show: whether to open it in a browser, where there is one.
        tell: called with two addresses as soon as they are served: one that may do everything,
            and one that may only look. Each holds a key; without one, nothing is served.
        trust: Python files of effects that the runs' models may name, or their sha256.

    Raises:
        InputError: no run can be opened, viser is not installed, or the port is taken.
    """
    from calib.effects import trusted
    from calib.view.bench import Bench
    from calib.view.desk import Desk
    from calib.view.server import serve

    bench = Bench(Desk.of(runs, trusted(trust)))
    served = serve(port)
    try:
        with _interruption() as interrupted:
            tell(served.address, served.look_address)
            if show and _has_display():
                webbrowser.open(served.address)  # False where there is none; it is told anyway
            attend(served, bench)
            interrupted.wait()
    finally:
        bench.stop()
        served.stop()


@contextmanager
def _interruption() -> Iterator[threading.Event]:
    """Ctrl-C as an event: an exception in the midst of an import can be lost in what is imported.

    Outside the main thread, which alone hears of Ctrl-C, nothing sets it.
    """
    event = threading.Event()
    if threading.current_thread() is not threading.main_thread():
        yield event
        return
    before = signal.signal(signal.SIGINT, lambda *_: event.set())
    try:
        yield event
    finally:
        signal.signal(signal.SIGINT, before)


def attend(served: Served, bench: Bench) -> dict[int, Page]:
    """Give every browser that comes a page of its own; the pages that are open, by client."""
    from calib.view.page import Page  # much to load, while the browser starts

    pages: dict[int, Page] = {}

    def arrive(visitor: Visitor) -> None:
        number = visitor.client.client_id
        page = pages[number] = Page(visitor, bench)
        page.open()
        if number not in pages:  # it left meanwhile
            page.close()

    def leave(client: Any) -> None:
        page = pages.pop(client.client_id, None)
        if page is not None:
            page.close()

    served.welcome(arrive, leave)
    return pages


def _has_display() -> bool:
    """Whether a window can be opened; without one, a browser in the terminal would take that."""
    if sys.platform in ("darwin", "win32"):
        return True
    return bool(os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY"))
