"""Judging camouflages, as commands: score, measure."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from skyproof.cli.console import say
from skyproof.cli.device import choose_device
from skyproof.cli.rendering import Rendering
from skyproof.cli.stages import measure_camouflages, score_camouflages
from skyproof.errors import ConfigurationError
from skyproof.words import interval, percent

__all__ = ["Measure", "Score"]


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
