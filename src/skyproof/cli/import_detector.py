"""`skyproof import`: a detector from elsewhere, from its checkpoint file."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import tyro
from msgspec import Meta

from skyproof.console import say
from skyproof.files import refuse_existing
from skyproof.ranges import GroundResolution, Name


@dataclass(frozen=True)
class Import:
    """Imports a detector of torchvision or Ultralytics from its checkpoint; freezes its threshold.

    Nothing that stands in the file is run. The folder it writes is used like that of a detector
    trained here.

    Attributes:
        checkpoint: .pt or .pth file as torch.save writes it, or .safetensors.
        kind: the library it is of.
        vehicle_classes: what counts as vehicle: names of the checkpoint's classes (ultralytics),
            label numbers (torchvision; of COCO 3 is car, 6 bus, 8 truck).
        validation: dataset folder that freezes the threshold; the detector will judge images of
            its resolution.
        out: detector folder to write.
        architecture: of torchvision: retinanet_resnet50_fpn, retinanet_resnet50_fpn_v2,
            fasterrcnn_resnet50_fpn, fasterrcnn_resnet50_fpn_v2, fasterrcnn_mobilenet_v3_large_fpn,
            fasterrcnn_mobilenet_v3_large_320_fpn (the same weights, 150 regions instead of 1000) or
            fcos_resnet50_fpn.
        gsd: metres per pixel the detector was made for, where the images have another resolution.
        name: of the detector in tables; the last part of --out where not given.
        device: auto, cpu or cuda.
    """

    checkpoint: Annotated[Path, tyro.conf.Positional]
    kind: Literal["torchvision", "ultralytics"]
    vehicle_classes: Annotated[
        tuple[Annotated[str, Meta(max_length=200)], ...], Meta(max_length=1000)
    ]
    validation: Path
    out: Path
    architecture: str | None = None
    gsd: GroundResolution | None = None
    name: Name | None = None
    device: str = "auto"

    def run(self) -> None:
        """Converts and validates the detector, writes its folder, prints how good it is."""
        from skyproof.datasets.dataset import Dataset
        from skyproof.detectors.import_checkpoint import Checkpoint, import_detector
        from skyproof.device import choose_device

        refuse_existing(self.out)
        device = choose_device(self.device)
        checkpoint = Checkpoint(
            self.checkpoint, self.kind, self.vehicle_classes, self.architecture, self.gsd
        )
        card = import_detector(
            checkpoint, Dataset.open(self.validation), self.out, name=self.name, device=device
        )
        say(
            f"Validation AP (centre within 1 m) {card.validation['ap_centre_1m']:.3f}, threshold "
            f"{card.threshold:.3f}. Detector: {self.out.resolve()}"
        )
        for doubt in card.doubts:
            say(f"Warning: {doubt}")
