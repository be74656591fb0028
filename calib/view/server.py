"""The server that the page lives on. This is the viser door."""

from __future__ import annotations

import contextlib
import io
from typing import Any

from chains.errors import InputError

HOST = "127.0.0.1"  # this machine alone


def serve(port: int) -> Any:
    """A viser server on this machine alone; port 0 is any free one.

    Raises:
        InputError: viser is not installed, or the port is taken.
    """
    try:
        import viser
    except ImportError:
        raise InputError("'rigcal view' needs viser; pip install 'rigcal[view]'") from None
    with contextlib.redirect_stdout(io.StringIO()):  # it greets on stdout, which is the caller's
        server = viser.ViserServer(HOST, port, label="rigcal", verbose=False)
    server.request_share_url = _refuse
    if port and server.get_port() != port:  # it takes the next one
        stop(server)
        raise InputError(f"--port {port} is taken; give another one, or none for any that is free")
    return server


def _refuse(*_: Any, **__: Any) -> None:
    """In the place of viser's tunnel to the outside, which any page could ask it to open."""


def address(server: Any) -> str:
    """Where a browser finds it."""
    return f"http://{HOST}:{server.get_port()}"


def stop(server: Any) -> None:
    """End a server."""
    with contextlib.redirect_stdout(io.StringIO()):
        server.stop()
