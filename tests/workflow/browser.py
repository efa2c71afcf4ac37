"""A headless Chromium that looks at a page as a reader would, and says what is wrong with it."""

from __future__ import annotations

import os
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest

WIDTHS = (1280, 400)
_FLAGS = (
    "--no-sandbox",  # which Chromium demands of root
    "--disable-gpu",
    "--disable-quic",
    "--no-first-run",
    "--disable-background-networking",
    "--disable-component-update",
    "--disable-sync",
)
_LOOK = """() => ({
  overflow: document.documentElement.scrollWidth - window.innerWidth,
  wide: [...document.querySelectorAll("main *")].filter((node) => !node.closest(".scroll, pre, dialog")
    && node.getBoundingClientRect().right > window.innerWidth + 0.5).map((node) => node.outerHTML.slice(0, 80)),
  dead: [...document.querySelectorAll("a[href^='#']")].map((link) => link.getAttribute("href"))
    .filter((target) => !document.getElementById(target.slice(1))),
  blank: [...document.images].filter((image) => !image.complete || !image.naturalWidth).map((image) => image.alt),
  twins: [...document.querySelectorAll("[id]")].map((node) => node.id)
    .filter((id, place, all) => all.indexOf(id) !== place),
})"""


def find_chromium() -> str:
    """Chromium or Chrome of this machine; skips the test where there is none."""
    given = os.environ.get("WARMLENS_CHROMIUM")
    if given is not None:
        assert Path(given).is_file(), f"WARMLENS_CHROMIUM = {given}: no such file"
        return given
    for name in ("chromium", "chromium-browser", "google-chrome"):
        if found := shutil.which(name):
            return found
    pytest.skip("no chromium, chromium-browser or google-chrome on the PATH, and WARMLENS_CHROMIUM is not set")


@contextmanager
def chromium() -> Iterator[Any]:
    """A browser of Playwright, with an empty profile of its own."""
    executable = find_chromium()
    from playwright.sync_api import sync_playwright

    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=executable, args=list(_FLAGS))
        try:
            yield browser
        finally:
            browser.close()


@contextmanager
def opened(browser: Any, path: Path, width: int = WIDTHS[0]) -> Iterator[tuple[Any, list[str]]]:
    """A page in a window of that width, and the list that its errors and requests go to."""
    context = browser.new_context(viewport={"width": width, "height": 900})
    page, heard = context.new_page(), []
    own = path.resolve().as_uri()
    page.on("console", lambda message: heard.append(f"console {message.type}: {message.text}"))
    page.on("pageerror", lambda error: heard.append(f"error: {error}"))
    page.on(
        "request",
        lambda request: (
            heard.append(f"request: {request.url}") if not request.url.startswith(("data:", own)) else None
        ),
    )
    try:
        page.goto(own)
        yield page, heard
    finally:
        context.close()


def problems(browser: Any, path: Path) -> list[str]:
    """What is wrong with a page: errors, requests, pictures, links, and what does not fit a width."""
    found = []
    for width in WIDTHS:
        with opened(browser, path, width) as (page, heard):
            seen = page.evaluate(_LOOK)
            found += [f"{width}: {text}" for text in heard]
            found += [f"{width}: overflow by {seen['overflow']}"] if seen["overflow"] > 0 else []
            for kind in ("wide", "dead", "blank", "twins"):
                found += [f"{width}: {kind} {item}" for item in seen[kind]]
    return found
