"""Scenes with their vehicles but for what these wear, kept while one camouflage follows another."""

import threading
from collections.abc import Sequence
from dataclasses import dataclass, field

import torch
from jaxtyping import Float, Int
from torch import Tensor

from skyproof.render.frames import Frames
from skyproof.render.layers import SeenBodies, WindowLayers
from skyproof.render.lighting import Lighting, SceneLights
from skyproof.render.placed import Placed, Windows
from skyproof.scenes.scene import Scene
from skyproof.scenes.sensor import Sensor
from skyproof.vehicles.vehicle import VehicleBatch

_SAMPLE_BYTES, _FACE_BYTES = 76, 68


@dataclass(frozen=True)
class GeometryBuffer:
    """All of some scenes that their vehicles' textures do not change (deferred shading).

    `ground` holds photographs without vehicles, sRGB, not to be written over, `labels` boxes and
    other labels by whether masks were wanted; their images count for nothing.
    """

    scenes: tuple[Scene, ...]
    vertices: Float[Tensor, "N V 3"]
    faces: Int[Tensor, "F 3"]
    texture_px: int
    ground: Float[Tensor, "B 3 H W"]
    placed: Placed
    window: Windows
    bodies: SeenBodies
    shadows: WindowLayers
    lights: SceneLights
    lighting: Lighting
    sensors: Sequence[Sensor]
    cover: Float[Tensor, "B 1 H W"] | None
    labels: dict[bool, Frames] = field(default_factory=dict)

    @property
    def memory_bytes(self) -> int:
        """About how much memory it takes."""
        count, _, height, width = self.ground.shape
        pixels, vehicles = height * width, len(self.vertices)
        samples = len(self.bodies.visibility.covered)
        ground_and_cover = 4 * count * pixels * self.ground.element_size()
        masks = vehicles * pixels
        bodies = samples * _SAMPLE_BYTES + vehicles * len(self.faces) * _FACE_BYTES
        bodies += self.bodies.visibility.keys.nbytes
        return bodies + ground_and_cover + masks

    def serves(self, vehicles: VehicleBatch) -> bool:
        """Says whether these are the same bodies."""
        return (
            vehicles.template.faces is self.faces
            and vehicles.texture.shape[-1] == self.texture_px
            and vehicles.vertices.dtype == self.vertices.dtype
            and torch.equal(vehicles.vertices, self.vertices)
        )


class GeometryBuffers:
    """Buffers in a bounded memory, as many steps redraw scenes; threads may share it."""

    most_bytes = 400_000_000

    def __init__(self) -> None:
        self._kept: dict[tuple[int, ...], GeometryBuffer] = {}
        self._lock = threading.Lock()

    def find(self, scenes: Sequence[Scene], vehicles: VehicleBatch) -> GeometryBuffer | None:
        """Returns the buffer of these scenes with these bodies; None where it is not kept."""
        with self._lock:
            buffer = self._kept.get(_key(scenes))
        return buffer if buffer is not None and buffer.serves(vehicles) else None

    def keep(self, buffer: GeometryBuffer) -> None:
        """Keeps a buffer in place of others of its scenes, and if there is no room of the youngest.

        Drawing too many scenes in turn then finds those at the start of each turn.
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
    """A buffer holds its scenes, so that no others have their ids."""
    return tuple(map(id, scenes))
