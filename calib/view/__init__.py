"""The browser workbench: ``rigcal view``."""

from __future__ import annotations

import os
import sys
import time
import webbrowser
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path


def view(
    runs: Sequence[Path | str],
    port: int = 0,
    show: bool = True,
    tell: Callable[[str], None] = lambda url: None,
    trust: Iterable[str | Path] = (),
) -> None:
    """Serve the workbench on this machine alone, until Ctrl-C.

    Args:
        runs: run folders; those that they grew from come along.
        port: where; 0 is any that is free.
        show: whether to open it in a browser, where there is one.
        tell: called with the address as soon as it is served.
        trust: Python files of effects that the runs' models may name, or their sha256.

    Raises:
        InputError: no run can be opened, viser is not installed, or the port is taken.
    """
    from calib.effects import trusted
    from calib.view.desk import Desk
    from calib.view.server import address, serve, stop

    desk = Desk.of(runs, trusted(trust))
    server = serve(port)
    page = None
    try:
        tell(address(server))
        if show and _has_display():
            webbrowser.open(
                address(server)
            )  # False where there is none; the address is told anyway
        from calib.view.page import Page  # much to load, while the browser starts

        page = Page(server, desk)
        page.open()
        while True:
            time.sleep(3600)
    except KeyboardInterrupt:
        pass
    finally:
        if page is not None:
            page.close()
        stop(server)


def _has_display() -> bool:
    """Whether a window can be opened; without one, a browser in the terminal would take that."""
    if sys.platform in ("darwin", "win32"):
        return True
    return bool(os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY"))
