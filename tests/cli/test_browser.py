"""The report in a real browser: links, pictures and widths."""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

sync_api = pytest.importorskip("playwright.sync_api", reason="needs playwright")

CHROMIUM = shutil.which("chromium") or shutil.which("google-chrome")
WIDTHS_PX = (1200, 400)

pytestmark = [
    pytest.mark.browser,
    pytest.mark.skipif(CHROMIUM is None, reason="needs chromium (apt-get install chromium)"),
]


@pytest.fixture(scope="module")
def chromium() -> Iterator[Any]:
    with sync_api.sync_playwright() as started:
        # As root it runs without its sandbox.
        browser = started.chromium.launch(executable_path=CHROMIUM, args=["--no-sandbox"])
        yield browser
        browser.close()


@pytest.fixture(params=WIDTHS_PX)
def page(request: pytest.FixtureRequest, chromium: Any, finished: Path) -> Iterator[Any]:
    """The tiny demo's report; errors of its scripts and calls to anywhere else fail the test."""
    opened = chromium.new_page(viewport={"width": request.param, "height": 900})
    faults: list[str] = []
    opened.on("pageerror", lambda error: faults.append(str(error)))
    opened.on("request", lambda asked: _note(asked.url, faults))
    opened.goto((finished / "report.html").as_uri())
    yield opened
    opened.close()
    assert faults == []


def _note(url: str, faults: list[str]) -> None:
    if not url.startswith(("file:", "data:", "blob:", "about:")):
        faults.append(url)


def test_the_page_fits_and_its_pictures_show(page: Any) -> None:
    wide, visible = page.evaluate("[document.documentElement.scrollWidth, innerWidth]")
    assert wide <= visible
    pictures = page.evaluate("[...document.images].map((i) => [i.naturalWidth, i.alt])")
    assert len(pictures) >= 4
    assert all(width > 0 and alt for width, alt in pictures)
    headings = page.locator("h2").all_inner_texts()
    order = ["What each attack", "What it means", "Limits", "What it looks like", "Success by"]
    places = [next(i for i, h in enumerate(headings) if h.startswith(part)) for part in order]
    assert places == sorted(places)


def test_links_lead_somewhere(page: Any) -> None:
    targets = page.evaluate("[...document.links].map((a) => a.getAttribute('href'))")
    for target in targets:
        assert target.startswith(("https://", "#"))
        if target.startswith("#"):
            assert page.locator(target).count() == 1
    for details in page.locator("details > summary").all():
        details.click()
    assert page.evaluate("[...document.querySelectorAll('details')].every((d) => d.open)")
