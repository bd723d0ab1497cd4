"""The report in a real browser: links, pictures, widths, and the vehicle that can be turned."""

from __future__ import annotations

import base64
import json
import shutil
import struct
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

sync_api = pytest.importorskip("playwright.sync_api", reason="needs playwright")

CHROMIUM = shutil.which("chromium") or shutil.which("google-chrome")
# In software, so that it works without a graphics card; as root it runs without its sandbox.
IN_SOFTWARE = ("--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader")
WIDTHS_PX = (1200, 400)

pytestmark = [
    pytest.mark.browser,
    pytest.mark.skipif(CHROMIUM is None, reason="needs chromium (apt-get install chromium)"),
]


@pytest.fixture(scope="module")
def playwright() -> Iterator[Any]:
    with sync_api.sync_playwright() as started:
        yield started


@pytest.fixture(scope="module")
def chromium(playwright: Any) -> Iterator[Any]:
    started = _launched(playwright, *IN_SOFTWARE)
    yield started
    started.close()


def _launched(playwright: Any, *options: str) -> Any:
    arguments = ["--no-sandbox", *options]
    return playwright.chromium.launch(executable_path=CHROMIUM, args=arguments)


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


def _until(page: Any, holds: Callable[[], bool]) -> None:
    """Waits for what must come; a busy machine draws slowly."""
    for _ in range(120):
        if holds():
            return
        page.wait_for_timeout(500)
    raise AssertionError("it did not come within a minute")


def test_the_page_fits_and_its_pictures_show(page: Any) -> None:
    wide, visible = page.evaluate("[document.documentElement.scrollWidth, innerWidth]")
    assert wide <= visible
    pictures = page.evaluate("[...document.images].map((i) => [i.naturalWidth, i.alt])")
    assert len(pictures) >= 4
    assert all(width > 0 and alt for width, alt in pictures)
    headings = page.locator("h2").all_inner_texts()
    order = ["The answer", "What it looks like", "Success by", "What it means", "Limits"]
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


def test_a_vehicle_is_turned_and_put_away(page: Any) -> None:
    button = page.locator("button.turn").first
    assert page.locator("iframe").count() == 0
    button.click()
    view = page.locator("iframe").first
    canvas = page.frame_locator("iframe").locator("canvas")
    canvas.wait_for()
    # A vehicle in a pattern, and not the even background of a viewer that shows nothing.
    _until(page, lambda: page.evaluate(COLOURS, view.screenshot().hex()) > 300)
    before = view.screenshot()
    box = view.bounding_box()
    page.mouse.move(box["x"] + box["width"] / 2, box["y"] + box["height"] / 2)
    page.mouse.down()
    page.mouse.move(box["x"] + box["width"] / 5, box["y"] + box["height"] / 2, steps=8)
    page.mouse.up()
    _until(page, lambda: view.screenshot() != before)
    button.click()
    assert page.locator("iframe").count() == 0
    assert "in 3D" in button.inner_text()


COLOURS = """async (hex) => {
  const bytes = Uint8Array.from(hex.match(/../g), (pair) => parseInt(pair, 16));
  const picture = await createImageBitmap(new Blob([bytes], {type: "image/png"}));
  const canvas = new OffscreenCanvas(picture.width, picture.height);
  const context = canvas.getContext("2d");
  context.drawImage(picture, 0, 0);
  const data = new Uint32Array(
    context.getImageData(0, 0, picture.width, picture.height).data.buffer
  );
  return new Set(data).size;
}"""
"""How many colours a PNG has."""


def test_a_model_of_a_stranger_fetches_nothing(page: Any) -> None:
    # A fetch would be among the faults that the fixture looks at.
    page.evaluate(
        "(model) => document.querySelectorAll('[data-model]').forEach("
        "(place) => { place.dataset.model = model; })",
        base64.b64encode(_naming("http://127.0.0.1:9/picture.png")).decode(),
    )
    refused: list[str] = []
    page.on("console", lambda message: refused.append(message.text))
    page.locator("button.turn").first.click()
    _until(page, lambda: any("Content Security Policy" in text for text in refused))


def _naming(address: str) -> bytes:
    """A triangle as GLB whose texture lies elsewhere."""
    places = struct.pack("<9f", 0, 0, 0, 1, 0, 0, 0, 1, 0)
    document = {
        "asset": {"version": "2.0"},
        "scene": 0,
        "scenes": [{"nodes": [0, 1]}],
        "nodes": [{"mesh": 0}, {"camera": 0}],
        "cameras": [{"type": "perspective", "perspective": {"yfov": 0.6, "znear": 0.1}}],
        "meshes": [{"primitives": [{"attributes": {"POSITION": 0}, "material": 0}]}],
        "materials": [{"pbrMetallicRoughness": {"baseColorTexture": {"index": 0}}}],
        "textures": [{"source": 0}],
        "images": [{"uri": address}],
        "buffers": [{"byteLength": len(places)}],
        "bufferViews": [{"buffer": 0, "byteLength": len(places)}],
        "accessors": [
            {
                "bufferView": 0,
                "componentType": 5126,
                "count": 3,
                "type": "VEC3",
                "min": [0, 0, 0],
                "max": [1, 1, 0],
            }
        ],
    }
    text = json.dumps(document).encode()
    text += b" " * (-len(text) % 4)
    chunks = struct.pack("<I4s", len(text), b"JSON") + text
    chunks += struct.pack("<I4s", len(places), b"BIN\0") + places
    return struct.pack("<4sII", b"glTF", 2, 12 + len(chunks)) + chunks


def test_without_webgl_the_page_says_so(finished: Path, playwright: Any) -> None:
    chromium = _launched(playwright, "--disable-gpu", "--disable-3d-apis")
    page = chromium.new_page()
    page.goto((finished / "report.html").as_uri())
    page.locator("button.turn").first.click()
    assert page.get_by_text("This browser shows no 3D").first.is_visible()
    assert page.locator("iframe").count() == 0
    chromium.close()


def test_without_scripts_there_is_no_button(finished: Path, chromium: Any) -> None:
    context = chromium.new_context(java_script_enabled=False)
    page = context.new_page()
    page.goto((finished / "report.html").as_uri())
    assert page.locator("button.turn").count() > 0
    assert not any(button.is_visible() for button in page.locator("button.turn").all())
    context.close()
