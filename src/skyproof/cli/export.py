"""`skyproof export`: a dataset's labels for other tools."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from tyro.conf import Positional

from skyproof.cli.console import progress_bar, say


@dataclass(frozen=True)
class Export:
    """Writes a dataset's labels in the form of other tools.

    Attributes:
        dataset: folder with images and annotations.json, as `skyproof render` and `skyproof ground`
            write it.
        format: coco (one plain JSON file), yolo (images, text and data.yaml, as Ultralytics trains
            from), dota (images and text of oriented boxes) or geojson (points on the map; only for
            georeferenced tiles).
        out: file (coco, geojson) or folder (yolo, dota) to write.
    """

    dataset: Positional[Path]
    format: Literal["coco", "yolo", "dota", "geojson"]
    out: Path

    def run(self) -> None:
        """Writes them, and says what the form could not say."""
        from skyproof.imagery.labels.export import export_labels

        with progress_bar("labels") as update:
            done = export_labels(self.dataset, self.format, self.out, progress=update)
        say(
            f"{done.vehicles} vehicles and {done.ignored} ignore regions of {done.images} images: "
            f"{self.out.resolve()}"
        )
        if done.left_out:
            say(
                f"{done.left_out} ignore regions left out: YOLO text cannot say them, so they "
                "count as background."
            )
        if done.upright:
            say(
                f"{done.upright} vehicles have the upright box, because their heading is not known."
            )
