"""A generator of vehicles from layers: body, paint, glass, and what fits found on top of them.

Every layer of a sample lies between, or near, those of vehicles that were fitted, and the body is
drawn by the rules of `skyproof vehicles`; so panes are where such a body has panes, and the part
map is exact.
"""

from dataclasses import astuple, fields

import torch
from jaxtyping import Float
from torch import Tensor

from skyproof.generator.fits import FittedVehicles
from skyproof.generator.fleet import LearntVehicle
from skyproof.generator.maps import MAP_PX, unfolded
from skyproof.geometry.colour import cielab_to_srgb, srgb_to_cielab
from skyproof.randomness import generator_of
from skyproof.vehicles.bodies import BODY_RANGES, BodyDimensions, build_body
from skyproof.vehicles.painting import paint_vehicle
from skyproof.vehicles.vehicle import TEXTURE_SIZE

_COMPONENTS = 24
_BODY_NOISE = 0.35
_NEIGHBOURS = 3
_COLOURS = 6
# Limits for a stored generator: bodies as fits stretch them, and numbers of their size.
_STRETCH, _SLACK_M = 1.5, 1e-3
_LARGEST = 1e4
_NAMES = tuple(field.name for field in fields(BodyDimensions))


class LayeredGenerator:
    """Vehicles between fitted ones.

    A latent vector holds the dimensions of a body, the colours of paint and glass in CIELAB, and
    the coefficients of the map on top of them (principal components). A draw of it starts at one
    fitted vehicle. The body's dimensions vary by 0.35 standard deviations of its type at random,
    and are shrunk towards the type's mean so that their spread stays the same (a smoothed
    bootstrap; Silverman and Young 1987). Colours and map move part of the way to one of the three
    fitted vehicles whose paint is nearest (as SMOTE does; Chawla et al. 2002).
    """

    method = "layered"

    def __init__(
        self,
        body_types: tuple[str, ...],
        latents: Float[Tensor, "N L"],
        detail_mean: Float[Tensor, " T"],
        components: Float[Tensor, "K T"],
    ) -> None:
        self.body_types = body_types
        self.latents = latents
        self._detail_mean = detail_mean
        self._components = components

    @classmethod
    def learn(cls, vehicles: FittedVehicles) -> "LayeredGenerator":
        """Learns from fitted vehicles, by linear algebra alone and so at once."""
        flat = vehicles.detail.flatten(1)
        mean = flat.mean(0)
        count = min(_COMPONENTS, len(flat) - 1)
        # Signs of singular vectors are arbitrary; these are the same on every machine.
        _, _, components = torch.linalg.svd((flat - mean).double(), full_matrices=False)
        components = components[:count]
        largest = components.gather(1, components.abs().argmax(1, keepdim=True))
        # Contiguous by row, as read from a file, so that sums have the same order, too.
        components = (components * largest.sign()).float().contiguous()
        dimensions = torch.tensor([astuple(each) for each in vehicles.dimensions])
        colours = [srgb_to_cielab(each) for each in (vehicles.paint, vehicles.glass)]
        latents = torch.cat((dimensions, *colours, (flat - mean) @ components.T), dim=1)
        return cls(vehicles.body_types, latents, mean, components)

    def sample_latent(
        self, generator: torch.Generator, *, body_type: str | None = None
    ) -> tuple[str, Float[Tensor, " L"]]:
        """Draws a body type, if none is given, and a latent vector."""
        starts = [index for index, each in enumerate(self.body_types) if body_type in (None, each)]
        start = starts[int(torch.randint(len(starts), (), generator=generator))]
        body_type = self.body_types[start]
        bodies = len(_NAMES)
        own = self.latents[[each == body_type for each in self.body_types]][:, :bodies]
        spread = own.std(0, correction=0)
        mean = own.mean(0)
        noise = torch.randn(bodies, generator=generator)
        body = mean + (1 - _BODY_NOISE**2) ** 0.5 * (self.latents[start, :bodies] - mean)
        body = body + _BODY_NOISE * spread * noise
        # Dimensions stay within the range of the fitted vehicles.
        body = body.clamp(own.amin(0), own.amax(0))
        colours = self.latents[:, bodies : bodies + 3]
        distances = (colours - colours[start]).norm(dim=1)
        nearest = distances.argsort(stable=True)[: _NEIGHBOURS + 1].tolist()
        others = [index for index in nearest if index != start][:_NEIGHBOURS] or [start]
        pick, part = torch.rand(2, generator=generator).tolist()
        other = others[min(int(pick * len(others)), len(others) - 1)]
        rest = torch.lerp(self.latents[start, bodies:], self.latents[other, bodies:], part)
        return body_type, torch.cat((body, rest))

    def decode(self, body_type: str, latent: Float[Tensor, " L"], seed: int) -> LearntVehicle:
        """Draws the vehicle of a body type that a latent vector stands for.

        The seed decides pillars, roof rails and dust, which no photograph shows.
        """
        bodies = len(_NAMES)
        dimensions = BodyDimensions(*latent[:bodies].double().tolist())
        body = build_body(dimensions)
        paint, glass = cielab_to_srgb(latent[bodies : bodies + 6].view(2, 3)).clamp(0.0, 1.0)
        drawn, parts = paint_vehicle(
            body, body_type, paint=paint, glass=glass, generator=generator_of(seed, "trim")
        )
        detail = self._detail_mean + latent[bodies + 6 :] @ self._components
        on_top = unfolded(detail.view(1, 3, MAP_PX, MAP_PX // 2), TEXTURE_SIZE)[0]
        texture = (drawn.float() / 255 + on_top).clamp(0.0, 1.0)
        return LearntVehicle(body_type, body.vertices, (texture * 255).round().byte(), parts)

    def sample(self, generator: torch.Generator) -> LearntVehicle:
        """Draws a vehicle."""
        body_type, latent = self.sample_latent(generator)
        return self.decode(body_type, latent, int(torch.randint(2**31, (), generator=generator)))

    def tensors(self) -> dict[str, Tensor]:
        """Returns all that was learnt, for a file."""
        return {
            "latents": self.latents,
            "detail_mean": self._detail_mean,
            "components": self._components,
        }

    @classmethod
    def of(cls, body_types: tuple[str, ...], tensors: dict[str, Tensor]) -> "LayeredGenerator":
        """Restores a generator from what `tensors` returned.

        Raises:
            KeyError, ValueError: the tensors are those of something else.
        """
        latents, mean, components = (
            tensors[name] for name in ("latents", "detail_mean", "components")
        )
        texels = 3 * MAP_PX * (MAP_PX // 2)
        width = len(_NAMES) + _COLOURS + len(components)
        shapes = [(len(body_types), width), (texels,), (len(components), texels)]
        for values, shape in zip((latents, mean, components), shapes, strict=True):
            if values.shape != shape or values.dtype != torch.float32:
                raise ValueError("shapes do not fit")
            if float(values.abs().amax()) > _LARGEST:
                raise ValueError("no numbers of vehicles")
        for body_type, latent in zip(body_types, latents, strict=True):
            _check_dimensions(body_type, BodyDimensions(*latent[: len(_NAMES)].tolist()))
        return cls(body_types, latents, mean, components)


def _check_dimensions(body_type: str, dimensions: BodyDimensions) -> None:
    """Refuses dimensions that no stretched body of its type has: they could not be drawn."""
    ranges = BODY_RANGES[body_type]
    for name in _NAMES:
        low, high = ranges[name]
        if not (
            low / _STRETCH - _SLACK_M <= getattr(dimensions, name) <= high * _STRETCH + _SLACK_M
        ):
            raise ValueError("no dimensions of such a vehicle")
