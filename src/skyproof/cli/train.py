"""`skyproof train`: a detector of ours, trained on a dataset folder."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import tyro

from skyproof.cli.import_detector import say_card
from skyproof.console import progress_bar, say
from skyproof.detectors.settings import TRAINING_PRESETS, TrainingChanges
from skyproof.errors import ConfigurationError
from skyproof.layout import Layout
from skyproof.ranges import Seed
from skyproof.scenes.settings import side_px

if TYPE_CHECKING:
    from skyproof.attacks.world import World

# Of rendered images: their side, and the share of those without vehicles.
_SIDE_M, _EMPTY_SHARE = 24.0, 0.3


@dataclass(frozen=True)
class Train:
    """Trains a detector and freezes its threshold. A stopped one resumes with the same command.

    Attributes:
        detector: retinanet, faster_rcnn or yolov5.
        data: dataset folders to train on, of one resolution. A folder with `backgrounds` and
            `fleets` gives half of each step's images, or all, rendered as they are needed.
        validation: dataset folder that chooses the best weights and the threshold.
        out: detector folder to write.
        start: detector folder of the same kind and size whose weights are trained further.
        size: slim (for a CPU) or full (for a GPU).
        settings: differences from the usual settings of this detector and size.
        seed: seed of weights, order and augmentation.
        device: auto, cpu or cuda.
    """

    detector: str
    data: tuple[Path, ...]
    validation: Path
    out: Path
    start: Annotated[Path | None, tyro.conf.arg(name="from")] = None
    size: str = "slim"
    settings: TrainingChanges = field(default_factory=dict)
    seed: Seed = 0
    device: str = "auto"

    def run(self) -> None:
        from skyproof.datasets.dataset import Dataset
        from skyproof.detectors.loaded import build_detector, load_ensemble
        from skyproof.detectors.training import train
        from skyproof.device import choose_device
        from skyproof.randomness import generator_of

        kind = (self.detector, self.size)
        weights = generator_of(self.seed, "weights", self.detector)
        network, parent = build_detector(*kind, generator=weights), None
        settings = replace(TRAINING_PRESETS[kind], **self.settings)
        device = choose_device(self.device)
        # Images are rendered of ground and vehicles in a folder without labelled images.
        grounds = [folder for folder in self.data if Layout(folder).backgrounds.is_dir()]
        rendered = [each for each in grounds if not (each / "annotations.json").exists()]
        sets = [Dataset.open(folder) for folder in self.data if folder not in rendered]
        training = Dataset.joined(sets) if sets or not rendered else None
        validation = Dataset.open(self.validation)
        world = _open_world(rendered, validation.gsd_m) if rendered else None
        if self.start is not None:
            shown = validation if training is None else training
            (network,) = load_ensemble([self.start], device, shown.gsd_m)
            if (network.name, network.size) != kind:
                raise ConfigurationError(
                    f"--from {self.start} expects a {' '.join(kind)} that skyproof trained, got a "
                    f"{network.name} {network.size or 'of another library'}."
                )
            parent = network.card
        origins = [parent.trained_on if parent else "", *(each.origin for each in sets)]
        origins += [f"rendered on the ground of {each.resolve().name}" for each in rendered]
        with progress_bar(f"train {self.detector}") as update:

            def show(row: Mapping[str, Any]) -> None:
                if row["kind"] == "step":
                    update(row["step"], settings.steps)

            card = train(
                network.to(device),
                training,
                validation,
                settings,
                self.out,
                generator=generator_of(self.seed, "train", self.detector),
                on_step=show,
                parent=parent,
                trained_on="; ".join(filter(None, origins))[:10_000],
                drawn=world,
            )
        say_card(card, self.out)


def _open_world(folders: Sequence[Path], gsd_m: float) -> "World":
    """Opens the one folder that images are rendered of."""
    import torch

    from skyproof.attacks.world import World

    if len(folders) > 1:
        raise ConfigurationError(
            f"--data expects one folder to render from, got {len(folders)}; render images of the "
            "others (skyproof render)."
        )
    layout = Layout(folders[0])
    size_px = side_px(_SIDE_M, gsd_m)
    fleet = layout.fleets / "train"
    world = World.open(layout.backgrounds, fleet, size_px=size_px, split="train")
    # Tiles that are too small are refused before anything is written.
    world.draw(1, generator=torch.Generator().manual_seed(0))
    say(f"  images are rendered on the ground of {layout.folder}")
    return world.for_training(_EMPTY_SHARE)
