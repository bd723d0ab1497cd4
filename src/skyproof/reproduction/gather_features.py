"""The mean of a detector's feature pyramid over boxes of vehicles, and of ground beside them."""

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor
from torchvision import ops

from skyproof.camouflage.folder import load_camouflage
from skyproof.console import progress_bar, say
from skyproof.datasets.dataset import Dataset
from skyproof.detectors.detector import Detector, TrainableDetector
from skyproof.detectors.imported import ImportedDetector
from skyproof.detectors.inference import LARGEST_WHOLE_PX, to_detector
from skyproof.detectors.loaded import load_ensemble
from skyproof.detectors.region_align import area_levels
from skyproof.detectors.torchvision_detectors import RetinaNetDetector, TorchvisionDetector
from skyproof.device import choose_device
from skyproof.errors import ConfigurationError
from skyproof.files import refuse_existing
from skyproof.randomness import generator_of
from skyproof.render.dataset import render_dataset
from skyproof.render.renderer import TorchRenderer
from skyproof.reproduction.preset import MOST_SCENES
from skyproof.reproduction.stored import GROUND, Features, write_features
from skyproof.results.outcomes import ORIGINAL
from skyproof.scenes.backgrounds import BackgroundSet
from skyproof.vehicles.fleet import Fleet

_BATCH_SIZE = 16
_TRIES = 50
# Shadows and blur reach beyond a box: ground lies this far from every vehicle.
_APART_M = 1.0
# A vehicle of 36 px spans 4.5 cells of stride 8: one sample in each.
_CELL_SAMPLES = 4

Levels = Callable[[Float[Tensor, "K 4"]], Int[Tensor, " K"]]
"""Returns the pyramid level, from 0, of each box, pixel xyxy."""

Places = Sequence[Mapping[int, Float[Tensor, " 4"]]]
"""The boxes of every image, pixel xyxy, by the vehicle that each belongs to."""


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
    """Returns the features of vehicles in sight, with and without camouflages, and of ground.

    Ground boxes are as large as the vehicles', at random places a metre or more from each, as far
    as there is room. Detectors without features are skipped.
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
        _features(detector, shown, dataset, places)
        for detector in detectors
        if isinstance(detector, TrainableDetector)
        for shown, dataset, places in looks
    ]


def _features(
    detector: TrainableDetector, shown: str, dataset: Dataset, places: Places
) -> Features:
    vectors: list[Tensor] = []
    boxes = [torch.stack([*own.values()]) if own else torch.zeros(0, 4) for own in places]
    for start in range(0, len(boxes), _BATCH_SIZE):
        own = boxes[start : start + _BATCH_SIZE]
        images = dataset.images(range(start, start + len(own)))
        vectors += box_features(detector, to_detector(detector, torch.stack(images)), own)
    rows = [
        (dataset.scenes[index], placement)
        for index, found in enumerate(places)
        for placement in found
    ]
    return Features(
        detector=detector.name,
        shown=shown,
        scenes=[scene.id for scene, _ in rows],
        backgrounds=[scene.background.tile for scene, _ in rows],
        placements=[placement for _, placement in rows],
        vectors=torch.cat(vectors).float().cpu().numpy().astype(np.float64),
    )


def _vehicles(dataset: Dataset, count: int) -> Places:
    """The boxes of the vehicles in sight; the others' have no area."""
    return [
        {index: box for index, box in enumerate(boxes) if bool((box[2:] > box[:2]).all())}
        for boxes in dataset.boxes[:count]
    ]


def _ground(dataset: Dataset, count: int, seed: int) -> Places:
    """Boxes as large as the vehicles', clear of all of them."""
    apart_px = _APART_M / dataset.gsd_m
    places = []
    for index, vehicles in enumerate(_vehicles(dataset, count)):
        # Each image has a generator of its own: more images do not move the boxes of others.
        generator = generator_of(seed, "ground boxes", dataset.ids[index])
        grown = torch.tensor([-apart_px, -apart_px, apart_px, apart_px])
        taken = [box + grown for box in vehicles.values()]
        size_px = dataset.sizes_px[index]
        tried = {
            number: _free_place(box, taken, size_px, generator) for number, box in vehicles.items()
        }
        places.append({number: place for number, place in tried.items() if place is not None})
    return places


def _free_place(
    box: Tensor, taken: Sequence[Tensor], size_px: tuple[int, int], generator: torch.Generator
) -> Tensor | None:
    """A box of the same size at a random free place of an image; None if none was found."""
    sides = box[2:] - box[:2]
    room = torch.tensor(size_px) - sides
    for _ in range(_TRIES):
        corner = torch.rand(2, generator=generator) * room
        moved = torch.cat([corner, corner + sides])
        if not (ops.box_iou(moved[None], torch.stack([*taken])) > 0).any():
            return moved
    return None


@torch.no_grad()
def box_features(
    detector: TrainableDetector,
    images: Float[Tensor, "B 3 H W"],
    boxes: Sequence[Float[Tensor, "_ 4"]],
) -> list[Float[Tensor, "_ C"]]:
    """Returns one vector per box, the mean over the box, at the pyramid level of the box.

    Images are sRGB in [0, 1], boxes pixel xyxy. In a YOLO the size of a vehicle alone does not
    decide its level, and levels differ in channels, so the finest level is used.
    """
    if isinstance(detector, ImportedDetector):
        height, width = detector.size_px(images)
        ratio = images.new_tensor([width / images.shape[-1], height / images.shape[-2]]).repeat(2)
        boxes = [own.to(images) * ratio for own in boxes]
    levels, width_px = detector.pyramid(images)
    network = detector.network if isinstance(detector, ImportedDetector) else detector
    if isinstance(network, RetinaNetDetector):
        anchors = network.model.anchor_generator.cell_anchors
        return pool_boxes(levels, width_px, boxes, anchor_levels(anchors))
    if isinstance(network, TorchvisionDetector):
        strides_px = [width_px / level.shape[-1] for level in levels]
        return pool_boxes(levels, width_px, boxes, lambda own: area_levels(own, strides_px))
    return pool_boxes(levels[:1], width_px, boxes, lambda own: own[:, 0].long() * 0)


def pool_boxes(
    pyramid: Sequence[Float[Tensor, "B C _ _"]],
    width_px: int,
    boxes: Sequence[Float[Tensor, "_ 4"]],
    level_of: Levels,
) -> list[Float[Tensor, "_ C"]]:
    """Averages the level that `level_of` chooses over each box (pixel xyxy), by RoIAlign.

    The finest level of the pyramid comes first; `width_px` is that of its padded input images.
    """
    places = torch.cat(
        [
            torch.cat([own.new_full((len(own), 1), index), own], dim=1)
            for index, own in enumerate(boxes)
        ]
    ).to(pyramid[0])
    levels = level_of(places[:, 1:])
    pooled = pyramid[0].new_zeros(len(places), pyramid[0].shape[1])
    for number, features in enumerate(pyramid):
        chosen = levels == number
        if chosen.any():
            scale = features.shape[-1] / width_px
            means = ops.roi_align(features, places[chosen], 1, scale, _CELL_SAMPLES, aligned=True)
            pooled[chosen] = means.flatten(1)
    return list(pooled.split([len(own) for own in boxes]))


def anchor_levels(anchors: Sequence[Float[Tensor, "_ 4"]]) -> Levels:
    """Chooses RetinaNet's level, whose anchor (pixel xyxy, centred) is most like a box."""

    def level_of(boxes: Tensor) -> Tensor:
        halves = (boxes[:, 2:] - boxes[:, :2]) / 2
        centred = torch.cat([-halves, halves], dim=1)
        overlaps = [ops.box_iou(centred, own.to(centred)).amax(dim=1) for own in anchors]
        return torch.stack(overlaps).argmax(dim=0)

    return level_of
