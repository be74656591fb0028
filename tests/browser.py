"""A headless Chromium that keeps a record of what a page complains about and asks for."""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import TYPE_CHECKING
from urllib.parse import urlsplit

import pytest

if TYPE_CHECKING:
    from playwright.sync_api import Page

NAMES = ("chromium", "chromium-browser", "google-chrome")
HOME = {"127.0.0.1", "localhost", "::1", None}  # None: data:, blob: and file: have no host
SOFTWARE_GL = ("--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader")


@dataclass
class Watched:
    """A page, and what it did.

    Args:
        page: playwright's.
        errors: console errors and uncaught exceptions, in order.
        left: addresses of requests that went, or would have gone, to another machine.
    """

    page: Page
    errors: list[str] = field(default_factory=list)
    left: list[str] = field(default_factory=list)

    def assert_clean(self) -> None:
        """Neither an error on the console nor a request that leaves the machine."""
        assert not self.errors, "\n".join(self.errors)
        assert not self.left, "\n".join(self.left)


@contextmanager
def browser_page(width: int = 1400, height: int = 900, *arguments: str) -> Iterator[Watched]:
    """A page of a headless Chromium; the test is skipped, and says so, where there is none.

    Args:
        width, height: of the window, in pixels.
        arguments: more of Chromium's command line, `SOFTWARE_GL` for a page that draws in 3-D.
    """
    program = next(filter(None, map(shutil.which, NAMES)), None)
    if program is None:
        pytest.skip(f"no browser: none of {', '.join(NAMES)} is installed")
    api = pytest.importorskip("playwright.sync_api", reason="playwright is not installed")
    with api.sync_playwright() as playwright:
        options = ["--no-sandbox", "--disable-background-networking", *arguments]
        browser = playwright.chromium.launch(executable_path=program, args=options)
        try:
            page = browser.new_page(viewport={"width": width, "height": height})
            watched = Watched(page)
            page.on("pageerror", lambda error: watched.errors.append(str(error)))
            page.on("console", lambda message: _heard(watched, message))
            page.on("request", lambda request: _asked(watched, request.url))
            yield watched
        finally:
            browser.close()


def _heard(watched: Watched, message: object) -> None:
    if message.type == "error":
        watched.errors.append(f"{message.text} ({message.location.get('url', '')})")


def _asked(watched: Watched, url: str) -> None:
    if urlsplit(url).hostname not in HOME:
        watched.left.append(url)
