"""A shaking camera of NRTK, evaluated through MAITE."""

from pathlib import Path

from maite.tasks import evaluate
from nrtk.impls.perturb_image.optical.otf import JitterPerturber
from nrtk.interop import MAITEObjectDetectionAugmentation

from skyproof.maite import DetectorModel, HiddenVehicles, VehicleDataset

# Pixels of 8 µm, 64 mm and 1 km give the 12.5 cm of the images; others would be resampled.
JITTER = JitterPerturber(s_x=2e-4, s_y=2e-4, p_x=8e-6, f=0.064, D=0.05, altitude=1000)


class Shaking:
    def __init__(self):
        self.metadata = {"id": "jitter-200-microrad"}

    def __call__(self, batch):
        shaken = [self.shaken(*datum) for datum in zip(*batch, strict=True)]
        return tuple(zip(*shaken, strict=True))

    def shaken(self, image, target, metadata):
        if len(target.boxes):
            shake = MAITEObjectDetectionAugmentation(augment=JITTER, augment_id="jitter")
            images, targets, told = shake(([image], [target], [metadata]))
            return images[0], targets[0], told[0]
        # NRTK's wrapper stops at an image without boxes.
        image, _ = JITTER(image=image.transpose(1, 2, 0).copy(), **metadata)
        return image.transpose(2, 0, 1), target, metadata


demo = Path("runs/demo")
model = DetectorModel(demo / "detectors/retinanet")
images = VehicleDataset(demo / "datasets/test")
metric = HiddenVehicles(model, images)
hidden, _, _ = evaluate(model=model, dataset=images, augmentation=Shaking(), metric=metric)
print(hidden)
