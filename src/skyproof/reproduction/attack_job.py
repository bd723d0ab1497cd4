"""What of a plan is learnt, or chosen as a control, by which detectors."""

from __future__ import annotations

from dataclasses import dataclass

from skyproof.attacks.settings import AttackSettings
from skyproof.camouflage.name import CamouflageName
from skyproof.cli.attack import BEST_OF


@dataclass(frozen=True)
class AttackJob:
    """One camouflage of a plan that is learnt, or chosen as a control, by detectors.

    Attributes:
        name: the camouflage's, with its repeat.
        settings: how it is learnt.
        detectors: names of those that are attacked together.
        texture: name of the finished texture under a sequential attack's shape.
        kept: names of the copies that it leaves in `snapshots/`.
        best_of: of how many draws the best is taken, where it is the best of some.
        conditions: weather and light that its scenes are drawn from.
    """

    name: str
    settings: AttackSettings
    detectors: tuple[str, ...]
    texture: str | None = None
    kept: tuple[str, ...] = ()
    best_of: int = BEST_OF
    conditions: tuple[str, ...] = ("clear",)

    @property
    def images(self) -> float:
        """The number of images it takes, as `AttackSettings.images` counts them."""
        images = self.settings.images(CamouflageName.parse(self.name), self.best_of)
        return images * len(self.detectors)

    @property
    def folders(self) -> tuple[str, ...]:
        """What it leaves to be scored, relative to `camouflages/`: itself and its kept copies."""
        return (self.name, *(f"{self.name}/snapshots/{name}" for name in self.kept))
