"""`skyproof train`: a detector of ours, trained on a dataset folder."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from skyproof.cli.import_detector import say_card
from skyproof.console import progress_bar
from skyproof.detectors.settings import SIZES, TRAINING_PRESETS, TrainingChanges
from skyproof.errors import ConfigurationError
from skyproof.ranges import Seed


@dataclass(frozen=True)
class Train:
    """Trains a detector on a dataset folder and freezes its threshold.

    A stopped training resumes with the same command.

    Attributes:
        detector: retinanet, faster_rcnn or yolov5; or the folder of a detector to train further.
        data: dataset folders to train on.
        validation: dataset folder that chooses the best weights and the threshold.
        out: detector folder to write.
        size: slim (for a CPU) or full (for a GPU) of a detector that is not trained yet.
        settings: differences from the usual settings of this detector and size.
        seed: seed of weights, order and augmentation.
        device: auto, cpu or cuda.
    """

    detector: str
    data: tuple[Path, ...]
    validation: Path
    out: Path
    size: str = "slim"
    settings: TrainingChanges = field(default_factory=dict)
    seed: Seed = 0
    device: str = "auto"

    def run(self) -> None:
        """Trains the detector, and prints how good it is on the validation images."""
        from skyproof.datasets.dataset import Dataset
        from skyproof.detectors.loaded import build_detector, load_detector
        from skyproof.detectors.training import train
        from skyproof.device import choose_device
        from skyproof.randomness import generator_of

        name, size = self.detector, self.size
        known = {name for name, _ in TRAINING_PRESETS}
        # A folder of such a name here and there must not change what is trained.
        parent = load_detector(name) if name not in known and Path(name).is_dir() else None
        if parent is not None:
            name, size = parent.name, parent.size
        if (name, size) not in TRAINING_PRESETS:
            raise ConfigurationError(
                f"expected a detector out of {', '.join(sorted(known))} in a size out of "
                f"{', '.join(SIZES)}, or the folder of one, got {self.detector} {size}."
            )
        settings = replace(TRAINING_PRESETS[name, size], **self.settings)
        device = choose_device(self.device)
        training = Dataset.joined([Dataset.open(folder) for folder in self.data])
        validation = Dataset.open(self.validation)
        weights = generator_of(self.seed, "weights", name)
        network = (parent or build_detector(name, size, generator=weights)).to(device)
        with progress_bar(f"train {name}") as update:

            def show(row: Mapping[str, Any]) -> None:
                if row["kind"] == "step":
                    update(row["step"], settings.steps)

            card = train(
                network,
                training,
                validation,
                settings,
                self.out,
                generator=generator_of(self.seed, "train", name),
                on_step=show,
                further=parent is not None,
            )
        say_card(card, self.out)
