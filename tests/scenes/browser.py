"""A headless Chromium for tests of pages; tests that use it are skipped if Chromium is not installed."""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from contextlib import contextmanager

import pytest

CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")


@contextmanager
def open_page(address: str, width: int = 1280) -> Iterator[object]:
    """Open the page at an address in a browser window of this width in px, and yield it.

    When the context ends, an AssertionError is raised if the page logged an error or sent a request to another machine.
    """
    if not CHROMIUM:
        pytest.skip("no Chromium is installed")
    playwright = pytest.importorskip("playwright.sync_api", reason="playwright is not installed")
    wrong: list[str] = []
    with playwright.sync_playwright() as engine:
        browser = engine.chromium.launch(executable_path=CHROMIUM, args=["--no-sandbox"])
        page = browser.new_page(viewport={"width": width, "height": 900}, bypass_csp=True)  # for JavaScript of tests
        page.on("console", lambda message: wrong.append(message.text) if message.type == "error" else None)
        page.on("pageerror", lambda error: wrong.append(str(error)))
        own = ("data:", "blob:", "file:", "http://127.0.0.1:")
        page.on("request", lambda request: None if request.url.startswith(own) else wrong.append(request.url[:200]))
        page.goto(address)
        yield page
        browser.close()
    assert not wrong, wrong
