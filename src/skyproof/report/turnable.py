"""A vehicle that the reader turns: one viewer for the page, and a small model per camouflage."""

from __future__ import annotations

import base64
from functools import cache
from pathlib import Path

import trimesh
from trimesh.viewer import scene_to_html

PLACE_OF_MODEL = "@MODEL@"
"""Stands in the viewer where the model goes, in base64."""

# A model may name pictures elsewhere; nothing is fetched.
_POLICY = (
    '<meta http-equiv="Content-Security-Policy" content="default-src \'none\'; '
    "script-src 'unsafe-inline'; style-src 'unsafe-inline'; img-src data: blob:; "
    'connect-src data: blob:">'
)
# The viewer shows linear light as if it were sRGB, in the light of one lamp: whites burn out and
# sides are black. Its own variables are set before the model has been read.
_LIGHT = """<script>
renderer.outputEncoding = THREE.sRGBEncoding;
tracklight.intensity = 0.6;
scene.add(new THREE.AmbientLight(0xffffff, 0.5));
scene.background = new THREE.Color(0xd8dee4);
</script>
"""


def model(path: Path | None) -> str | None:
    """Gives a GLB file in base64; None where there is none."""
    return None if path is None else base64.b64encode(path.read_bytes()).decode()


@cache
def viewer() -> str:
    """Gives trimesh's viewer, a page of its own that works offline, in base64.

    It holds three.js, whose licence (MIT) stands in it. It is some 700 kB, so the page has it once,
    and puts in a model when the reader asks for one.

    Raises:
        RuntimeError: trimesh writes the model in another way than this expects.
    """
    some = trimesh.Scene(trimesh.creation.box())
    page = scene_to_html(some)
    parts = page.split(base64.b64encode(some.export(file_type="glb")).decode())
    if len(parts) != 2:
        raise RuntimeError("trimesh's viewer does not hold its model once, in base64")
    page = PLACE_OF_MODEL.join(parts).replace("<head>", f"<head>{_POLICY}", 1) + _LIGHT
    if _POLICY not in page:
        raise RuntimeError("trimesh's viewer has no head to put a policy into")
    return base64.b64encode(page.encode()).decode()
