"""skyproof's components for MAITE, the interfaces of test and evaluation tools for models.

MAITE (Model and Artificial Intelligence Test and Evaluation) 0.10 defines what a model, dataset,
augmentation and metric are; see docs/maite.md. The protocols are structural, so that these
components need the library only where its own `evaluate` is called.
"""

from skyproof.maite.augmentation import CamouflageAugmentation
from skyproof.maite.datasets import VehicleDataset
from skyproof.maite.metric import HiddenVehicles
from skyproof.maite.models import DetectorModel, ModelDetector
from skyproof.maite.targets import Target

__all__ = [
    "CamouflageAugmentation",
    "DetectorModel",
    "HiddenVehicles",
    "ModelDetector",
    "Target",
    "VehicleDataset",
]
