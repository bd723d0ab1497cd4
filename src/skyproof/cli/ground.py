"""`skyproof ground`: ground to put vehicles on, drawn or cut from orthophotos, in four splits."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from tyro.conf import Positional, Suppress

from skyproof.console import progress_bar, say, stage_bars
from skyproof.errors import ConfigurationError
from skyproof.files import finished_folder
from skyproof.imagery.settings import LabelSettings, SourceSettings, TilingSettings
from skyproof.ranges import Count, Seed
from skyproof.scenes.sensor import PAPER_BLUR_SIGMA_PX, BlurChoice
from skyproof.scenes.splits import SPLITS

if TYPE_CHECKING:
    from skyproof.imagery.labels.label import Labels
    from skyproof.imagery.tiles.sources import Source


@dataclass(frozen=True)
class Ground:
    """Cuts orthophotos into tiles, or draws ground, in four splits.

    With labels, the tiles of every split also become a dataset to train on.

    Attributes:
        sources: images (GeoTIFF, JPEG, PNG, JPEG 2000, VRT) or folders of them; ground is drawn
            without any.
        out: background set to write.
        tiles: number of drawn tiles per split (train, validation, attack, test).
        blur_sigma_px: blur of vehicles in pixels, or "paper" for the paper's 2.4; None is the blur
            of the ground.
        seed: seed of drawn ground, and of the blocks of imagery that go to each split.
        tiling: size of the tiles.
        source: facts that the images do not state.
        labels: vehicle labels of the images.
    """

    out: Path
    sources: Positional[tuple[Path, ...]] = ()
    tiles: Suppress[tuple[Count, Count, Count, Count]] = (64, 12, 24, 40)
    blur_sigma_px: Suppress[BlurChoice | None] = None
    seed: Seed = 0
    tiling: TilingSettings = field(default_factory=TilingSettings)
    source: SourceSettings = field(default_factory=SourceSettings)
    labels: LabelSettings = field(default_factory=LabelSettings)

    def __post_init__(self) -> None:
        said = self.source
        about_imagery = (self.labels.path, said.gsd_m, said.crs, said.taken)
        if not self.sources and any(value is not None for value in about_imagery):
            raise ConfigurationError(
                "--labels.path and --source.* speak of imagery, but no image was named; name "
                "images, or folders of them."
            )

    def run(self, inspected: Sequence[Source] | None = None, told: Collection[str] = ()) -> None:
        """Writes the tiles and says how many.

        The images may have been `inspected` before, and notes on them `told`.
        """
        from skyproof.scenes.background_index import change_sensors

        with finished_folder(self.out) as folder:
            if self.sources:
                self._cut(folder, inspected, told)
            else:
                self._draw(folder)
            chosen = self.blur_sigma_px
            if chosen is not None:
                blur_sigma_px = PAPER_BLUR_SIGMA_PX if chosen == "paper" else chosen
                change_sensors(folder, lambda its: replace(its, blur_sigma_px=blur_sigma_px))
        say(f"Ground: {self.out.resolve()}")

    def _draw(self, folder: Path) -> None:
        from skyproof.ground.procedural import write_procedural_backgrounds

        size_px, gsd_m = self.tiling.size_px, self.tiling.gsd_m
        counts: dict[str, int] = dict(zip(SPLITS, self.tiles, strict=True))
        with progress_bar("ground tiles") as update:
            write_procedural_backgrounds(
                folder, counts, size_px, seed=self.seed, gsd_m=gsd_m, progress=update
            )

    def _cut(self, folder: Path, inspected: Sequence[Source] | None, told: Collection[str]) -> None:
        from skyproof.imagery.labels.files import read_labels
        from skyproof.imagery.tiles.tiling import tile_imagery
        from skyproof.imagery.words import tiling_words
        from skyproof.randomness import generator_of

        path = self.labels.path
        labels = None if path is None else (read_labels(path, self.labels.classes), self.labels)
        if inspected is None:
            inspected = inspect_shown(self.sources, self.source, labels and labels[0])
        with progress_bar("ground tiles") as update:
            record = tile_imagery(
                self.sources,
                folder,
                settings=self.tiling,
                generator=generator_of(self.seed, "imagery"),
                source_settings=self.source,
                labels=labels,
                sources=inspected,
                progress=update,
            )
        for line in tiling_words(record, labelled=labels is not None, told=told):
            say(line)


def inspect_shown(
    paths: Sequence[Path], settings: SourceSettings, labels: Labels | None
) -> list[Source]:
    """Finds out how to read images and which show the same ground, and shows the progress."""
    from skyproof.imagery.tiles.planes import inspect_imagery

    with stage_bars("images") as update:
        return inspect_imagery(paths, settings, labels, partial(update, "compared"))
