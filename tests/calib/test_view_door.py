"""Who gets into the workbench: raw requests as strangers, other pages and browsers send them."""

import base64
import json
import shutil
import socket
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from urllib.parse import urlsplit

import pytest

from calib.runs.run import Run
from calib.view import attend
from calib.view.bench import Bench
from calib.view.desk import Desk
from calib.view.keys import Keys
from calib.view.server import Served, serve
from chains.errors import InputError
from tests.calib.viewed import diagnosed, small_run

viser = pytest.importorskip("viser")
SOON_S = 30


@pytest.fixture(scope="module")
def served() -> Iterator[Served]:
    served = serve(0)
    yield served
    served.stop()


def answer(served: Served, path: str, upgrade: bool = False, **headers: str | None) -> str:
    """Status line and headers of a request; None takes a header away, `_` in a name is `-`."""
    port = served.server.get_port()
    here = f"127.0.0.1:{port}"
    given = {"Host": here}
    if upgrade:
        given |= {
            "Origin": f"http://{here}",
            "Upgrade": "websocket",
            "Connection": "Upgrade",
            "Sec-WebSocket-Key": base64.b64encode(bytes(16)).decode(),
            "Sec-WebSocket-Version": "13",
            "Sec-WebSocket-Protocol": f"viser-v{viser.__version__}",
        }
    given |= {name.replace("_", "-"): value for name, value in headers.items()}
    lines = [f"{name}: {value.format(here=here)}" for name, value in given.items() if value]
    with socket.create_connection(("127.0.0.1", port), timeout=SOON_S) as stranger:
        stranger.sendall("\r\n".join([f"GET {path} HTTP/1.1", *lines, "", ""]).encode("latin-1"))
        text = b""
        while b"\r\n\r\n" not in text and (part := stranger.recv(4096)):
            text += part
    return text.partition(b"\r\n\r\n")[0].decode("latin-1")


def status(*request: object, **headers: str | None) -> int:
    return int((answer(*request, **headers) or "- 0").split()[1])


@pytest.mark.parametrize("upgrade", [False, True])
def test_the_key_opens_and_nothing_else_does(served, upgrade):
    good = 101 if upgrade else 200
    change, look = served.keys.change, served.keys.look
    for path in (
        f"/{change}/",
        f"/{change}",
        f"/{look}/",
        f"/{change}/?x=1",
        f"/{look}/stop=a%2Fb",
    ):
        assert status(served, path, upgrade) == good, path
    wrong = (
        "/",
        "",
        change[:-1],
        f"{change}x",
        change.swapcase(),
        f"x/{change}",
        f"?token={change}",
    )
    for path in ("/index.html", "//", f"//{change}/", "/\xff/", *(f"/{each}" for each in wrong)):
        assert status(served, path, upgrade) in (400, 403), path


@pytest.mark.parametrize("upgrade", [False, True])
@pytest.mark.parametrize(
    "host, let_in",
    [
        ("localhost", True),  # a tunnel may end at another port
        ("localhost:9000", True),
        ("evil.example", False),  # a name that was made to point at this machine
        ("127.0.0.1.evil.example:80", False),
        ("127.0.0.1@evil.example", False),
        ("evil.example@127.0.0.1", False),
        ("0.0.0.0", False),
        ("127.0.0.1, evil.example", False),
        ("127.0.0.1/x", False),
        (None, False),
    ],
)
def test_only_a_host_that_is_this_machine_is_let_in(served, upgrade, host, let_in):
    origin = f"http://{host}" if upgrade else None
    found = status(served, f"/{served.keys.change}/", upgrade, Host=host, Origin=origin)
    assert found == ((101 if upgrade else 200) if let_in else 403)


@pytest.mark.parametrize(
    "origin",
    [
        *("https://evil.example", "http://evil.example", "null", "http://localhost:3000"),
        *("https://{here}", "http://127.0.0.1", "http://{here}.evil.example", None),
    ],
)
def test_a_foreign_page_that_has_the_key_is_refused(served, origin):
    """`None`: a browser always says where a websocket comes from."""
    for key in (served.keys.change, served.keys.look):
        assert status(served, f"/{key}/", True, Origin=origin) == 403
    if origin:
        assert status(served, f"/{served.keys.change}/", Origin=origin) == 403


def test_headers_given_twice_are_refused():
    keys = Keys()
    host, origin = "localhost:1", "http://localhost:1"
    visit = keys.visit(f"/{keys.look}/a?b", [host], [origin], True)
    assert visit.asks == "a" and not visit.may_change
    assert keys.visit(f"/{keys.look}/", [host, "evil"], [], False) is None
    assert keys.visit(f"/{keys.look}/", [host], [origin, "http://evil"], True) is None


def test_the_page_tells_the_browser_to_talk_to_nobody_else(served):
    head = answer(served, f"/{served.keys.change}/")
    for line in (
        "default-src 'none'",
        f"connect-src http://127.0.0.1:{served.server.get_port()} ws://",
        "frame-ancestors 'none'",
        "Referrer-Policy: no-referrer",
        "X-Frame-Options: DENY",
    ):
        assert line in head
    refused = answer(served, "/")
    assert served.keys.change not in refused and served.keys.look not in refused


def test_keys_are_new_each_time_and_not_in_what_is_printed():
    a, b = Keys(), Keys()
    assert len({a.change, a.look, b.change, b.look}) == 4 and len(a.change) >= 43
    assert a.change not in repr(a) and a.look not in repr(a)


def test_a_server_that_cannot_be_guarded_is_not_started(monkeypatch):
    from contextlib import nullcontext

    import calib.view.server as module

    monkeypatch.setattr(module, "_guarded", lambda keys: nullcontext())
    with pytest.raises(InputError, match="cannot guard viser"):
        serve(0)


# ------------------------------------------------------------------------------- several browsers

CAMERA = {
    "type": "ViewerCameraMessage",
    **{"wxyz": (1.0, 0.0, 0.0, 0.0), "position": (3.0, 3.0, 3.0), "look_at": (0.0, 0.0, 0.0)},
    **{"up_direction": (0.0, 0.0, 1.0), "fov": 0.8, "near": 0.01, "far": 1000.0},
    **{"image_height": 600, "image_width": 800},
}


@contextmanager
def browser(address: str) -> Iterator[Callable[..., None]]:
    """What viser's page says to its server when it is opened; gives a way to say more."""
    from websockets.sync.client import connect

    msgspec = pytest.importorskip("msgspec")
    parts = urlsplit(address)
    options = {
        "origin": f"http://{parts.netloc}",
        "subprotocols": [f"viser-v{viser.__version__}"],
        "max_size": None,
    }
    with connect(f"ws://{parts.netloc}{parts.path.rstrip('/')}", **options) as socket_:

        def say(**message: object) -> None:
            socket_.send(msgspec.msgpack.encode(message))

        say(**CAMERA)
        yield say


def until(true: Callable[[], bool]) -> None:
    """Wait for something that has to happen."""
    end = time.monotonic() + SOON_S
    while not true():
        assert time.monotonic() < end
        time.sleep(0.02)


@pytest.fixture
def bench(once, tmp_path) -> Bench:
    shutil.copytree(once(small_run) / "run", tmp_path / "run")
    diagnosed(tmp_path / "run")
    shutil.copytree(tmp_path / "run", tmp_path / "other")
    return Bench(Desk.of([tmp_path / "other", tmp_path / "run"]))


def pressed(widget: object) -> dict[str, object]:
    """What a browser says when a widget is used."""
    return {"type": "GuiUpdateMessage", "uuid": widget._impl.uuid}


@pytest.mark.long
def test_each_browser_has_a_view_of_its_own_and_only_the_key_changes_anything(bench, monkeypatch):
    asked = []
    monkeypatch.setattr("calib.view.bench.Job", lambda *job: asked.append(job) or _Job())
    served = serve(0)
    try:
        pages = attend(served, bench)
        with browser(served.address) as one, browser(served.look_address) as two:
            until(lambda: len(pages) == len(bench._hearers) == 2)  # once shown, a page listens
            mine = next(p for p in pages.values() if p.may_change)
            other = next(p for p in pages.values() if not p.may_change)
            assert mine.desk.chosen == other.desk.chosen == "run"

            # What is chosen in one browser does not change another's view.
            two(**pressed(other.picture.menu.stop), updates={"value": "L01P01"})
            one(**pressed(mine._run), updates={"value": "other"})
            until(lambda: other.picture.menu.stop.value == "L01P01" and mine.desk.chosen == "other")
            assert mine.picture.menu.stop.value == "L00P00" and other.desk.chosen == "run"
            assert mine.picture.stage.points is not None

            # Buttons are pressed by messages: those that they do not have, and another's.
            refit, refits = other._ticks._button, mine._ticks._button
            for press in (refit, other._diagnose, other._cancel, refits, mine._diagnose):
                two(**pressed(press), updates={"value": True})
            until(lambda: "cannot change anything" in other._note.content)
            time.sleep(0.5)
            assert asked == [] and not bench.busy

            one(**pressed(mine._ticks._boxes["range_scale"]), updates={"value": True})
            one(**pressed(refits), updates={"value": True})
            until(lambda: len(asked) == 1)
            assert asked[0][1].added == ("range_scale",)
            until(lambda: other._doing.visible and mine._doing.visible)
            assert mine._cancel.visible and not other._cancel.visible
            two(**pressed(other._cancel), updates={"value": True})
            time.sleep(0.2)
            assert bench.busy
            one(**pressed(mine._cancel), updates={"value": True})
            until(lambda: not bench.busy and not mine._doing.visible and not other._doing.visible)
        until(lambda: not pages)
    finally:
        bench.stop()
        served.stop()


class _Job:
    """One that runs until it is stopped."""

    def __init__(self) -> None:
        self._over = False

    def listen(self):
        from calib.view.job import JobMessage

        yield JobMessage("progress", "fit", 0.5)
        while not self._over:
            time.sleep(0.02)
        yield JobMessage("stopped")

    def stop(self) -> None:
        self._over = True


def test_a_run_that_one_browser_makes_is_offered_in_all(bench, monkeypatch, tmp_path):
    made = tmp_path / "made"

    class Making(_Job):
        def listen(self):
            from calib.view.job import JobMessage

            shutil.copytree(tmp_path / "run", made)
            yield JobMessage("run", str(made))
            yield JobMessage("done")

    monkeypatch.setattr("calib.view.bench.Job", lambda *job: Making())
    served = serve(0)
    try:
        pages = attend(served, bench)
        with browser(served.address), browser(served.address):
            until(lambda: len(pages) == len(bench._hearers) == 2)  # once shown, a page listens
            one, two = pages.values()
            one._on_refit({"range_scale": "range_scale"}, [])
            until(lambda: one.desk.chosen == "made" and "made" in two._run.options)
            assert two.desk.chosen == "run" and str(Run.open(made).folder) in two._note.content
    finally:
        served.stop()


def test_both_addresses_are_told(bench, tmp_path):
    from tests.programs import RIGCAL, started

    command = [*RIGCAL, "view", tmp_path / "run", "--no-open", "--json"]
    with started(command) as process:
        text = ""
        while "}" not in text:
            text += process.stdout.readline()
        told = json.loads(text)
    keys = [urlsplit(told[name]).path.strip("/") for name in ("url", "look_url")]
    assert len(set(keys)) == 2 and all(len(key) >= 43 for key in keys)
