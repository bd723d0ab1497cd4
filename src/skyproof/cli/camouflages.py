"""Making camouflages and judging them, as commands: palette, attack, control, score, measure."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

from skyproof.attacks.settings import AttackSettings
from skyproof.camouflage.folder import load_camouflage
from skyproof.camouflage.palette import load_palette
from skyproof.camouflage.recipe import Materials
from skyproof.cli.console import say
from skyproof.cli.device import choose_device
from skyproof.cli.rendering import Rendering
from skyproof.cli.stages import (
    attack_ensemble,
    draw_control,
    ground_palette,
    measure_camouflages,
    score_camouflages,
)
from skyproof.detectors.card import read_card
from skyproof.errors import ConfigurationError
from skyproof.scenes.settings import SceneSettings
from skyproof.words import interval, percent

__all__ = ["Attack", "Control", "Measure", "Palette", "Score"]


@dataclass(frozen=True)
class Palette:
    """Chooses the colours for Fc from the ground: K-means in CIELAB over the attack split's pixels.

    Attributes:
        backgrounds: background set folder.
        out: palette file (JSON) to write.
        colours: how many.
        seed: of pixels and K-means.
    """

    backgrounds: Path
    out: Path
    colours: int = 5
    seed: int = 0

    def run(self) -> None:
        """Chooses and writes."""
        ground_palette(self.backgrounds, self.out, colours=self.colours, seed=self.seed)
        colours = (load_palette(self.out) * 255).round().int().tolist()
        say(
            f"Palette: {self.out.resolve()}: {', '.join('#' + bytes(colour).hex() for colour in colours)}"
        )


@dataclass(frozen=True)
class Attack:
    """Learns a camouflage against detectors; goes on where it was stopped.

    Names: T-U, or T- with any of Pix (blocks), Lc or Fc (few learnt or fixed colours), Ma (painted parts only), such
    as T-PixFcMa; S-O@0.4, a shape of perturbation magnitude 0.4; C-Fc-seq@0.2, a shape on a finished texture;
    C-Fc-par@0.2, texture and shape in turns. "-1", "-2" at the end number repeats.

    Attributes:
        detectors: detector folders, attacked together.
        backgrounds: background set folder; its attack split is used.
        fleet: fleet folder.
        out: camouflage folder to write.
        name: what is learnt, as tables show it.
        palette: palette file, for Fc.
        texture: folder of the finished texture, for a sequential combination.
        colours: how many colours Lc learns.
        blocks: pixel blocks along a side of the map, for Pix.
        turn_steps: steps until a parallel combination changes sides.
        literal_softmax: restrict colours by the paper's s(s(p)) instead of an annealed softmax.
        image_px: image side; the first detector's training size where not given.
        conditions: weather and light that scenes are drawn from, each equally likely.
        settings: steps, batch, learning rate, seed.
        device: auto, cpu or cuda.
    """

    detectors: tuple[Path, ...]
    backgrounds: Path
    fleet: Path
    out: Path
    name: str = "T-U"
    palette: Path | None = None
    texture: Path | None = None
    colours: int = 5
    blocks: int = 32
    turn_steps: int = 10
    literal_softmax: bool = False
    image_px: int | None = None
    conditions: tuple[str, ...] = ("clear",)
    settings: AttackSettings = field(default_factory=AttackSettings)
    device: str = "auto"

    def run(self) -> None:
        """Learns the camouflage."""
        if not self.detectors:
            raise ConfigurationError("--detectors expects at least one detector folder.")
        materials = Materials(
            palette=load_palette(self.palette) if self.palette else None,
            texture=load_camouflage(self.texture) if self.texture else None,
            colours=self.colours,
            blocks=self.blocks,
            turn_steps=self.turn_steps,
            literal=self.literal_softmax,
        )
        scenes = SceneSettings(
            size_px=self.image_px or min(read_card(self.detectors[0]).image_size_px),
            vehicles_maximum=1,
            conditions=self.conditions,
        )
        attack_ensemble(
            self.name,
            self.detectors,
            self.backgrounds,
            self.fleet,
            scenes,
            self.settings,
            self.out,
            materials=materials,
            device=choose_device(self.device),
        )
        say(f"Camouflage: {self.out.resolve()}")


@dataclass(frozen=True)
class Control:
    """Draws random controls: camouflages under the same constraints, not learnt.

    Attributes:
        name: R-U, R-PixFc, R-S-O@0.4, R-C-Fc@0.2 ...; "-1", "-2" at the end number draws. Several may be given.
        out: folder; every control gets a folder of its name in it.
        seed: of the draws.
        palette: palette file, for Fc.
        colours: how many colours Lc draws.
        blocks: pixel blocks along a side of the map, for Pix.
    """

    name: tuple[str, ...]
    out: Path
    seed: int = 0
    palette: Path | None = None
    colours: int = 5
    blocks: int = 32

    def run(self) -> None:
        """Draws what is not there yet."""
        palette = load_palette(self.palette) if self.palette else None
        materials = Materials(palette=palette, colours=self.colours, blocks=self.blocks)
        for name in self.name:
            if not (self.out / name / "camouflage.json").exists():
                draw_control(name, self.out / name, self.seed, materials=materials)
        say(f"Controls: {self.out.resolve()}")


@dataclass(frozen=True)
class Score(Rendering):
    """Scores any camouflages on any detectors: renders scenes with each, compares every vehicle with itself.

    With --renderer cycles the scenes are path-traced in Blender; --original must then be, too.

    Attributes:
        detectors: detector folders.
        camouflages: camouflage folders; a folder's name is the camouflage's in the table.
        scenes: scene file (JSON lines).
        backgrounds: background set folder.
        fleet: fleet folder.
        original: dataset of the same scenes without camouflage.
        out: evaluation folder to write.
        seed: of the bootstrap.
        device: auto, cpu or cuda.
    """

    detectors: tuple[Path, ...]
    camouflages: tuple[Path, ...]
    scenes: Path
    backgrounds: Path
    fleet: Path
    original: Path
    out: Path
    seed: int = 0
    device: str = "auto"

    def run(self) -> None:
        """Renders, compares, prints the means."""
        if not self.detectors or not self.camouflages:
            raise ConfigurationError(
                "Scoring expects at least one detector and one camouflage folder."
            )
        rows = score_camouflages(
            self.detectors,
            self.camouflages,
            self.scenes,
            self.backgrounds,
            self.fleet,
            self.original,
            self.out,
            rendering=self,
            seed=self.seed,
            device=choose_device(self.device),
        )
        label = "mean" if len(self.detectors) > 1 else rows[0]["detector"]
        for row in rows:
            if row["match"] == "centre_1m" and row["detector"] == label:
                limits = interval(row["easr_low"], row["easr_high"])
                say(f"  {row['camouflage']:<24} EASR {percent(row['easr'])} ({limits}), {label}")
        say(f"Results: {(self.out / 'results.json').resolve()}")


@dataclass(frozen=True)
class Measure:
    """Says what camouflages would ask of those who make them: the paper's signs, areas, blocks, colours, volume.

    Attributes:
        camouflages: camouflage folders; a folder's name is the camouflage's in the table.
        fleet: fleet folder.
        out: JSON file to write.
    """

    camouflages: tuple[Path, ...]
    fleet: Path
    out: Path

    def run(self) -> None:
        """Measures, prints, writes."""
        for row in measure_camouflages(self.camouflages, self.fleet, self.out):
            texture, shape = row["texture"], row["shape"]
            parts = [f"practicality {row['score']['total']:+d}"]
            if texture:
                parts.append(
                    f"{texture['painted_area_m2']:.1f} m² painted, {texture['colours']:.0f} colours, "
                    f"{texture['boundary_m']:.0f} m of boundaries"
                )
            if shape:
                parts.append(
                    f"{shape['added_volume_m3']:.1f} m³ added, self-intersecting on "
                    f"{percent(shape['share_self_intersecting'])} of vehicles"
                )
            say(f"  {row['name']:<24} {'; '.join(parts)}")
        say(f"Measures: {self.out.resolve()}")
