"""A recording of hostile names, through every command that shows or writes a name."""

import ast
import contextlib
import io
import re
import shutil
import socketserver
import threading
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from xml.etree import ElementTree

import pytest

from calib.cli.app import progress_bar
from calib.exporters import read_extrinsics
from calib.report import Evidence, plot
from calib.results.check import check
from calib.runs.run import Run
from calib.show import notebook
from calib.simulation import Spec, simulate
from chains.errors import InputError
from sensors.documents import read_yaml

from ..browser import Watched, browser_page
from ..programs import RIGCAL, ROOT, execute, rigcal
from .hostile import MARKUP, PLACES, TERMINAL, renamed, with_columns

SMALL = Spec(
    lidar="hesai_pandarxt32", room="box", locations=3, stops_per_location=2, column_step=200
)
COMMANDS = (
    *("check rec", "fit rec -o run", "diagnose run --no-refits", "compare run", "evaluate run"),
    *("plot run --list", "export run -o out", "report run -o report.html"),
)
SOON_S = 30
RUNS_SOMETHING = "script,iframe,object,embed,img,link[rel=stylesheet],base,form,foreignObject"


@pytest.fixture(scope="module")
def folder(tmp_path_factory) -> Path:
    """A recording in `rec` whose names are hostile, but for those that rigcal refuses."""
    folder = tmp_path_factory.mktemp("hostile")
    simulate(SMALL, folder / "plain", 1, {})
    with_columns(folder / "plain")
    allowed = {}
    for names in PLACES.values():
        if _refusals(folder, names):
            names = {k: v for k, v in names.items() if not _refusals(folder, {k: v})}
        allowed |= names
    shutil.copytree(folder / "plain", folder / "rec")
    renamed(folder / "rec", allowed)
    return folder


def _refusals(folder: Path, names: Mapping[str, str]) -> list[str]:
    """Why a recording with some hostile names is refused; it is never an internal fault."""
    shutil.copytree(folder / "plain", folder / "some")
    renamed(folder / "some", names)
    try:
        return check(folder / "some").problems
    except InputError as error:
        return [str(error)]
    finally:
        shutil.rmtree(folder / "some")


@pytest.fixture(scope="module")
def said(folder) -> dict[str, str]:
    """What each command printed."""
    return {command: rigcal(command.split(), folder) for command in COMMANDS}


@pytest.mark.long
def test_nothing_that_is_printed_controls_a_terminal(said):
    for command, text in said.items():
        odd = {c for c in text if not (c.isprintable() or c == "\n")}
        assert not odd, f"{command}: {odd}"
    assert "[bold]" in said["check rec"] + said["fit rec -o run"] + said["diagnose run --no-refits"]


@pytest.mark.long
def test_a_refusal_and_a_result_are_printed_as_letters(folder, tmp_path):
    shutil.copytree(folder / "plain", tmp_path / "rec")
    stops = (tmp_path / "rec" / "stops.csv").read_text()
    (tmp_path / "rec" / "stops.csv").write_text(stops.replace("L00P00", f"a/{TERMINAL}{MARKUP}"))
    for command in (("fit", "rec", "-o", "run"), ("check", "rec", "--json")):
        done = execute([*RIGCAL, *command], tmp_path, PYTHONPATH=str(ROOT))
        assert done.returncode == 2
        text = done.stdout + done.stderr
        assert "[bold]" in text and not {"\x1b", "\x07", "\x9b"} & set(text)


def test_progress_shows_a_name_as_it_is(monkeypatch):
    class Terminal(io.StringIO):
        def isatty(self) -> bool:
            return True

    terminal = Terminal()
    monkeypatch.setattr("sys.stderr", terminal)
    with progress_bar() as progress:
        progress(f"scan {TERMINAL}{MARKUP}", 0, 2)
    text = terminal.getvalue()
    assert MARKUP in text and r"\x1b]0;x\x07\x9b31m" in text and "\x1b]0" not in text


# -------------------------------------------------------------------------------------- the report


@pytest.fixture(scope="module")
def page(folder, said) -> Path:
    return folder / "report.html"


def _server() -> socketserver.TCPServer:
    server = socketserver.ThreadingTCPServer(("127.0.0.1", 0), _Counting)
    server.asked = []
    return server


class _Counting(socketserver.BaseRequestHandler):
    """A server that keeps what it is asked for; a browser may connect and ask for nothing."""

    def handle(self) -> None:
        self.request.settimeout(1.0)
        with contextlib.suppress(TimeoutError):
            line = self.request.recv(4096).partition(b"\r\n")[0].decode("latin-1")
            self.server.asked += [line] if line else []


def opened(
    watched: Watched, page: Path, ended: Callable[[list[str]], bool] = lambda dialogs: True
) -> tuple[list[str], list[str]]:
    """Dialogs that a page opens, and what it asks for, once it rests and what is to come is there.

    Args:
        watched: the browser's page, which stays open.
        page: a file.
        ended: whether what is waited for has come, of the dialogs so far.
    """
    dialogs, asked = [], []
    watched.page.on("dialog", lambda dialog: (dialogs.append(dialog.message), dialog.dismiss()))
    watched.page.on("request", lambda request: asked.append(request.url))
    watched.page.goto(page.as_uri())
    watched.page.evaluate("document.querySelectorAll('details').forEach(fold => fold.open = true)")
    watched.page.wait_for_load_state("networkidle")
    end = time.monotonic() + SOON_S
    while not ended(dialogs):
        assert time.monotonic() < end, (dialogs, asked, watched.errors)
        watched.page.wait_for_timeout(20)  # lets events come in
    return dialogs, [url for url in asked if not url.startswith("data:image/png;base64,")]


def violations(watched: Watched) -> int:
    """How often the page's policy was in the way."""
    return sum("Content Security Policy" in error for error in watched.errors)


@pytest.mark.long
def test_the_report_opens_no_dialog_runs_its_own_script_alone_and_loads_nothing(page):
    with browser_page() as watched:
        dialogs, asked = opened(watched, page)
        assert dialogs == [] and asked == [page.as_uri()]
        watched.assert_clean()  # a violation of the page's policy is an error on the console
        found = watched.page.locator(RUNS_SOMETHING).evaluate_all("all => all.map(e => e.text)")
        assert found == [(ROOT / "calib" / "report" / "page.js").read_text()]
        handlers = "[...document.querySelectorAll('*')].flatMap(e => e.getAttributeNames())"
        names = watched.page.evaluate(handlers)
        assert not [name for name in names if name.startswith("on")]
        assert watched.page.locator("style").count() == 1
        colour = "getComputedStyle(document.querySelector('.verdict')).borderLeftWidth"
        assert watched.page.evaluate(colour) == "8px"  # the page's own style is let in


@pytest.mark.long
def test_what_gets_into_the_page_all_the_same_does_nothing(page, tmp_path):
    """As if an escape were forgotten: the policy stands behind them."""
    with _server() as server, browser_page() as watched:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        there = f"http://127.0.0.1:{server.server_address[1]}"
        evil = (
            f"<script>alert(1)</script><img src='{there}/x.png' onerror=alert(2)>"
            f"<style>body{{background:url({there}/y)}}</style><base href='{there}'>"
            f"<svg onload=alert(3)></svg><link rel=stylesheet href='{there}/z.css'>"
            f"<iframe src='{there}/f'></iframe><script src='{there}/s.js'></script>"
        )
        text = page.read_text().replace("<main>", f"<main>{evil}")
        for name, whole in (("guarded", text), ("open", re.sub("<meta http-equiv.*", "", text))):
            (tmp_path / f"{name}.html").write_text(whole)
        dialogs, _ = opened(watched, tmp_path / "guarded.html", lambda _: violations(watched) >= 6)
        assert dialogs == [] and server.asked == []
        # The test can fail.
        opened(watched, tmp_path / "open.html", lambda dialogs: dialogs and server.asked)
        server.shutdown()


def test_ids_and_references_of_figures_are_plain(page):
    ids = re.findall(r'\b(?:id|href|xlink:href)="([^"]*)"', page.read_text())
    plain = re.compile(
        r"#?[A-Za-z0-9_.-]+|data:,|data:image/png;base64,[A-Za-z0-9+/=\s]+"
        r"|data:text/csv;charset=utf-8,[A-Za-z0-9_.%,:;~-]*"
    )
    assert len(ids) > 500
    assert [each for each in ids if not plain.fullmatch(each)] == []


def test_a_figure_alone_is_whole_xml(folder, said, tmp_path):
    evidence = Evidence.of([Run.open(folder / "run")])
    for name in ("groups", "chain", "residual-label"):
        plot(evidence, name, tmp_path / f"{name}.svg")
        tags = {e.tag.split("}")[-1] for e in ElementTree.parse(tmp_path / f"{name}.svg").iter()}
        assert not tags & {"script", "foreignObject", "a"}


def test_a_notebook_shows_names_as_text(folder, said):
    run = Run.open(folder / "run")
    for html in (notebook.run_html(run), run._repr_html_()):
        ours = "div|p|b|pre|details|summary|table|thead|tbody|tr|th|td"
        assert not re.search(rf"<(?!/?({ours})\b)", html)
        assert not {"\x1b", "\x07", "\x9b"} & set(html)


# ------------------------------------------------------------------------------------- the exports


@pytest.fixture(scope="module")
def out(folder, said) -> Path:
    return folder / "out"


def test_exports_are_whole_and_name_the_same_frames(folder, out):
    names = {name for name in Run.open(folder / "run").solution.shared.frames}
    assert set(read_extrinsics(out / "extrinsics.yaml")[0].frames) == names
    message = read_yaml(out / "static_transforms.yaml")[0]
    assert {t["child_frame_id"] for t in message["transforms"]} == names
    assert set(read_yaml(out / "kalibr.yaml")[0]) == names
    links = {e.get("name") for e in ElementTree.parse(out / "rig.urdf").iter("link")}
    assert names & links
    for path in out.iterdir():
        text = path.read_text()
        assert not [c for c in text if not (c.isprintable() or c in "\n\t")], path


def test_the_launch_file_does_what_it_does_and_nothing_else(out):
    tree = ast.parse((out / "static_transforms.launch.py").read_text())
    kinds = [type(node).__name__ for node in tree.body]
    assert kinds == ["ImportFrom", "ImportFrom", "Assign", "Assign", "FunctionDef"]
    assert all(
        isinstance(value, str | float)
        for row in ast.literal_eval(tree.body[2].value)
        for value in row
    )


def test_the_tree_is_text_and_lines(out):
    tags = {e.tag.split("}")[-1] for e in ElementTree.parse(out / "tree.svg").iter()}
    assert tags == {"svg", "title", "rect", "text", "path"}


def test_latex_and_markdown_hold_no_commands(out):
    tex = (out / "calibration.tex").read_text()
    live = "".join(line for line in tex.splitlines(True) if not line.startswith("%"))
    known = {"begin", "end", "hline", "pm", "to", "textbackslash"}
    assert set(re.findall(r"\\([A-Za-z]+)", live)) <= known
    assert not re.search(r"\\\\\s*[\[*]", live)  # an argument of the end of a row
    body = (out / "calibration.md").read_text()
    tables = [line for line in body.splitlines() if not line.startswith("    ")]
    assert not [line for line in tables if "<" in line]
    widths = {len(re.split(r"(?<!\\)\|", line)) for line in tables if line.startswith("| ")}
    assert widths == {8, 7}
