"""Colours of others' pictures, counted as those of textures are."""

import os
from pathlib import Path

import numpy as np
import pytest
from pattern_colours import count_folder
from PIL import Image


def test_every_picture_of_a_folder_is_counted(tmp_path):
    pixels = np.full((8, 8, 3), 128, np.uint8)
    pixels[:4] = 0
    (tmp_path / "below").mkdir()
    Image.fromarray(pixels).save(tmp_path / "below" / "half.png")
    Image.fromarray(np.full((8, 8, 3), 255, np.uint8)).save(tmp_path / "white.PNG")
    (tmp_path / "notes.txt").write_text("no picture")
    assert [(each.faces, each.corners) for each in count_folder(tmp_path)] == [(0.5, 0.5), (1, 1)]


@pytest.mark.data
@pytest.mark.skipif("SKYPROOF_DATA" not in os.environ, reason="SKYPROOF_DATA is not set")
def test_published_patches_learnt_in_weather_lie_inside_the_cube():
    folder = Path(os.environ["SKYPROOF_DATA"]) / "patterns/du_patches/saved_patches"
    for place in ("carpark-on", "sidestreet-on"):
        (without,) = count_folder(folder / f"{place}-gc")
        (weather,) = count_folder(folder / f"{place}-gcw")
        assert without.faces > 0.7
        assert weather.faces < 0.3
