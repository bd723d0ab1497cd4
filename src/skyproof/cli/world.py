"""`skyproof world`: ground, vehicles and scenes, in splits that share none of them."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

from skyproof.cli.console import progress_bar, say
from skyproof.errors import ConfigurationError
from skyproof.files import finished_folder
from skyproof.ground.procedural import write_procedural_backgrounds
from skyproof.imagery.settings import SourceSettings, TilingSettings
from skyproof.imagery.tiles.tiling import tile_imagery
from skyproof.randomness import generator_of
from skyproof.scenes.backgrounds import BackgroundSet, write_sensor
from skyproof.scenes.sampling import sample_scenes
from skyproof.scenes.scene import write_scenes
from skyproof.scenes.settings import SceneSettings
from skyproof.scenes.splits import SPLITS
from skyproof.vehicles.fleet import Fleet, FleetSettings, sample_fleet

__all__ = [
    "GSD_M",
    "World",
    "WorldSizes",
    "scene_settings",
    "write_fleet",
    "write_ground",
    "write_scene_files",
]

GSD_M = 0.125


@dataclass(frozen=True)
class WorldSizes:
    """How much ground, how many vehicles and scenes.

    Attributes:
        image_px: image side; vehicles are of true size at 12.5 cm per pixel.
        tiles: procedural ground tiles per split (train, validation, attack, test), when no imagery is given.
        vehicles: vehicles in the fleet per split.
        training_images: rendered images to train on.
        validation_images: to choose weights and threshold by.
        test_images: to attack and report on.
        training_vehicles: at most so many in one training image; validation and test have 1 to 5 (PAPER 5).
        parked_share: share of the training images whose vehicles stand in a row, as parked ones do.
    """

    image_px: int = 192
    tiles: tuple[int, int, int, int] = (64, 12, 24, 40)
    vehicles: tuple[int, int, int, int] = (64, 16, 32, 32)
    training_images: int = 2000
    validation_images: int = 120
    test_images: int = 120
    training_vehicles: int = 7
    parked_share: float = 0.0

    def __post_init__(self) -> None:
        counts = (
            self.training_images,
            self.validation_images,
            self.test_images,
            self.training_vehicles,
        )
        if min(self.image_px, *self.tiles, *self.vehicles, *counts) < 1:
            raise ConfigurationError(f"--sizes expects counts of at least 1, but got {self}.")


@dataclass(frozen=True)
class World:
    """Makes what everything else starts from: backgrounds/, fleets/<split>/ and scenes/<split>.jsonl.

    Attributes:
        out: folder to write them to; what is there already is kept.
        imagery: orthophotos to use as ground instead of procedural ones, as in the demo.
        gsd: metres per pixel of images that do not say it themselves.
        blur_sigma_px: blur of the vehicles; where not given, the paper's 2.4 on procedural ground and the imagery's own
            on imagery.
        seed: of everything.
        sizes: how much of everything.
    """

    out: Path
    imagery: tuple[Path, ...] = ()
    gsd: float | None = None
    blur_sigma_px: float | None = None
    seed: int = 0
    sizes: WorldSizes = field(default_factory=WorldSizes)

    def run(self) -> None:
        """Makes what is not there yet."""
        if not (self.out / "backgrounds").exists():
            write_ground(
                self.out,
                self.sizes,
                self.seed,
                imagery=self.imagery,
                assumed_gsd_m=self.gsd,
                blur_sigma_px=self.blur_sigma_px,
            )
        for split in SPLITS:
            if not (self.out / "fleets" / split).exists():
                write_fleet(self.out, self.sizes, self.seed, split)
        if not (self.out / "scenes").exists():
            write_scene_files(self.out, self.sizes, self.seed)
        say(f"World: {self.out.resolve()}")


def write_ground(
    out: Path,
    sizes: WorldSizes,
    seed: int,
    *,
    imagery: Sequence[Path] = (),
    assumed_gsd_m: float | None = None,
    blur_sigma_px: float | None = None,
) -> None:
    """Writes `backgrounds/`: procedural tiles, or tiles of the imagery."""
    window_px = math.ceil(sizes.image_px * math.sqrt(2)) + 2
    with finished_folder(out / "backgrounds") as folder, progress_bar("ground tiles") as update:
        if imagery:
            record = tile_imagery(
                imagery,
                folder,
                settings=TilingSettings(
                    gsd_m=GSD_M, size_px=window_px * 3 // 2, minimum_px=window_px
                ),
                generator=generator_of(seed, "imagery"),
                source_settings=SourceSettings(assumed_gsd_m),
                progress=update,
            )
            for note in record.notes:
                say(f"  note: {note}")
        else:
            counts = dict(zip(SPLITS, sizes.tiles, strict=True))
            write_procedural_backgrounds(
                folder, counts, window_px + 112, seed=seed, progress=update
            )
        if blur_sigma_px is not None:
            write_sensor(
                folder, replace(BackgroundSet.open(folder).sensor, blur_sigma_px=blur_sigma_px)
            )


def write_fleet(out: Path, sizes: WorldSizes, seed: int, split: str) -> None:
    """Writes `fleets/<split>/`."""
    index = SPLITS.index(split)
    # Numbers go on from split to split: no vehicle is in two of them.
    settings = FleetSettings(count=sizes.vehicles[index], first_number=sum(sizes.vehicles[:index]))
    with progress_bar(f"vehicles {split}") as update:
        fleet = sample_fleet(
            settings, generator=generator_of(seed, "fleet", split), progress=update
        )
    fleet.save(out / "fleets" / split)


def scene_settings(sizes: WorldSizes) -> SceneSettings:
    """How validation and test scenes are drawn."""
    return SceneSettings(size_px=sizes.image_px)


def write_scene_files(out: Path, sizes: WorldSizes, seed: int) -> None:
    """Writes `scenes/` for the ground and the fleets in `out`."""
    backgrounds = BackgroundSet.open(out / "backgrounds")
    usual = scene_settings(sizes)
    # Some training images are empty, so that ground alone is learnt too.
    training = replace(
        usual,
        vehicles_minimum=0,
        vehicles_maximum=sizes.training_vehicles,
        parked_share=sizes.parked_share,
    )
    wanted = {
        "train": (sizes.training_images, training),
        "validation": (sizes.validation_images, usual),
        "test": (sizes.test_images, usual),
    }
    with finished_folder(out / "scenes") as folder:
        for split, (count, settings) in wanted.items():
            fleet = Fleet.load(out / "fleets" / split)
            generator = generator_of(seed, "scenes", split)
            scenes = sample_scenes(
                settings,
                backgrounds,
                split,
                fleet.sizes_m,
                count,
                generator=generator,
                prefix=split,
            )
            write_scenes(folder / f"{split}.jsonl", scenes)
