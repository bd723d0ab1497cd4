"""Detectors' features at the vehicles of rendered images, and at ground beside them."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor
from torchvision import ops

from skyproof.camouflage.folder import load_camouflage
from skyproof.console import progress_bar, say
from skyproof.datasets.dataset import Dataset
from skyproof.detectors.detector import Detector, TrainableDetector
from skyproof.detectors.inference import LARGEST_WHOLE_PX, to_detector
from skyproof.detectors.loaded import load_ensemble
from skyproof.device import choose_device
from skyproof.errors import ConfigurationError
from skyproof.files import refuse_existing
from skyproof.randomness import generator_of
from skyproof.render.dataset import render_dataset
from skyproof.render.renderer import TorchRenderer
from skyproof.reproduction.box_features import box_features
from skyproof.reproduction.stored_features import GROUND, Features, write_features
from skyproof.reproduction.world import MOST_SCENES
from skyproof.results.pairs.outcomes import ORIGINAL
from skyproof.scenes.backgrounds import BackgroundSet
from skyproof.vehicles.fleet import Fleet

_BATCH_SIZE = 16
_TRIES = 50
# Shadows and blur reach beyond a box: ground lies this far from every vehicle.
_APART_M = 1.0


@dataclass(frozen=True)
class _Boxes:
    """Boxes of some images, pixel xyxy, and the vehicle that each belongs to."""

    boxes: Sequence[Float[Tensor, "_ 4"]]
    placements: Sequence[Sequence[int]]


def store_features(
    *,
    detectors: Sequence[Path],
    out: Path,
    original: Path,
    camouflages: Sequence[Path],
    backgrounds: Path,
    fleet: Path,
    seed: int = 0,
    device: str = "auto",
) -> None:
    """Renders the first scenes in each camouflage, and stores the detectors' features in `out`."""
    refuse_existing(out)
    place = choose_device(device)
    dataset = Dataset.open(original)
    loaded = load_ensemble(detectors, place, dataset.gsd_m)
    vehicles = Fleet.load(fleet)
    renderer = TorchRenderer(BackgroundSet.open(backgrounds))
    with TemporaryDirectory() as images:
        camouflaged = {}
        for folder in camouflages:
            rendered = Path(images) / folder.name
            with progress_bar(f"render {folder.name}") as update:
                render_dataset(
                    rendered,
                    dataset.scenes[:MOST_SCENES],
                    vehicles,
                    renderer,
                    camouflage=load_camouflage(folder).to(place),
                    device=place,
                    progress=update,
                )
            camouflaged[folder.name] = Dataset.open(rendered)
        found = gather_features(loaded, dataset, camouflaged, seed=seed)
    write_features(out, found)
    say(f"Features of {len(detectors)} detectors: {out.resolve()}")


def gather_features(
    detectors: Sequence[Detector],
    original: Dataset,
    camouflaged: Mapping[str, Dataset],
    *,
    seed: int,
) -> list[Features]:
    """Gives the features of the first scenes' vehicles, with and without camouflages, and ground.

    Vehicles are looked at where they are, found or not; those out of sight are left out. Ground is
    looked at in the images without camouflage, in boxes as large as the vehicles', at random places
    a metre or more from every vehicle; where an image has no room for one, it is left out.

    A detector that gives no features is passed over. `camouflaged` has the images of the same
    scenes by camouflage, `seed` places the ground.

    Raises:
        ConfigurationError: the images are larger than a detector looks at whole.
        StoredFileError: an image is missing or damaged.
    """
    largest = max(max(size) for size in original.sizes_px)
    if largest > LARGEST_WHOLE_PX:
        raise ConfigurationError(
            f"Features are stored of images up to {LARGEST_WHOLE_PX} px a side, these have "
            f"{largest}; give a preset without features, or with smaller images."
        )
    count = min(len(original), MOST_SCENES)
    looks = [(GROUND, original, _ground(original, count, seed))]
    looks += [
        (shown, dataset, _vehicles(dataset, count))
        for shown, dataset in {ORIGINAL: original, **camouflaged}.items()
    ]
    return [
        _features(detector.name, detector, shown, dataset, places)
        for detector in detectors
        if isinstance(detector, TrainableDetector)
        for shown, dataset, places in looks
    ]


def _features(
    name: str, detector: TrainableDetector, shown: str, dataset: Dataset, places: _Boxes
) -> Features:
    vectors: list[Tensor] = []
    count = len(places.boxes)
    for start in range(0, count, _BATCH_SIZE):
        batch = range(start, min(start + _BATCH_SIZE, count))
        images = to_detector(detector, torch.stack(dataset.images(batch)))
        vectors += box_features(detector, images, places.boxes[batch.start : batch.stop])
    rows = [
        (dataset.scenes[index], placement)
        for index, own in enumerate(places.placements)
        for placement in own
    ]
    return Features(
        detector=name,
        shown=shown,
        scenes=[scene.id for scene, _ in rows],
        backgrounds=[scene.background.tile for scene, _ in rows],
        placements=[placement for _, placement in rows],
        vectors=torch.cat(vectors).float().cpu().numpy().astype(np.float64),
    )


def _vehicles(dataset: Dataset, count: int) -> _Boxes:
    """The boxes of the vehicles in sight; the others' have no area."""
    placements = [
        torch.nonzero(_areas(boxes) > 0).flatten().tolist() for boxes in dataset.boxes[:count]
    ]
    boxes = [own[chosen] for own, chosen in zip(dataset.boxes, placements, strict=False)]
    return _Boxes(boxes, placements)


def _ground(dataset: Dataset, count: int, seed: int) -> _Boxes:
    """Boxes as large as the vehicles', clear of all of them."""
    vehicles = _vehicles(dataset, count)
    apart_px = _APART_M / dataset.gsd_m
    places: list[Tensor] = []
    placements: list[list[int]] = []
    for index, (boxes, numbers) in enumerate(zip(vehicles.boxes, vehicles.placements, strict=True)):
        # Each image has a generator of its own: more images do not move the boxes of others.
        generator = generator_of(seed, "ground boxes", dataset.ids[index])
        taken = boxes + boxes.new_tensor([-apart_px, -apart_px, apart_px, apart_px])
        free = {
            number: place
            for number, box in zip(numbers, boxes, strict=True)
            if (place := _free_place(box, taken, dataset.sizes_px[index], generator)) is not None
        }
        places.append(torch.stack(list(free.values())) if free else boxes[:0])
        placements.append(list(free))
    return _Boxes(places, placements)


def _free_place(
    box: Tensor, taken: Tensor, size_px: tuple[int, int], generator: torch.Generator
) -> Tensor | None:
    """A box of the same size at a random free place of an image; None if none was met."""
    sides = box[2:] - box[:2]
    room = torch.tensor(size_px) - sides
    for _ in range(_TRIES):
        corner = torch.rand(2, generator=generator) * room
        moved = torch.cat([corner, corner + sides])
        if not (ops.box_iou(moved[None], taken) > 0).any():
            return moved
    return None


def _areas(boxes: Tensor) -> Tensor:
    return (boxes[:, 2:] - boxes[:, :2]).clamp(min=0).prod(dim=1)
