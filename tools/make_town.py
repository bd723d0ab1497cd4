"""Draws a town as one photograph with labels, to time an assessment on.

    python tools/make_town.py runs/drawn_town
    time skyproof assess detectors/retinanet --imagery runs/drawn_town/town.tif \\
        --labels runs/drawn_town/town.geojson --out runs/drawn_town/assessed

Drawn scenes of 48 m, each on ground of its own, lie side by side in a GeoTIFF of 12.5 cm per pixel;
21 by 21 of them are one square kilometre. The labels are the boxes of their vehicles.
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path

import rasterio
import tyro
from rasterio.transform import Affine, from_origin
from rasterio.windows import Window

import skyproof as sp
from skyproof.main import run

GSD_M = 0.125
SCENE_PX = 384
CRS = "EPSG:2193"
CORNER_M = (1_550_016.0, 5_190_000.0)


@dataclass(frozen=True)
class Town:
    """What is drawn.

    Attributes:
        out: folder; gets town.tif, town.geojson, and in `drawn` what they are put together from.
        side: how many scenes a side has.
        seed: decides everything.
    """

    out: tyro.conf.Positional[Path]
    side: int = 21
    seed: int = 0


def main(town: Town) -> None:
    """Draws the scenes and puts them together."""
    drawn = town.out / "drawn"
    count = town.side**2
    # What is made for the other splits is not used.
    splits = ("1", "1", "1")
    call("ground", "--out", drawn / "ground", "--tiles", count, *splits, "--seed", town.seed)
    call("vehicles", "--out", drawn / "fleets", "--counts", 256, *splits, "--seed", town.seed)
    places = ("--backgrounds", drawn / "ground", "--fleet", drawn / "fleets/train")
    scenes = drawn / "scenes.jsonl"
    sizes = ("--settings.size-px", SCENE_PX, "--settings.places", "drivable")
    split = ("--split", "train", "--count", count, "--seed", town.seed)
    call("scenes", *places, *sizes, *split, "--out", scenes)
    call("render", "--scenes", scenes, *places, "--out", drawn / "images")
    join(sp.Dataset.open(drawn / "images"), town)


def call(*words: object) -> None:
    """Runs a command of skyproof's; ends with its exit code where it fails."""
    code = run([str(word) for word in words])
    if code:
        raise SystemExit(code)


def join(images: sp.Dataset, town: Town) -> None:
    """Writes the photograph, scene by scene, and the labels in its coordinates."""
    to_map = from_origin(*CORNER_M, GSD_M, GSD_M)
    side_px = town.side * SCENE_PX
    features = []
    with rasterio.open(
        town.out / "town.tif",
        "w",
        driver="GTiff",
        width=side_px,
        height=side_px,
        count=3,
        dtype="uint8",
        crs=CRS,
        transform=to_map,
        tiled=True,
        compress="deflate",
        photometric="RGB",
    ) as photograph:
        for number in range(len(images)):
            left = number % town.side * SCENE_PX
            top = number // town.side * SCENE_PX
            window = Window(left, top, SCENE_PX, SCENE_PX)
            photograph.write(images.image(number).numpy(), window=window)
            here = to_map * Affine.translation(left, top)
            features += [outline(box, here) for box in images.boxes[number].tolist()]
    crs = {"type": "name", "properties": {"name": f"urn:ogc:def:crs:{CRS.replace(':', '::')}"}}
    labels = {"type": "FeatureCollection", "crs": crs, "features": features}
    (town.out / "town.geojson").write_text(json.dumps(labels))
    print(f"{len(images)} scenes, {len(features)} vehicles: {town.out / 'town.tif'}")


def outline(box: list[float], to_map: Affine) -> dict[str, object]:
    """Gives a vehicle's box as a feature of GeoJSON."""
    x0, y0, x1, y1 = box
    corners = [(x0, y0), (x1, y0), (x1, y1), (x0, y1), (x0, y0)]
    ring = [list(to_map * corner) for corner in corners]
    geometry = {"type": "Polygon", "coordinates": [ring]}
    return {"type": "Feature", "properties": {"class": "car"}, "geometry": geometry}


if __name__ == "__main__":
    main(tyro.cli(Town))
