"""The workbench in a headless Chromium, for tests to use as a person would."""

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

from calib.view import attend
from calib.view.bench import Bench
from calib.view.desk import Desk
from calib.view.page import Page
from calib.view.server import serve
from tests.browser import SOFTWARE_GL, Watched, browser_page

SOON_MS, FIT_MS = 60_000, 300_000
# Without a graphics card a core draws, and would be taken by nothing but frames.
FEWER_FRAMES = """
const draw = window.requestAnimationFrame.bind(window);
window.requestAnimationFrame = then => draw(() => setTimeout(() => draw(then), 100));
"""


@contextmanager
def shown(*runs: Path, width: int = 1400) -> Iterator[tuple[Watched, Page]]:
    """The workbench of runs in a browser, its first picture drawn.

    Without the light of surroundings, whose shaders take a core 6 s to compile in each browser.
    """
    served, bench = serve(0), Bench(Desk.of(runs))
    served.server.scene.configure_environment_map(hdri=None)
    try:
        with browser_page(width, 900, *SOFTWARE_GL) as watched:
            pages = attend(served, bench)
            watched.page.set_default_timeout(SOON_MS)
            watched.page.add_init_script(FEWER_FRAMES)
            watched.page.goto(served.address)
            button(watched, "Refit").wait_for()
            watched.page.get_by_text("drawn; residual").or_(
                watched.page.get_by_text("is no")
            ).first.wait_for()
            (page,) = pages.values()
            yield watched, page
            watched.assert_clean()
    finally:
        bench.stop()
        served.stop()


def until(watched: Watched, what: Callable[[], object], wanted: object = True) -> None:
    """Wait until something is as it should be: in the page, or in the server that it talks to.

    What is asked for is told to the page in steps, and drawn when the browser comes to it.
    """
    end, found = time.monotonic() + SOON_MS / 1e3, None
    while (found := what()) != wanted:
        assert time.monotonic() < end, f"{found!r} is not {wanted!r}"
        watched.page.wait_for_timeout(50)


def bars(watched: Watched) -> list[float]:
    """Held-out errors that the ladder shows, mm."""
    return watched.page.locator("[data-is=ladder] [data-mm]").evaluate_all(
        "bars => bars.map(bar => +bar.dataset.mm)"
    )


def button(watched: Watched, name: str):
    return watched.page.get_by_role("button", name=name, exact=True)


def field(watched: Watched, label: str):
    """The text field or check box beside a label."""
    return watched.page.locator(f"xpath=//*[text()='{label}']/following::input[1]")


def _told(watched: Watched) -> None:
    """Wait until the server is told: of widgets used within 50 ms, viser tells of the first and of
    the last alone. No person is as fast."""
    watched.page.wait_for_timeout(60)


def choose(watched: Watched, label: str, option: str) -> None:
    """Choose from a menu."""
    watched.page.get_by_label(label, exact=True).click()
    watched.page.get_by_role("option", name=option, exact=True).click()
    _told(watched)


def value(watched: Watched, label: str) -> str:
    """What is chosen in a menu, or written in a field."""
    return field(watched, label).input_value()


def write(watched: Watched, label: str, text: str) -> None:
    """Write into a text field."""
    field(watched, label).fill(text)
    _told(watched)


def check(watched: Watched, label: str, on: bool = True) -> None:
    """Tick a box that stands after its label, or take its tick away."""
    field(watched, label).set_checked(on, force=True)
    _told(watched)


def tick(watched: Watched, effect: str, on: bool = True) -> None:
    """Tick an effect in the list, or take its tick away."""
    watched.page.get_by_label(effect, exact=True).set_checked(on, force=True)
    _told(watched)


def drag(watched: Watched, start: tuple[float, float], end: tuple[float, float]) -> None:
    """Drag from one place of the window to another, px."""
    watched.page.mouse.move(*start)
    watched.page.mouse.down()
    watched.page.mouse.move(*end, steps=5)
    watched.page.mouse.up()
