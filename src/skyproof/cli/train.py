"""`skyproof train`: a detector of ours, trained on a dataset folder."""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Annotated, Any

import tyro

from skyproof.cli.import_detector import say_card
from skyproof.console import progress_bar
from skyproof.detectors.settings import TRAINING_PRESETS, TrainingChanges
from skyproof.errors import ConfigurationError
from skyproof.ranges import Seed


@dataclass(frozen=True)
class Train:
    """Trains a detector on dataset folders and freezes its threshold.

    A stopped training resumes with the same command.

    Attributes:
        detector: retinanet, faster_rcnn or yolov5.
        data: dataset folders to train on, of one resolution.
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
        sets = [Dataset.open(folder) for folder in self.data]
        training, validation = Dataset.joined(sets), Dataset.open(self.validation)
        if self.start is not None:
            (network,) = load_ensemble([self.start], device, training.gsd_m)
            if (network.name, network.size) != kind:
                raise ConfigurationError(
                    f"--from {self.start} expects a {' '.join(kind)} that skyproof trained, got a "
                    f"{network.name} {network.size or 'of another library'}."
                )
            parent = network.card
        origins = [parent.trained_on if parent else "", *(each.origin for each in sets)]
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
            )
        say_card(card, self.out)
