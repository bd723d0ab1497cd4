"""`skyproof ground`: ground to put vehicles on, drawn or cut from orthophotos, in four splits."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING

from tyro.conf import Positional

from skyproof.cli.console import progress_bar, say
from skyproof.errors import ConfigurationError
from skyproof.files import finished_folder
from skyproof.imagery.settings import LabelSettings, SourceSettings, TilingSettings
from skyproof.ranges import Count, Seed
from skyproof.scenes.sensor import BlurChoice, chosen_blur_px
from skyproof.scenes.splits import SPLITS

if TYPE_CHECKING:
    from skyproof.imagery.tiles.tiling import TilingRecord

_NOTES_SHOWN = 12
_FEW_TILES = 12
"""Of as many, a success rate that tiles decide has an interval of some ±30 points."""
_ROOM_PX = 112  # by which procedural tiles are larger than the windows cut from them


@dataclass(frozen=True)
class Ground:
    """Draws procedural ground, or cuts orthophotos into tiles; both in four splits.

    With labels, the tiles of every split also become a dataset to train on.

    Attributes:
        sources: GeoTIFF, JPEG, PNG, JPEG 2000 or VRT images, or folders of them; without any,
            ground is drawn.
        out: background set to write.
        tiles: how many tiles are drawn per split (train, validation, attack, test), where no
            sources are given.
        blur_sigma_px: blur of vehicles on this ground: a number of pixels, or "paper" for the
            paper's 2.4; where it is not given, that of the ground itself, of each drawn tile its
            own and on imagery as measured.
        seed: seed of procedural ground, and of the order in which blocks of imagery go to the
            splits.
        tiling: how the ground is cut.
        source: what the sources do not say themselves.
        labels: where labels of vehicles in the sources come from.
    """

    out: Path
    sources: Positional[tuple[Path, ...]] = ()
    tiles: tuple[Count, Count, Count, Count] = (64, 12, 24, 40)
    blur_sigma_px: BlurChoice | None = None
    seed: Seed = 0
    tiling: TilingSettings = field(default_factory=TilingSettings)
    source: SourceSettings = field(default_factory=SourceSettings)
    labels: LabelSettings = field(default_factory=LabelSettings)

    def __post_init__(self) -> None:
        said = self.source
        about_imagery = (
            self.labels.path,
            self.tiling.like,
            said.gsd_m,
            said.crs,
            said.taken,
            said.cover,
        )
        if not self.sources and any(value is not None for value in about_imagery):
            raise ConfigurationError(
                "--labels.path, --tiling.like and --source.* speak of imagery, but no image was "
                "named; name images, or folders of them."
            )

    def run(self) -> None:
        """Writes the tiles and says how many."""
        from skyproof.scenes.background_index import change_sensors

        with finished_folder(self.out) as folder:
            if self.sources:
                say_record(self, self._cut(folder))
            else:
                self._draw(folder)
            if self.blur_sigma_px is not None:
                blur_sigma_px = chosen_blur_px(self.blur_sigma_px)
                change_sensors(folder, lambda its: replace(its, blur_sigma_px=blur_sigma_px))
        say(f"Ground: {self.out.resolve()}")

    def _draw(self, folder: Path) -> None:
        from skyproof.ground.procedural import write_procedural_backgrounds

        with progress_bar("ground tiles") as update:
            write_procedural_backgrounds(
                folder,
                dict(zip(SPLITS, self.tiles, strict=True)),
                self.tiling.size_px,
                seed=self.seed,
                gsd_m=self.tiling.gsd_m,
                progress=update,
            )

    def _cut(self, folder: Path) -> TilingRecord:
        from skyproof.imagery.labels.files import read_labels
        from skyproof.imagery.tiles.tiling import tile_imagery
        from skyproof.randomness import generator_of

        labels = None
        if self.labels.path is not None:
            labels = (read_labels(self.labels.path), self.labels)
        with progress_bar("ground tiles") as update:
            return tile_imagery(
                self.sources,
                folder,
                settings=self.tiling,
                generator=generator_of(self.seed, "imagery"),
                source_settings=self.source,
                labels=labels,
                progress=update,
            )


def tiling_for_images(image_px: int, *, gsd_m: float, imagery: bool) -> TilingSettings:
    """Returns tiles from which square images of `image_px` can be cut at any heading.

    Args:
        image_px: side of the images in pixels.
        gsd_m: metres per pixel of tiles and images.
        imagery: whether the ground is imagery, whose tiles may shrink to what one image needs.
    """
    window_px = math.ceil(image_px * math.sqrt(2)) + 2
    if imagery:
        return TilingSettings(gsd_m=gsd_m, size_px=window_px * 3 // 2, minimum_px=window_px)
    return TilingSettings(gsd_m=gsd_m, size_px=window_px + _ROOM_PX)


def say_record(ground: Ground, record: TilingRecord) -> None:
    """Says what was cut, what was noted on the way, and whether it is enough for a test.

    Args:
        ground: what was asked.
        record: what was done.
    """
    for note in record.notes[:_NOTES_SHOWN]:
        say(f"  note: {note}")
    if len(record.notes) > _NOTES_SHOWN:
        say(f"  note: {len(record.notes) - _NOTES_SHOWN} more in tiling.json")
    for split in SPLITS:
        count = record.counts[split]
        labelled = ""
        if ground.labels.path is not None:
            labelled = f", {count['vehicles']} vehicles, {count['ignored']} ignore regions"
        say(f"  {split:<10} {count['tiles']:>7} tiles{labelled}")
    few = record.counts["test"]["tiles"]
    if 0 < few < _FEW_TILES and ground.tiling.like is None:
        say(
            f"  {few} test tiles are too few for a useful interval: where what a tile's vehicles "
            f"have in common decides, a success rate stays open by ±{100 / math.sqrt(few):.0f} "
            "points; give more imagery, or make the tiles smaller (--tiling.size-px of skyproof "
            "ground)."
        )
    if ground.tiling.like is not None:
        say(
            f"  {len(record.missing)} tiles of {ground.tiling.like} are missing here (listed in "
            "tiling.json)"
        )
    elif record.empty:
        say(f"  {record.empty} cells left out: more than 2 % of each is empty")
