"""skyproof's components for MAITE, a set of interfaces for tools that test and evaluate models.

MAITE (Model and Artificial Intelligence Test and Evaluation) 0.10 defines models, datasets,
augmentations and metrics; see docs/maite.md. Its protocols are structural, so these components need
the library only for its own `evaluate`.
"""

from skyproof.maite.datasets import CamouflageAugmentation, Target, VehicleDataset
from skyproof.maite.metric import HiddenVehicles
from skyproof.maite.models import DetectorModel, ModelDetector

__all__ = [
    "CamouflageAugmentation",
    "DetectorModel",
    "HiddenVehicles",
    "ModelDetector",
    "Target",
    "VehicleDataset",
]
