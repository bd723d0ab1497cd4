"""The differentiable renderer: vehicles onto orthophotos, in kernels (section 3.1)."""

import threading
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, field, replace
from typing import Any, Protocol, TypeVar, runtime_checkable

import torch
from jaxtyping import Float, Int
from torch import Tensor

from skyproof.errors import StoredFileError
from skyproof.render.composite import composite, covers
from skyproof.render.frames import Frames, Images
from skyproof.render.layers import SeenBodies, WindowLayers, draw_bodies, draw_shadows, see_bodies
from skyproof.render.lighting import SceneLights, lighting, scene_lights
from skyproof.render.placed import label, nothing_placed, place, windows_around
from skyproof.render.settings import RenderSettings
from skyproof.render.shadows import surrounded
from skyproof.render.weather import finish_images, wet_grounds
from skyproof.scenes.light import Light
from skyproof.scenes.scene import BackgroundWindow, Scene
from skyproof.scenes.sensor import Sensor
from skyproof.vehicles.vehicle import VehicleBatch

_Value = TypeVar("_Value")


@runtime_checkable
class Backgrounds(Protocol):
    """A source of photographs, as `BackgroundSet` is."""

    def window(self, window: BackgroundWindow, size_px: int) -> Float[Tensor, "3 H W"]:
        """Returns a square window, sRGB in [0, 1]."""

    def sensor_of(self, window: BackgroundWindow) -> Sensor:
        """Returns the sensor of its photograph."""

    def light_of(self, window: BackgroundWindow) -> Light:
        """Returns the light of its photograph."""

    def cover_of(self, window: BackgroundWindow, size_px: int) -> Float[Tensor, "H W"] | None:
        """Returns the share of each pixel under crowns and roofs; None without any."""


def _read(scenes: Sequence[Scene], read: Callable[[Scene], _Value]) -> list[_Value]:
    """Reads from the background set for each scene; an error names the scene."""
    found = []
    for scene in scenes:
        try:
            found.append(read(scene))
        except StoredFileError as error:
            raise StoredFileError(f"The scene {scene.id} lacks its background: {error}") from error
    return found


def photographs(backgrounds: Backgrounds, scenes: Sequence[Scene], device: torch.device) -> Images:
    """Returns the scenes' photographs without vehicles, sRGB."""
    windows = _read(scenes, lambda s: backgrounds.window(s.background, s.camera.size_px))
    return torch.stack(windows).to(device)


def sensors(
    backgrounds: Backgrounds, scenes: Sequence[Scene], settings: RenderSettings
) -> list[Sensor]:
    """The sensor of the vehicles in each scene: the settings', else the photograph's."""
    found = _read(scenes, lambda scene: backgrounds.sensor_of(scene.background))
    gsds_m = [scene.camera.gsd_m for scene in scenes]
    return [settings.sensor_on(each, gsd_m) for each, gsd_m in zip(found, gsds_m, strict=True)]


def photographed_lights(
    backgrounds: Backgrounds, scenes: Sequence[Scene], settings: RenderSettings
) -> list[Light]:
    """The light on the vehicles in each scene: the settings', else the photograph's."""
    return _read(scenes, lambda scene: settings.light or backgrounds.light_of(scene.background))


def sensor_record(
    backgrounds: Backgrounds, scenes: Sequence[Scene], settings: RenderSettings
) -> dict[str, float | list[float]]:
    """Returns vehicles' blur and noise in these scenes: a number, or the sorted list of values."""
    record: dict[str, float | list[float]] = {}
    for name in ("blur_sigma_px", "noise"):
        values = sorted({getattr(each, name) for each in sensors(backgrounds, scenes, settings)})
        record[name] = values[0] if len(values) == 1 else values
    return record


@dataclass(frozen=True)
class GeometryBuffer:
    """Everything in some scenes that their vehicles' textures do not change (deferred shading).

    `ground` holds photographs without vehicles (sRGB, not to be written over), `labels` boxes and
    other labels, by whether masks were requested; the images in `labels` are not used.
    """

    scenes: tuple[Scene, ...]
    vertices: Float[Tensor, "N V 3"]
    faces: Int[Tensor, "F 3"]
    texture_px: int
    ground: Float[Tensor, "B 3 H W"]
    bodies: SeenBodies
    shadows: WindowLayers
    lights: SceneLights
    lighting: Float[Tensor, "N 20"]
    sensors: Sequence[Sensor]
    cover: Float[Tensor, "B 1 H W"] | None
    labels: dict[bool, Frames] = field(default_factory=dict)

    @property
    def memory_bytes(self) -> int:
        """Returns about how many bytes of memory it takes."""
        masks = len(self.vertices) * self.ground[0, 0].numel()
        ground_and_cover = 4 * self.ground.nbytes
        bodies = self.bodies.memory_bytes + 4 * self.vertices.nbytes + self.shadows.values.nbytes
        return bodies + ground_and_cover + masks

    def serves(self, vehicles: VehicleBatch) -> bool:
        """Says whether the buffer was made for these bodies."""
        return (
            vehicles.template.faces is self.faces
            and vehicles.texture.shape[-1] == self.texture_px
            and vehicles.vertices.dtype == self.vertices.dtype
            and torch.equal(vehicles.vertices, self.vertices)
        )


class GeometryBuffers:
    """Keeps buffers in bounded memory, as many steps redraw scenes; threads may share it."""

    most_bytes = 600_000_000

    def __init__(self) -> None:
        self._kept: dict[tuple[int, ...], GeometryBuffer] = {}
        self._lock = threading.Lock()

    def find(self, scenes: Sequence[Scene], vehicles: VehicleBatch) -> GeometryBuffer | None:
        """Returns the buffer of these scenes with these bodies; None where it is not kept."""
        with self._lock:
            buffer = self._kept.get(_key(scenes))
        return buffer if buffer is not None and buffer.serves(vehicles) else None

    def keep(self, buffer: GeometryBuffer) -> None:
        """Keeps a buffer instead of others of its scenes and, if there is no room, of the youngest.

        If too many scenes are drawn in turn, those at the start are then found in every turn.
        """
        if buffer.memory_bytes > self.most_bytes:
            return
        with self._lock:
            self._kept.pop(_key(buffer.scenes), None)
            kept = sum(each.memory_bytes for each in self._kept.values())
            while kept + buffer.memory_bytes > self.most_bytes:
                _, youngest = self._kept.popitem()
                kept -= youngest.memory_bytes
            self._kept[_key(buffer.scenes)] = buffer


def _key(scenes: Sequence[Scene]) -> tuple[int, ...]:
    """Returns the scenes' ids, which no others have while a buffer keeps these scenes alive."""
    return tuple(map(id, scenes))


class TorchRenderer:
    """Draws vehicles onto photographs, differentiably in their texture and their vertices.

    Every vehicle and its shadow are rendered in a small window at `supersampling` samples a pixel
    side, shaded by sun and sky, averaged to pixels, blurred as the photograph is, and laid over it
    in linear light (section S2).

    Differences from the paper: the camera is the orthophoto's own parallel projection (see
    `Camera`). There is a cast shadow. Light adds up linearly. Blurred coverage hides the photograph
    (see `composite`). Rendered pixels get noise. Weather changes light, ground and picture.

    Vertex gradients hold for a fixed set of visible triangles plus moving silhouettes of body and
    shadow, with the samples in self-shadow fixed. Vehicles cast no shadow on each other. Masks and
    visible pixels ignore that one vehicle may hide another.
    """

    name = "torch"
    differentiable = True
    concurrent = True

    def __init__(self, backgrounds: Backgrounds, settings: RenderSettings | None = None) -> None:
        self.backgrounds = backgrounds
        self.settings = settings or RenderSettings()
        self._buffers = GeometryBuffers()

    def record(self, scenes: Sequence[Scene]) -> dict[str, Any]:
        """Its settings, with blur and noise as these scenes have them."""
        settings = self.settings
        return {**asdict(settings), **sensor_record(self.backgrounds, scenes, settings)}

    def __call__(
        self, scenes: Sequence[Scene], vehicles: VehicleBatch, *, masks: bool = False
    ) -> Frames:
        """Draws one image per scene, all of one size and resolution.

        Args:
            vehicles: one row per placement, scene by scene.
        """
        if not len(vehicles):
            empty = finish_images(self._ground(scenes, vehicles), scenes)
            return nothing_placed(empty, masks=masks)
        # Each step of an attack draws other scenes; comparisons of camouflages draw the same ones.
        again = not torch.is_grad_enabled()
        buffer = self._buffers.find(scenes, vehicles) if again else None
        if buffer is None:
            buffer = self._look(scenes, vehicles)
            if again:
                self._buffers.keep(buffer)
        seen, placed = buffer.bodies, buffer.bodies.placed
        bodies = draw_bodies(seen, buffer.lighting, vehicles, self.settings)
        image = composite(
            buffer.ground.clone() if again else buffer.ground,
            bodies=WindowLayers(seen.window, bodies),
            shadows=buffer.shadows,
            scene=placed.scene,
            nearness=(placed.ground * placed.viewer).sum(-1),
            seeds=[scene.seed for scene in scenes],
            lights=buffer.lights,
            sensors=buffer.sensors,
            cover=buffer.cover,
        )
        image = finish_images(image, scenes)
        if masks not in buffer.labels:
            coverage = bodies[..., 3].detach()
            buffer.labels[masks] = label(
                buffer.ground, placed, coverage, seen.window, cover=buffer.cover, masks=masks
            )
        return replace(buffer.labels[masks], image=image)

    def _ground(self, scenes: Sequence[Scene], vehicles: VehicleBatch) -> Images:
        return wet_grounds(photographs(self.backgrounds, scenes, vehicles.vertices.device), scenes)

    def _look(self, scenes: Sequence[Scene], vehicles: VehicleBatch) -> GeometryBuffer:
        """Computes everything that does not depend on the vehicles' textures."""
        settings, faces = self.settings, vehicles.template.faces
        placed = place(scenes, vehicles)
        window = windows_around(placed.screen)
        cast = windows_around(torch.cat((placed.shadow_screen, surrounded(placed)), dim=1))
        lights = scene_lights(
            photographed_lights(self.backgrounds, scenes, settings), scenes, vehicles.vertices
        )
        seen = see_bodies(placed, window, cast, vehicles, settings)
        return GeometryBuffer(
            scenes=tuple(scenes),
            vertices=vehicles.vertices.detach().clone(),
            faces=faces,
            texture_px=vehicles.texture.shape[-1],
            ground=self._ground(scenes, vehicles),
            bodies=seen,
            shadows=WindowLayers(cast, draw_shadows(seen, lights, settings)),
            lights=lights,
            lighting=lighting(placed, lights, settings),
            sensors=sensors(self.backgrounds, scenes, settings),
            cover=covers(self.backgrounds.cover_of, scenes, placed, faces),
        )
