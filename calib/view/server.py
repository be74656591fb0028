"""The server that the page lives on. This is the viser door.

viser has no place for a guard, so the websockets server that it starts is given one: every request
passes it before viser sees anything. Should viser come to start its server in another way, the
guard would be missing; so one request without a key is sent first, and has to be refused.
"""

from __future__ import annotations

import contextlib
import dataclasses
import http
import http.client
import io
import json
import logging
from collections.abc import Callable, Iterator
from contextvars import ContextVar
from typing import Any

from calib.view.keys import Keys, Visit
from chains.errors import InputError

HOST = "127.0.0.1"  # this machine alone
ANSWER_WITHIN_S = 10.0  # a choice: a server of the same machine answers at once, or is none
REFUSED = "Open the workbench by the whole address that `rigcal view` printed: it holds a key.\n"
# viser's page is one file, whose scripts and styles lie in it and are unpacked there. It may talk
# to this server and to nobody else.
POLICY = (
    "default-src 'none'; script-src 'unsafe-inline' 'unsafe-eval' blob:; worker-src blob:; "
    "style-src 'unsafe-inline'; img-src data: blob:; font-src data:; "
    "connect-src {here} data: blob:; frame-ancestors 'none'; base-uri 'none'; form-action 'none'"
)
PAGE = "/"  # all that viser serves but the websocket, whatever stands after the key
# Of the connection that a message came by; viser's callbacks run in its context.
_visit_here: ContextVar[Visit | None] = ContextVar("visit", default=None)
READDRESS = 'history.replaceState(null, "", "/" + location.pathname.split("/")[1] + "/" + ASKS)'
NOBODY = Visit(may_change=False)


class Visitor:
    """A browser that has come.

    Args:
        client: viser's.
        visit: how it was let in.
    """

    def __init__(self, client: Any, visit: Visit) -> None:
        self.client, self.may_change, self.asks = client, visit.may_change, visit.asks

    def readdress(self, asks: str) -> None:
        """Have its address ask for something else, behind the same key, and load nothing."""
        self.run(READDRESS.replace("ASKS", json.dumps(asks)))

    def run(self, script: str) -> None:
        """Run a script in it."""
        from viser import _messages  # viser has no public way to do this

        self.client._websock_connection.queue_message(_messages.RunJavascriptMessage(script))


class Served:
    """A viser server behind keys.

    Args:
        server: viser's.
        keys: those of its addresses.
    """

    def __init__(self, server: Any, keys: Keys) -> None:
        self.server, self.keys = server, keys
        self._visits: dict[int, Visit] = {}  # by client
        server.request_share_url = _refuse

        @server.on_client_connect
        async def remember(client: Any) -> None:
            self._visits[client.client_id] = _visit_here.get() or NOBODY

    @property
    def address(self) -> str:
        """Where a browser finds it, with the key to everything."""
        return self._under(self.keys.change)

    @property
    def look_address(self) -> str:
        """Where a browser can look but not change anything."""
        return self._under(self.keys.look)

    def welcome(self, arrive: Callable[[Visitor], None], leave: Callable[[Any], None]) -> None:
        """Have every browser that comes, or is there, told of; and viser's client of every one that
        goes."""

        def came(client: Any) -> None:
            arrive(Visitor(client, self._visits.get(client.client_id, NOBODY)))

        def went(client: Any) -> None:
            self._visits.pop(client.client_id, None)
            leave(client)

        self.server.on_client_disconnect(went)
        self.server.on_client_connect(came)

    def stop(self) -> None:
        """End it."""
        with contextlib.redirect_stdout(io.StringIO()):
            self.server.stop()

    def _under(self, key: str) -> str:
        return f"http://{HOST}:{self.server.get_port()}/{key}/"


def serve(port: int) -> Served:
    """A viser server on this machine alone; port 0 is any free one.

    Raises:
        InputError: viser is not installed or cannot be guarded, or the port is taken.
    """
    try:
        import viser
    except ImportError:
        raise InputError("'rigcal view' needs viser; pip install 'rigcal[view]'") from None
    keys = Keys()
    # viser greets on stdout, which is the caller's.
    with contextlib.redirect_stdout(io.StringIO()), _guarded(keys):
        served = Served(viser.ViserServer(HOST, port, label="rigcal", verbose=False), keys)
    found = served.server.get_port()
    if port and found != port:  # it takes the next one
        served.stop()
        raise InputError(f"--port {port} is taken; give another one, or none for any that is free")
    if not _refuses(found):
        served.stop()
        raise InputError(
            f"'rigcal view' cannot guard viser {viser.__version__}: it lets in who has no key; "
            "install an earlier version of viser"
        )
    return served


@contextlib.contextmanager
def _guarded(keys: Keys) -> Iterator[None]:
    """While this lasts, a websockets server that is started asks for keys."""
    import websockets.asyncio.server as websockets

    start, quiet = websockets.serve, logging.getLogger("rigcal.view.websockets")
    quiet.addHandler(logging.NullHandler())
    quiet.propagate = False  # what strangers send is no fault of ours, and no traceback

    def serve_guarded(handle: Any, *args: Any, process_request: Any = None, **options: Any) -> Any:
        def admit(connection: Any, request: Any) -> Any:
            visit = _visit(keys, request)
            if visit is None:
                return connection.respond(http.HTTPStatus.FORBIDDEN, REFUSED)
            answer = process_request(connection, dataclasses.replace(request, path=PAGE))
            if answer is not None:
                _restrict(answer.headers, request.headers["Host"])
            return answer

        async def enter(connection: Any) -> None:
            _visit_here.set(_visit(keys, connection.request))
            await handle(connection)

        return start(enter, *args, process_request=admit, **options | {"logger": quiet})

    websockets.serve = serve_guarded
    try:
        yield
    finally:
        websockets.serve = start


def _visit(keys: Keys, request: Any) -> Visit | None:
    hosts, origins = (request.headers.get_all(name) for name in ("Host", "Origin"))
    return keys.visit(request.path, hosts, origins, "Upgrade" in request.headers)


def _restrict(headers: Any, host: str) -> None:
    """Tell the browser what the page may load, and to keep its address to itself."""
    headers["Content-Security-Policy"] = POLICY.format(here=f"http://{host} ws://{host}")
    headers["Referrer-Policy"] = "no-referrer"
    headers["X-Content-Type-Options"] = "nosniff"
    headers["X-Frame-Options"] = "DENY"
    headers["Cache-Control"] = "no-store"


def _refuses(port: int) -> bool:
    """Whether a request without a key is refused."""
    connection = http.client.HTTPConnection(HOST, port, timeout=ANSWER_WITHIN_S)
    try:
        connection.request("GET", "/")
        return connection.getresponse().status == http.HTTPStatus.FORBIDDEN
    finally:
        connection.close()


def _refuse(*_: Any, **__: Any) -> None:
    """In the place of viser's tunnel to the outside, which any page could ask it to open."""
