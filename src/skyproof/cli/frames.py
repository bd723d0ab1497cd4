"""Real annotated frames named on the command line."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from skyproof.errors import ConfigurationError
from skyproof.evaluate.evaluation import CleanSet
from skyproof.scenes.yolo_text import read_yolo_folder

__all__ = ["read_frames"]


def read_frames(texts: Sequence[str], classes: Sequence[str], gsd_m: float) -> list[CleanSet]:
    """Reads frames given as FOLDER@GSD or FOLDER/PATTERN@GSD, e.g. `kit/MOS*@0.116`.

    Raises:
        ConfigurationError: a text of another form.
        ImageryError: an image or label file that cannot be used.
    """
    sets = []
    for text in texts:
        place, _, resolution = text.rpartition("@")
        try:
            own_gsd_m = float(resolution)
        except ValueError:
            own_gsd_m = 0.0
        if not place or not 0 < own_gsd_m <= 0.5:
            raise ConfigurationError(
                f"--frames expects FOLDER@GSD or FOLDER/PATTERN@GSD with metres per pixel up to 0.5, got {text!r}; "
                "write it like my_frames@0.12."
            )
        folder, pattern = Path(place), "*"
        if not folder.is_dir():
            folder, pattern = folder.parent, folder.name
            if not folder.is_dir() or not set(pattern) & set("*?["):
                raise ConfigurationError(f"{place} is not a folder; check --frames {text}.")
        images = read_yolo_folder(folder, gsd_m=own_gsd_m, target_gsd_m=gsd_m, classes=tuple(classes), pattern=pattern)
        name = folder.name if pattern == "*" else f"{folder.name}/{pattern}"
        note = f"real frames, {own_gsd_m * 100:.1f} cm/px resampled to {gsd_m * 100:.1f} cm/px; 40 px border ignored"
        sets.append(CleanSet(name, images, note))
    return sets
