"""The development imagery, where it is present: counts that were taken from its own description."""

import os
from pathlib import Path

import pytest
import torch

from skyproof.imagery.frames import read_frames_folder
from skyproof.imagery.settings import TilingSettings
from skyproof.imagery.tiles.tiling import tile_imagery
from skyproof.scenes.backgrounds import BackgroundSet
from skyproof.scenes.splits import SPLITS

FOLDER = Path(os.environ.get("SKYPROOF_DATA", ""))
pytestmark = [
    pytest.mark.data,
    pytest.mark.skipif(
        "SKYPROOF_DATA" not in os.environ,
        reason="SKYPROOF_DATA does not name the development imagery",
    ),
]


@pytest.mark.parametrize(
    ("pattern", "gsd_m", "vehicles"), [("MOS*", 0.116, 509), ("MunichStreet02*", 0.121, 746)]
)
def test_annotated_frames_hold_the_vehicles_their_description_says(pattern, gsd_m, vehicles):
    frames = read_frames_folder(
        FOLDER / "kit_ais_munich",
        gsd_m=gsd_m,
        target_gsd_m=0.125,
        classes=("car", "minibus"),
        border_px=0.0,
        pattern=pattern,
    )
    assert len(frames) == 20
    assert sum(len(boxes) for boxes in frames.boxes) == vehicles


def test_orthophotos_of_five_reference_systems_become_tiles(tmp_path):
    settings = TilingSettings(size_px=411, minimum_px=274)
    tile_imagery(
        [FOLDER / "backgrounds"],
        tmp_path,
        settings=settings,
        generator=torch.Generator().manual_seed(0),
    )
    tiles = BackgroundSet.open(tmp_path)
    assert len({tile.source for split in SPLITS for tile in tiles.tiles(split)}) == 5
