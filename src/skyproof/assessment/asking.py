"""Steps that ask a detector: what any command does with a black box, and attacks by answers."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from skyproof.attacks.settings import QuerySettings
from skyproof.camouflage.name import CamouflageName
from skyproof.cli.attack import Attack
from skyproof.cli.clear import Clear
from skyproof.cli.console import progress_bar, say
from skyproof.cli.precheck import Precheck
from skyproof.cli.score import Score
from skyproof.detectors.card import DetectorCard, installed_version, read_card, write_card
from skyproof.errors import ConfigurationError
from skyproof.scenes.places import Places

if TYPE_CHECKING:
    from skyproof.detectors.loaded import LoadedDetector


@dataclass(frozen=True)
class Asked:
    """A command that asks a black box, whose folder holds nothing but its card.

    Attributes:
        command: what is done; it names the folder.
        box: what answers: a `Detector`, which cannot be named here without loading torch.
        folder: the black box' folder.
    """

    command: Attack | Precheck | Clear | Score
    box: Any
    folder: Path

    def run(self) -> None:
        """Does it."""
        self.command.run(lambda folder: loaded_or_asked(folder, self.box, self.folder))


@dataclass(frozen=True)
class Frozen:
    """Freezes a black box' threshold on labelled images, and writes its card.

    Attributes:
        box: what answers.
        validation: labelled images.
        out: its folder.
    """

    box: Any
    validation: Path
    out: Path

    def run(self) -> None:
        """Asks it about every image, and chooses its threshold on them."""
        from skyproof.datasets.dataset import Dataset
        from skyproof.detectors.inference import WINDOW_PX
        from skyproof.detectors.training import check_validation, validate

        images = Dataset.open(self.validation)
        check_validation(images)
        scores = validate(self.box, images)
        threshold = scores.pop("threshold")
        vehicles = sum(map(len, images.boxes))
        if not scores["f1"]:
            raise ConfigurationError(
                f"{self.box.name} finds none of the {vehicles} vehicles of the validation images, "
                "so no threshold can be frozen on them; see that it gives pixel boxes, left, top, "
                "right, bottom."
            )
        width_px, height_px = images.pictures[0].size_px
        card = DetectorCard(
            name=self.box.name,
            threshold=threshold,
            gsd_m=images.gsd_m,
            image_size_px=(min(height_px, WINDOW_PX), min(width_px, WINDOW_PX)),
            validation=scores,
            validation_vehicles=vehicles,
            skyproof_version=installed_version(),
        )
        self.out.mkdir(parents=True, exist_ok=True)
        write_card(self.out / "detector.json", card, "")
        say(
            f"Validation AP (centre within 1 m) {scores['ap_centre_1m']:.3f}, threshold "
            f"{threshold:.3f}."
        )


@dataclass(frozen=True)
class Query:
    """Seeks a camouflage by a detector's answers alone.

    Attributes:
        name: of the camouflage.
        start: folder of what was learnt on other detectors; None for a random search, which starts
            from a random draw.
        out: folder in which it gets its own.
        detector: the detector's folder.
        box: what answers, where the folder holds a card alone; else None.
        backgrounds, fleet, image_px, places: of the scenes, as for `Attack`.
        settings: budget, batch and seed.
        device: auto, cpu or cuda.
    """

    name: str
    start: Path | None
    out: Path
    detector: Path
    box: Any
    backgrounds: Path
    fleet: Path
    image_px: int
    places: Places
    settings: QuerySettings
    device: str = "auto"

    @property
    def folders(self) -> tuple[str, ...]:
        """What it leaves to be scored, relative to `out`: itself and its kept copies."""
        name = CamouflageName.parse(self.name)
        kept = (f"{name}/snapshots/{name.asked(images)}" for images in self.settings.keep_at)
        return (self.name, *kept)

    def run(self) -> None:
        """Seeks it, or goes on where it stopped."""
        from skyproof.attacks.queries import query_attack
        from skyproof.attacks.world import AttackWorld
        from skyproof.camouflage.folder import load_camouflage
        from skyproof.camouflage.make import make_camouflage
        from skyproof.camouflage.palette import ground_palette
        from skyproof.cli.device import choose_device
        from skyproof.detectors.loaded import load_ensemble
        from skyproof.randomness import generator_of

        device = choose_device(self.device)
        world = AttackWorld.open(
            self.backgrounds, self.fleet, size_px=self.image_px, places=self.places
        )
        (judge,) = load_ensemble(
            [self.detector],
            device,
            world.backgrounds.gsd_m,
            lambda folder: loaded_or_asked(folder, self.box, self.detector),
        )
        name = CamouflageName.parse(self.name)
        if self.start is not None:
            start = load_camouflage(self.start)
            start.name = name
        else:
            start = make_camouflage(
                name,
                generator=generator_of(self.settings.seed, "texture", str(name)),
                palette=ground_palette(world.backgrounds) if name.takes_palette else None,
            )
        with progress_bar(f"ask {name}") as update:
            query_attack(
                start.to(device),
                judge,
                world,
                self.settings,
                self.out / str(name),
                on_step=update,
            )


def loaded_or_asked(folder: Path, box: Any, own: Path) -> LoadedDetector[Any]:
    """Gives a folder's detector; for the black box' own folder its answers, under that card."""
    from skyproof.detectors.loaded import LoadedDetector, load_detector

    if box is None or folder != own:
        return load_detector(folder)
    return LoadedDetector(box, read_card(folder))
