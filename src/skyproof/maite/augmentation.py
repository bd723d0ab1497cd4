"""A camouflage as a MAITE augmentation: our scenes are rendered again with it."""

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import torch

from skyproof.camouflage.camouflage import Camouflage
from skyproof.camouflage.folder import load_camouflage
from skyproof.datasets.dataset import Dataset
from skyproof.errors import ConfigurationError
from skyproof.maite.datasets import Batch, Target, scene_metadata
from skyproof.render.dataset import placed_vehicles
from skyproof.render.renderer import TorchRenderer
from skyproof.render.settings import RenderSettings
from skyproof.scenes.backgrounds import BackgroundSet
from skyproof.scenes.scene import Scene
from skyproof.vehicles.fleet import Fleet


class CamouflageAugmentation:
    """Renders the vehicles of rendered images again, camouflaged, and labels them anew.

    It lays no patch over pixels: it renders the scene from its vehicles, light and ground, with the
    settings of the dataset, which must be one that skyproof rendered. `id` is the camouflage's
    name.

    Args:
        camouflage: a camouflage or its folder.
        dataset: folder of the rendered dataset of the images, for its scenes.
        backgrounds: background set of that dataset.
        fleet: fleet of that dataset.

    Raises:
        StoredFileError: a folder is missing or damaged.
        ConfigurationError: the dataset is not rendered, or by another renderer, or this ground does
            not allow its settings.
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
        images: list[np.ndarray] = []
        targets: list[Target] = []
        every: list[Mapping[str, Any]] = []
        for given, known in zip(batch[0], batch[2], strict=True):
            image, target, told = self._rendered(self._scene(given, known), known)
            images.append(image)
            targets.append(target)
            every.append(told)
        return images, targets, every

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
        sizes = frames.boxes[:, 2:] - frames.boxes[:, :2]
        in_sight = (sizes > 0).all(1)
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
    try:
        renderer = TorchRenderer(ground, msgspec.convert(other, RenderSettings))
        # The stored form: JSON turns tuples into lists.
        record = json.loads(json.dumps(renderer.record(rendered.scenes)))
        same = record == rendered.rendering
    except (msgspec.ValidationError, ConfigurationError):
        same = False
    if not same:
        raise ConfigurationError(
            f"{rendered.folder} was rendered on other ground, or with settings that are not known "
            f"here ({', '.join(sorted(other))[:200] or 'none are stored'}); give its own "
            "background set, or render it anew."
        )
    return renderer
