"""A camouflage as a MAITE augmentation: scenes of ours are drawn again with it."""

from __future__ import annotations

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
from skyproof.maite.datasets import scene_metadata
from skyproof.maite.targets import Batch, Target
from skyproof.render.dataset import placed_vehicles
from skyproof.render.renderer import TorchRenderer
from skyproof.render.settings import RenderSettings
from skyproof.scenes.backgrounds import BackgroundSet
from skyproof.scenes.scene import Scene
from skyproof.vehicles.fleet import Fleet


class CamouflageAugmentation:
    """Draws the vehicles of rendered images again, camouflaged, and labels them anew.

    It is no patch that is laid over pixels: the scene is rendered from its vehicles, light and
    ground, with the settings that the dataset was rendered with. So it serves datasets that
    skyproof rendered, and refuses all others.

    Args:
        camouflage: a camouflage or its folder.
        dataset: folder of the rendered dataset whose images will come, for its scenes.
        backgrounds: the background set that they were rendered on.
        fleet: the fleet that they were rendered with.

    Attributes:
        metadata: `id`, the camouflage's name.

    Raises:
        StoredFileError: a folder is missing or damaged.
        ConfigurationError: another renderer drew the dataset, or nobody did; or its settings cannot
            be had on this ground.
    """

    def __init__(
        self,
        camouflage: str | Path | Camouflage,
        dataset: str | Path,
        backgrounds: str | Path,
        fleet: str | Path,
    ) -> None:
        loaded = (
            load_camouflage(Path(camouflage)) if isinstance(camouflage, str | Path) else camouflage
        )
        self._camouflage = loaded
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
        self.metadata: dict[str, Any] = {"id": str(loaded.name)}

    def __call__(
        self, batch: Batch, /
    ) -> tuple[Sequence[np.ndarray], Sequence[Target], Sequence[Mapping[str, Any]]]:
        """Draws a batch again.

        Args:
            batch: images, targets and metadata of a `VehicleDataset` of the same folder.

        Returns:
            The same scenes with the camouflage; the metadata name it as `camouflage`.

        Raises:
            ConfigurationError: an image is of no scene of the dataset.
        """
        images, _, metadata = batch
        drawn = [
            self._drawn(self._scene(image, known), known)
            for image, known in zip(images, metadata, strict=True)
        ]
        return [each[0] for each in drawn], [each[1] for each in drawn], [each[2] for each in drawn]

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
    def _drawn(
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
    """Opens the renderer that draws as the dataset was drawn, so that camouflage alone differs."""
    usual = TorchRenderer(ground).record(rendered.scenes)
    other = {key: value for key, value in rendered.rendering.items() if value != usual.get(key)}
    try:
        renderer = TorchRenderer(ground, msgspec.convert(other, RenderSettings))
        # As it is stored: JSON makes lists of tuples.
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
