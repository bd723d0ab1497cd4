"""`skyproof import`: a detector from elsewhere, from its checkpoint file."""

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro
from msgspec import Meta

from skyproof.console import say
from skyproof.detectors.blueprint import Kind
from skyproof.files import refuse_existing
from skyproof.ranges import GroundResolution, Name

if TYPE_CHECKING:
    from skyproof.detectors.card import DetectorCard


@dataclass(frozen=True)
class Import:
    """Imports a checkpoint and freezes the detector's threshold.

    No code of the file is run. The new folder is used like that of a detector trained here.

    Attributes:
        checkpoint: .pt or .pth file of torch.save, .safetensors, or a folder of transformers.
        kind: library of the checkpoint; transformers for a file of RF-DETR's trainer.
        vehicle_classes: vehicle classes of the checkpoint: names, or label numbers for torchvision
            (COCO: 3 car, 6 bus, 8 truck).
        validation: dataset folder that freezes the threshold, at the resolution of later use.
        out: detector folder to write.
        architecture: torchvision's name, such as retinanet_resnet50_fpn: fasterrcnn, maskrcnn or
            retinanet on resnet18, 34, 50, 101 or 152, ..._resnet50_fpn_v2, fcos_resnet50_fpn,
            fasterrcnn_mobilenet_v3_large_fpn or ..._320_fpn.
        gsd: metres per pixel that the detector was made for, if it is not that of the images.
        name: name in tables; the last part of `--out` by default.
        device: auto, cpu or cuda.
    """

    checkpoint: Annotated[Path, tyro.conf.Positional]
    kind: Kind
    vehicle_classes: Annotated[
        tuple[Annotated[str, Meta(max_length=200)], ...], Meta(max_length=1000)
    ]
    validation: Path
    out: Path
    architecture: str | None = None
    gsd: GroundResolution | None = None
    name: tyro.conf.Suppress[Name | None] = None
    device: str = "auto"

    def run(self) -> None:
        from skyproof.datasets.dataset import Dataset
        from skyproof.detectors.card import detector_folder
        from skyproof.detectors.import_checkpoint import Checkpoint, import_detector
        from skyproof.device import choose_device

        refuse_existing(self.out)
        device = choose_device(self.device)
        path = detector_folder(self.checkpoint)
        checkpoint = Checkpoint(path, self.kind, self.vehicle_classes, self.architecture, self.gsd)
        card = import_detector(
            checkpoint, Dataset.open(self.validation), self.out, name=self.name, device=device
        )
        say_card(card, self.out)


def say_card(card: "DetectorCard", folder: Path) -> None:
    """Prints how good a detector is on its validation images, and warnings."""
    say(
        f"Validation AP (centre within 1 m) {card.validation['ap_centre_1m']:.3f}, threshold "
        f"{card.threshold:.3f}. Detector: {folder.resolve()}"
    )
    if card.brought is not None:
        say(f"The detector comes from {card.trained_on}.")
    for doubt in card.doubts:
        say(f"Warning: {doubt}")
