"""Small orthophotos that tests make themselves."""

import json
import warnings

import numpy as np
import rasterio
import torch
from PIL import Image
from rasterio.transform import Affine

from skyproof.imagery.settings import SourceSettings, TilingSettings
from skyproof.imagery.tiles.tiling import tile_imagery
from skyproof.scenes.backgrounds import BackgroundSet
from skyproof.scenes.splits import SPLITS


def write_image(path, array, *, crs=None, transform=None, colours=None, tags=None, **options):
    """Writes `[bands, H, W]` as GeoTIFF; `colours` sets the bands' colour interpretation."""
    count, height, width = array.shape
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        with rasterio.open(
            path, "w", driver="GTiff", width=width, height=height, count=count, crs=crs,
            dtype=array.dtype.name, transform=transform or Affine.identity(), **options,
        ) as dataset:  # fmt: skip
            if colours is not None:
                dataset.colorinterp = colours
            dataset.write(array)
            dataset.update_tags(**(tags or {}))
    return path


def noise(height, width, count=3):
    """Bytes from 1 to 254."""
    return np.random.default_rng(0).integers(1, 255, (count, height, width), dtype=np.uint8)


def smooth_noise(height, width):
    """Patches of 16 px, blended: a shift by one pixel hardly changes it, another place does."""
    coarse = np.random.default_rng(0).uniform(20, 235, (3, height // 16 + 2, width // 16 + 2))
    tensor = torch.nn.functional.interpolate(
        torch.from_numpy(coarse)[None], size=(height, width), mode="bilinear", align_corners=True
    )
    return tensor[0].round().to(torch.uint8).numpy()


def tile(
    paths,
    folder,
    *,
    labels=None,
    seed=0,
    gsd_m=0.125,
    size_px=64,
    minimum_px=None,
    source_gsd_m=None,
    crs=None,
    licence=None,
    taken=None,
    progress=lambda *_: None,
):
    """Cuts small tiles. Returns the set and the record."""
    record = tile_imagery(
        paths,
        folder,
        settings=TilingSettings(gsd_m, size_px, minimum_px),
        generator=torch.Generator().manual_seed(seed),
        source_settings=SourceSettings(source_gsd_m, crs, licence, taken),
        labels=labels,
        progress=progress,
    )
    return BackgroundSet.open(folder), record


def all_tiles(backgrounds):
    """Tiles of all splits."""
    return [one for split in SPLITS for one in backgrounds.tiles(split)]


def picture(path, size=(200, 100)):
    """Writes a black image."""
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.new("RGB", size).save(path)


def written(path, text):
    """Writes text, or plain values as JSON; returns the path."""
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(text if isinstance(text, str) else json.dumps(text))
    return path


def features(*geometries, properties=None, **members):
    """A GeoJSON document of geometries that share their properties, or have one set each."""
    each = properties if isinstance(properties, list) else [properties] * len(geometries)
    rows = [
        {"type": "Feature", "geometry": one, "properties": its}
        for one, its in zip(geometries, each, strict=True)
    ]
    return {"type": "FeatureCollection", "features": rows} | members


def shape(kind, coordinates):
    """A GeoJSON geometry."""
    return {"type": kind, "coordinates": coordinates}
