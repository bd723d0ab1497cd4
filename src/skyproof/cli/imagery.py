"""`skyproof imagery tile`: orthophotos in."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from skyproof.cli.console import progress_bar, say
from skyproof.files import finished_folder
from skyproof.imagery.labels.files import read_labels
from skyproof.imagery.tiles.placed_labels import LabelSettings
from skyproof.imagery.tiles.sources import SourceSettings
from skyproof.imagery.tiles.tiling import TilingSettings, tile_imagery
from skyproof.randomness import generator_of
from skyproof.scenes.splits import SPLITS

__all__ = ["Tile"]

_NOTES_SHOWN = 12


@dataclass(frozen=True)
class Tile:
    """Cuts orthophotos into tiles of one resolution in four splits; with labels also into datasets to train on.

    Attributes:
        sources: GeoTIFF, JPEG, PNG, JPEG 2000 or VRT images, or folders of them.
        out: folder to write.
        gsd: metres per pixel of the tiles.
        size: side of the tiles in pixels.
        source_gsd: metres per pixel of images that do not say it themselves.
        crs: reference system, such as EPSG:2193, of images that have a world file but name no system.
        licence: of images that state none (TIFFTAG_COPYRIGHT).
        block_m: width in metres of the blocks of tiles that go to one split; default about 400, less for little
            imagery.
        like: a tiled folder; the same ground is cut into the same tiles and splits from these sources.
        labels: COCO, YOLO text, DOTA text or GeoJSON labels of vehicles in the sources.
        classes: class names in them that count as vehicles; others become regions where nothing is scored.
        border_px: in a band so wide along the border of each source, in its pixels, nothing is scored.
        point_box_m: side of the box that stands for a point label.
        seed: of the splits.
    """

    sources: Annotated[tuple[Path, ...], tyro.conf.Positional]
    out: Path
    gsd: float = 0.125
    size: int = 384
    source_gsd: float | None = None
    crs: str | None = None
    licence: str | None = None
    block_m: float | None = None
    like: Path | None = None
    labels: Path | None = None
    classes: tuple[str, ...] = ()
    border_px: float = 0.0
    point_box_m: float = 4.0
    seed: int = 0

    def run(self) -> None:
        """Writes the tiles and says how many."""
        settings = TilingSettings(
            gsd_m=self.gsd, size_px=self.size, block_m=self.block_m, like=self.like
        )
        source_settings = SourceSettings(self.source_gsd, self.crs, self.licence)
        labels = None
        if self.labels is not None:
            label_settings = LabelSettings(
                self.labels, self.classes, self.border_px, self.point_box_m
            )
            labels = read_labels(self.labels), label_settings
        with finished_folder(self.out) as folder, progress_bar("tiles") as update:
            record = tile_imagery(
                self.sources,
                folder,
                settings=settings,
                generator=generator_of(self.seed, "imagery"),
                source_settings=source_settings,
                labels=labels,
                progress=update,
            )
        for note in record.notes[:_NOTES_SHOWN]:
            say(f"  note: {note}")
        if len(record.notes) > _NOTES_SHOWN:
            say(f"  note: {len(record.notes) - _NOTES_SHOWN} more in tiling.json")
        for split in SPLITS:
            count = record.counts[split]
            found = (
                f", {count['vehicles']} vehicles, {count['ignored']} ignore regions"
                if labels is not None
                else ""
            )
            say(f"  {split:<10} {count['tiles']:>7} tiles{found}")
        if self.like is not None:
            say(
                f"  {len(record.missing)} tiles of {self.like} are missing here (listed in tiling.json)"
            )
        elif record.empty:
            say(f"  {record.empty} cells left out: more than 2 % of each is empty")
        say(f"Tiles: {self.out.resolve()}")
