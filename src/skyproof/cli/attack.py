"""`skyproof attack`: camouflages by name, optimised against detectors or drawn at random."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro
from msgspec import Meta
from tyro.conf import Suppress

from skyproof.attacks.settings import AttackSettings
from skyproof.camouflage.name import CamouflageName
from skyproof.camouflage.settings import CamouflageSettings
from skyproof.console import say
from skyproof.errors import ConfigurationError
from skyproof.files import refuse_links
from skyproof.scenes.places import Places
from skyproof.scenes.settings import SceneSettings

if TYPE_CHECKING:
    import torch

    from skyproof.attacks.making import Maker

BEST_OF = 32
"""Number of random draws of a best-of-N control."""


@dataclass(frozen=True)
class Attack:
    """Makes camouflages by name: optimised against detectors, or drawn at random.

    Textures: T-U (free), or T- with Pix (blocks), Lc or Fc (few optimised or fixed colours), Ma
    (painted parts), such as T-PixFcMa. Shapes: S-O@0.4 has magnitude 0.4. Combinations:
    C-Fc-seq@0.2, C-Fc-par@0.2. Random controls: R-PixFcMa, R-S-O@0.4, R-C-Fc@0.2; they need no
    detectors and scenes. Stronger controls: R-Ma_plain (best of 27 paints), R-PixFcMa_best (best of
    32 draws), R-PixFcMa_search (random search), R-Ma_pattern (best of 32 patterns, such as
    stripes). "-1" at the end numbers a repeat. A stopped attack resumes with the same command.

    Attributes:
        names: names of the camouflages.
        out: folder to write, with a folder for each camouflage.
        detectors: detector folders, attacked together.
        backgrounds: background set folder, whose attack split is used.
        fleet: fleet folder.
        palette: palette file, or background set with the colours (default: `--backgrounds`).
        texture: finished texture under a sequential combination or a random shape.
        image_px: side of the images in pixels; None is the first detector's training size.
        conditions: weather and light that scenes are drawn from, each equally likely.
        places: places of vehicles: uniform (any place), removed (places of removed vehicles) or
            drivable (ground for vehicles).
        draws: number of random draws of a best-of-N control.
        camouflage: numbers that the names leave open.
        settings: method, steps and seed.
        device: auto, cpu or cuda.
    """

    names: Annotated[tuple[str, ...], tyro.conf.Positional, tyro.conf.arg(metavar="NAME ...")]
    out: Path
    detectors: tuple[Path, ...] = ()
    backgrounds: Path | None = None
    fleet: Path | None = None
    palette: Path | None = None
    texture: Path | None = None
    image_px: Suppress[Annotated[int, Meta(ge=96, le=16_384)] | None] = None
    conditions: Suppress[tuple[str, ...]] = ("clear",)
    places: Places = "uniform"
    draws: Suppress[Annotated[int, Meta(ge=2, le=100)]] = BEST_OF
    camouflage: Suppress[CamouflageSettings] = field(default_factory=CamouflageSettings)
    settings: AttackSettings = field(default_factory=AttackSettings)
    device: str = "auto"

    def run(self) -> None:
        names = [CamouflageName.parse(name) for name in self.names]
        if not names:
            raise ConfigurationError("Expected at least one name of a camouflage, such as T-U.")
        unchanged = [name for name in names if name.magnitude == 0 and not name.random]
        if unchanged:
            raise ConfigurationError(
                f"{unchanged[0]} has magnitude 0, with which there is nothing to optimise; give a "
                "magnitude above 0."
            )
        drawn = [name for name in names if name.random and name.choice is None]
        attacked = [name for name in names if name not in drawn]
        # Mistakes are refused before anything is made.
        if attacked:
            if not self.detectors or self.backgrounds is None or self.fleet is None:
                raise ConfigurationError(
                    f"{attacked[0]} needs detectors and scenes; give --detectors, --backgrounds "
                    "and --fleet."
                )
            SceneSettings(vehicles_maximum=1, conditions=self.conditions)
        from skyproof.attacks.making import draw_random_control
        from skyproof.camouflage.folder import load_camouflage

        refuse_links(self.out)
        palette = self._palette(names)
        maker = None
        for name in (*drawn, *attacked):
            folder = self.out / str(name)
            texture = load_camouflage(self.texture) if self.texture else None
            if name in drawn:
                draw_random_control(
                    name,
                    folder,
                    seed=self.settings.seed,
                    palette=palette,
                    texture=texture,
                    settings=self.camouflage,
                )
            else:
                maker = maker or self._maker(palette)
                maker.make(name, folder, draws=self.draws, texture=texture)
        say(f"Camouflages: {self.out.resolve()} ({', '.join(map(str, names))})")

    def _palette(self, names: Sequence[CamouflageName]) -> "torch.Tensor | None":
        """Returns the fixed colours of Fc, from which Lc and Pix start; None if none are needed."""
        if not any(self.settings.takes_palette(name) for name in names):
            return None
        source = self.palette or self.backgrounds
        if source is None:
            raise ConfigurationError(
                "Fixed colours (Fc) expect a palette file, or ground to take them from; give "
                "--palette or --backgrounds."
            )
        from skyproof.camouflage.palette import ground_palette, load_palette
        from skyproof.scenes.backgrounds import BackgroundSet

        if source.is_dir():
            palette = ground_palette(BackgroundSet.open(source), self.camouflage.colours)
        else:
            palette = load_palette(source)
        colours = (palette * 255).round().int().tolist()
        say(f"Palette: {', '.join('#' + bytes(colour).hex() for colour in colours)}")
        return palette

    def _maker(self, palette: "torch.Tensor | None") -> "Maker":
        from skyproof.attacks.making import Maker
        from skyproof.attacks.world import World
        from skyproof.detectors.card import read_card
        from skyproof.detectors.loaded import load_ensemble
        from skyproof.device import choose_device

        assert self.backgrounds is not None
        assert self.fleet is not None
        device = choose_device(self.device)
        world = World.open(
            self.backgrounds,
            self.fleet,
            size_px=self.image_px or min(read_card(self.detectors[0]).image_size_px),
            conditions=self.conditions,
            places=self.places,
        )
        ensemble = load_ensemble(self.detectors, device, world.backgrounds.gsd_m)
        return Maker(ensemble, world, self.settings, device, palette, self.camouflage)
