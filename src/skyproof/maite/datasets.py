"""Our datasets and camouflages as MAITE's, and the data that MAITE's components exchange."""

import hashlib
import json
import math
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from skyproof.camouflage.camouflage import Camouflage
from skyproof.camouflage.folder import load_camouflage
from skyproof.datasets.dataset import Dataset
from skyproof.datasets.pictures import PictureFile
from skyproof.errors import ConfigurationError
from skyproof.render.dataset import placed_vehicles
from skyproof.render.renderer import TorchRenderer
from skyproof.render.settings import RenderSettings
from skyproof.scenes.backgrounds import BackgroundSet
from skyproof.scenes.scene import Scene
from skyproof.vehicles.fleet import Fleet

LABELS = {0: "vehicle"}
"""Our detectors and datasets have one class."""

Batch = tuple[Sequence[Any], Sequence[Any], Sequence[Mapping[str, Any]]]
"""Images, targets and metadata, as MAITE's data loaders yield them."""


@dataclass(frozen=True, eq=False)
class Target:
    """A MAITE object-detection target: the true vehicles of an image, or the detections in it.

    Boxes are pixel xyxy, half-open, origin at the top-left corner; labels are zeros, the one class
    of `LABELS`; scores are in [0, 1], ones for true vehicles.
    """

    boxes: Float[np.ndarray, "N 4"]
    labels: np.ndarray
    scores: Float[np.ndarray, " N"]

    @classmethod
    def of(cls, boxes: Float[Tensor, "N 4"], scores: Float[Tensor, " N"] | None = None) -> "Target":
        """Makes a target of vehicles; without scores they are true ones."""
        scores = torch.ones(len(boxes)) if scores is None else scores
        own, sure = (each.detach().cpu().numpy().astype(np.float32) for each in (boxes, scores))
        return cls(own, np.zeros(len(boxes), dtype=np.int64), sure)


def batches(dataset: Any, size: int) -> Iterator[Batch]:
    """Reads a MAITE dataset batch by batch."""
    for start in range(0, len(dataset), size):
        data = [dataset[index] for index in range(start, min(start + size, len(dataset)))]
        images, targets, metadata = zip(*data, strict=True)
        yield list(images), list(targets), list(metadata)


class VehicleDataset:
    """A dataset folder of ours as a MAITE object-detection dataset, with access field by field.

    Besides its `id`, the metadata of an image holds

    - `img_gsd`: metres per pixel, the key that NRTK's sensor models read;
    - `ignore`: `[m][4]` regions that are not scored, for which MAITE has no field;
    - for rendered scenes `rendering`, the renderer and a digest of its settings; `place`, the tile
    of ground; `vehicles` and `placements`, the fleet's vehicle and the index in the scene of each
    box; and `sun_elevation_deg`, `sun_azimuth_deg`, `tilt_deg` and `weather`.

    A vehicle out of sight, whose box has no area, is left out.

    Args:
        folder: a folder that `skyproof render` or `skyproof imagery frames` wrote.

    Attributes:
        metadata: `id`, the folder's name and the first digits of a digest of its labels and of the
            sizes of its image files; `index2label`; and `gsd_m`, our own addition.

    Raises:
        StoredFileError: the folder is missing or damaged.
    """

    def __init__(self, folder: str | Path) -> None:
        self._images = Dataset.open(folder)
        scenes = Path(folder) / "scenes.jsonl"
        self._scenes = self._images.scenes if scenes.exists() else None
        settings = json.dumps(self._images.rendering, sort_keys=True, default=str)
        digest = hashlib.sha256(settings.encode()).hexdigest()
        self._rendering = f"{self._images.renderer}-{digest[:12]}"
        name = Path(folder).resolve().name
        self.metadata: dict[str, Any] = {
            "id": f"{name}-{_digest(self._images)[:12]}",
            "index2label": dict(LABELS),
            "gsd_m": self._images.gsd_m,
        }

    def __len__(self) -> int:
        return len(self._images)

    def __getitem__(self, ind: int, /) -> tuple[np.ndarray, Target, dict[str, Any]]:
        """Returns image, target and metadata; raises IndexError beyond the last image."""
        return self.get_input(ind), self.get_target(ind), self.get_metadata(ind)

    def get_input(self, index: int, /) -> np.ndarray:
        """Decodes one image: `[3, H, W]` sRGB bytes."""
        return self._images.image(self._within(index)).numpy()

    def get_target(self, index: int, /) -> Target:
        """Returns the vehicles in sight, without decoding the image."""
        index = self._within(index)
        return Target.of(self._images.boxes[index][self._in_sight(index)])

    def get_metadata(self, index: int, /) -> dict[str, Any]:
        """Returns the known facts about one image, without decoding it."""
        index = self._within(index)
        told: dict[str, Any] = {
            "id": self._images.ids[index],
            "img_gsd": self._images.gsd_m,
            "ignore": self._images.ignore[index].tolist(),
        }
        if self._scenes is not None:
            told["rendering"] = self._rendering
            told |= scene_metadata(self._scenes[index], self._in_sight(index).nonzero()[0].tolist())
        return told

    def _within(self, index: int) -> int:
        if not -len(self) <= index < len(self):
            raise IndexError(f"There are {len(self)} images, so there is no number {index}.")
        return index % len(self)

    def _in_sight(self, index: int) -> np.ndarray:
        boxes = self._images.boxes[index]
        return ((boxes[:, 2:] - boxes[:, :2]) > 0).all(1).numpy()


def scene_metadata(scene: Scene, placements: list[int]) -> dict[str, Any]:
    """Returns the MAITE metadata of a scene in which these placements are in sight."""
    return {
        "place": scene.background.tile,
        "vehicles": [scene.placements[place].vehicle for place in placements],
        "placements": placements,
        "sun_elevation_deg": math.degrees(scene.sun.elevation_rad),
        "sun_azimuth_deg": math.degrees(scene.sun.azimuth_rad) % 360,
        "tilt_deg": math.degrees(scene.camera.tilt_rad),
        "weather": scene.weather.condition,
    }


def _digest(images: Dataset) -> str:
    """Distinguishes sets, including the same scenes with and without a camouflage."""
    # Labels are the same under every texture, and reading all images would take long.
    sizes = [
        picture.path.stat().st_size
        for picture in images.pictures
        if isinstance(picture, PictureFile) and picture.path.exists()
    ]
    return hashlib.sha256(f"{images.digest} {sizes}".encode()).hexdigest()


class CamouflageAugmentation:
    """Renders the scenes of images again with camouflaged vehicles, and labels them anew.

    It pastes no patch over pixels: it renders the scene from its vehicles, light and ground, with
    the settings of the dataset, which must be one that skyproof rendered. `id` is the camouflage's
    name.

    Args:
        camouflage: a camouflage or its folder.
        dataset: folder of the rendered dataset of the images, for its scenes.
        backgrounds: background set of that dataset.
        fleet: fleet of that dataset.

    Raises:
        StoredFileError: a folder is missing or damaged.
        ConfigurationError: the dataset was not rendered, or not by the differentiable renderer, or
            this ground does not allow its settings.
    """

    def __init__(
        self,
        camouflage: str | Path | Camouflage,
        dataset: str | Path,
        backgrounds: str | Path,
        fleet: str | Path,
    ) -> None:
        if isinstance(camouflage, str | Path):
            camouflage = load_camouflage(Path(camouflage))
        self._camouflage = camouflage
        rendered = Dataset.open(dataset)
        if rendered.renderer != TorchRenderer.name:
            raise ConfigurationError(
                f"{dataset} was not drawn by the differentiable renderer, which draws the "
                "camouflage here; render its scenes with that, or the camouflage with `skyproof "
                "render`."
            )
        self._scenes = {scene.id: scene for scene in rendered.scenes}
        self._renderer = _renderer_of(rendered, BackgroundSet.open(Path(backgrounds)))
        self._fleet = Fleet.load(Path(fleet))
        self.metadata: dict[str, Any] = {"id": str(camouflage.name)}

    def __call__(
        self, batch: Batch, /
    ) -> tuple[Sequence[np.ndarray], Sequence[Target], Sequence[Mapping[str, Any]]]:
        """Renders a batch of a `VehicleDataset` of the same folder again.

        The metadata name the camouflage as `camouflage`. An image of another dataset is refused.
        """
        given = zip(batch[0], batch[2], strict=True)
        shown = [self._rendered(self._scene(image, known), known) for image, known in given]
        return [each[0] for each in shown], [each[1] for each in shown], [each[2] for each in shown]

    def _scene(self, image: Any, known: Mapping[str, Any]) -> Scene:
        scene = self._scenes.get(known["id"])
        size = list(np.asarray(image).shape[-2:])
        if scene is None or size != [scene.camera.size_px] * 2:
            raise ConfigurationError(
                f"The camouflage {self.metadata['id']} can be put on the scenes of its own "
                f"rendered dataset alone, and image {str(known['id'])[:100]!r} of {size} px is "
                "none of them; give a dataset that skyproof rendered, as it is."
            )
        return scene

    @torch.no_grad()
    def _rendered(
        self, scene: Scene, known: Mapping[str, Any]
    ) -> tuple[np.ndarray, Target, dict[str, Any]]:
        vehicles = self._camouflage(placed_vehicles(self._fleet, [scene]))
        frames = self._renderer([scene], vehicles)
        in_sight = ((frames.boxes[:, 2:] - frames.boxes[:, :2]) > 0).all(1)
        told = {
            **known,
            **scene_metadata(scene, in_sight.nonzero().flatten().tolist()),
            "camouflage": self.metadata["id"],
        }
        image = (frames.image[0] * 255).round().byte().numpy()
        return image, Target.of(frames.boxes[in_sight]), told


def _renderer_of(rendered: Dataset, ground: BackgroundSet) -> TorchRenderer:
    """Opens the renderer with the dataset's settings, so that only the camouflage differs."""
    usual = TorchRenderer(ground).record(rendered.scenes)
    other = {key: value for key, value in rendered.rendering.items() if value != usual.get(key)}
    with suppress(msgspec.ValidationError, ConfigurationError):
        renderer = TorchRenderer(ground, msgspec.convert(other, RenderSettings))
        # The stored form: JSON turns tuples into lists.
        if json.loads(json.dumps(renderer.record(rendered.scenes))) == rendered.rendering:
            return renderer
    raise ConfigurationError(
        f"{rendered.folder} was rendered on other ground, or with settings that are not known here "
        f"({', '.join(sorted(other))[:200] or 'none are stored'}); give its own background set, or "
        "render it anew."
    )
