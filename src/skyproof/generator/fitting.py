"""Fits drawn bodies to photographed vehicles through the differentiable renderer."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
import torch.nn.functional as F
from jaxtyping import Float, Int
from torch import Tensor, nn

from skyproof.generator.fits import Fit, Layers, Prototype, coarser, coloured
from skyproof.generator.maps import MAP_PX, unfolded
from skyproof.generator.photographed import Photographed, shown_pixels
from skyproof.generator.settings import FitSettings
from skyproof.geometry.colour import linear_to_srgb, srgb_to_linear
from skyproof.geometry.projection import rotate_about_vertical
from skyproof.render.lighting import scene_lights
from skyproof.render.renderer import TorchRenderer, photographs
from skyproof.render.settings import RenderSettings
from skyproof.scenes.backgrounds import BackgroundSet
from skyproof.scenes.scene import Scene
from skyproof.vehicles.painting import GLASS_SRGB
from skyproof.vehicles.template import make_template
from skyproof.vehicles.vehicle import Template, VehicleBatch

_TEXTURE_PX = 128
_SUPERSAMPLING = 3
# Prior standard deviations of what a fit may change, and the weights of this prior.
_SHIFT_SD_M = 0.25
_TURN_SD_RAD = math.radians(4)
_STRETCH_SD = 0.04
_GLASS_SD = 0.08
_DETAIL_SD = 0.06
_PRIOR_WEIGHT = 0.0015
_SMOOTHNESS_WEIGHT = 0.02
# Errors beyond this, in sRGB, count by their size and no longer by its square: glints, and ground
# that was guessed.
_LARGE_ERROR = 0.03
_RATES = {"shift": 0.03, "turn": 0.012, "stretch": 0.008, "paint": 0.04, "glass": 0.02}
_DETAIL_RATE = 0.015


class _Candidates(nn.Module):
    """Rows of bodies that are moved, stretched and coloured; each stands in a scene of its own."""

    def __init__(
        self, prototypes: "_Bodies", chosen: Int[Tensor, " N"], paint: Float[Tensor, "N 3"]
    ) -> None:
        super().__init__()
        count = len(chosen)
        self.chosen = chosen
        self._prototypes = prototypes
        self.shift = nn.Parameter(torch.zeros(count, 2))
        self.turn = nn.Parameter(torch.zeros(count))
        self.stretch = nn.Parameter(torch.zeros(count, 2))
        self.paint = nn.Parameter(paint.clone())
        self.glass = nn.Parameter(torch.tensor(GLASS_SRGB).expand(count, 3).clone())
        self.detail = nn.Parameter(torch.zeros(count, 3, MAP_PX, MAP_PX // 2))

    def rows(self, rows: Int[Tensor, " M"]) -> "_Candidates":
        """Returns some of the candidates, to be fitted further."""
        kept = _Candidates(self._prototypes, self.chosen[rows], self.paint.detach()[rows])
        with torch.no_grad():
            for name, value in self.named_parameters():
                getattr(kept, name).copy_(value[rows])
        return kept

    def vehicles(self) -> VehicleBatch:
        """Returns the vehicles as they are now, differentiably."""
        bodies = self._prototypes
        stretch = torch.cat((self.stretch.exp(), torch.ones(len(self.chosen), 1)), dim=1)
        vertices = bodies.vertices[self.chosen] * stretch[:, None]
        vertices = rotate_about_vertical(vertices, self.turn)
        vertices = vertices + F.pad(self.shift, (0, 1))[:, None]
        texture = coloured(bodies.layers[self.chosen], self.paint, self.glass)
        texture = texture + unfolded(self.detail, _TEXTURE_PX)
        ids = tuple(str(number) for number in range(len(self.chosen)))
        return VehicleBatch(
            bodies.template, vertices, texture.clamp(0.0, 1.0), bodies.parts[self.chosen], ids
        )

    def improbability(self) -> Float[Tensor, " N"]:
        """Returns a penalty for each candidate's distance from the prior and for rough detail."""
        glass = self.glass - torch.tensor(GLASS_SRGB)
        terms = (
            (self.shift / _SHIFT_SD_M).square().sum(1)
            + (self.turn / _TURN_SD_RAD).square()
            + (self.stretch / _STRETCH_SD).square().sum(1)
            + (glass / _GLASS_SD).square().sum(1)
            + (self.detail / _DETAIL_SD).square().mean((1, 2, 3))
        )
        along, around = (self.detail.diff(dim=dim).abs().mean((1, 2, 3)) for dim in (2, 3))
        return _PRIOR_WEIGHT * terms + _SMOOTHNESS_WEIGHT * (along + around)

    @torch.no_grad()
    def project_(self) -> None:
        """Keeps colours between black and white."""
        self.paint.clamp_(0.0, 1.0)
        self.glass.clamp_(0.0, 1.0)


@dataclass(frozen=True)
class _Bodies:
    """The prototypes' surfaces and textures, in one tensor each."""

    template: Template
    vertices: Float[Tensor, "P V 3"]
    layers: Layers
    parts: Tensor
    sizes_m: Float[Tensor, "P 2"]


class Fitter:
    """Fits photographed vehicles one after the other; each fit depends on its own picture alone.

    `cleared` has the photographs of `tiles` without their vehicles.
    """

    def __init__(
        self,
        tiles: BackgroundSet,
        cleared: BackgroundSet,
        prototypes: Sequence[Prototype],
        settings: FitSettings,
    ) -> None:
        self._tiles = tiles
        self._settings = settings
        # No noise is added, because a photograph has its own.
        self._renderer = TorchRenderer(
            cleared, RenderSettings(supersampling=_SUPERSAMPLING, noise=0.0)
        )
        vertices = torch.stack([prototype.vertices for prototype in prototypes])
        self._bodies = _Bodies(
            make_template(),
            vertices,
            torch.stack([coarser(prototype.layers, _TEXTURE_PX) for prototype in prototypes]),
            torch.stack([prototype.parts for prototype in prototypes]),
            (vertices.amax(1) - vertices.amin(1))[:, :2],
        )

    def __call__(self, vehicle: Photographed) -> Fit:
        """Fits one vehicle."""
        chosen = self._nearest(vehicle)
        scenes = [vehicle.scene] * len(chosen) + [_reversed(vehicle.scene)] * len(chosen)
        both = torch.cat((chosen, chosen))
        candidates = _Candidates(self._bodies, both, self._paint(vehicle).expand(len(both), 3))
        errors = self._descend(candidates, vehicle, scenes, self._settings.choose_steps, False)
        best = int(errors.argmin())
        other = errors[len(chosen) :] if best < len(chosen) else errors[: len(chosen)]
        fitted = candidates.rows(torch.tensor([best]))
        self._descend(fitted, vehicle, scenes[best : best + 1], self._settings.steps, True)
        return self._result(
            vehicle, fitted, scenes[best], best >= len(chosen), float(other.min() - errors[best])
        )

    def pictures(
        self, vehicle: Photographed, fit: Fit
    ) -> tuple[Float[Tensor, "3 S S"], Float[Tensor, "3 S S"]]:
        """Returns the photograph of a vehicle, and the rendered picture of its fit."""
        candidates = self._of_fit(fit)
        scene = _reversed(vehicle.scene) if fit.reversed else vehicle.scene
        with torch.no_grad():
            rendered = self._renderer([scene], candidates.vehicles()).image[0]
        return self._photograph(vehicle), rendered

    def _of_fit(self, fit: Fit) -> _Candidates:
        candidates = _Candidates(self._bodies, torch.tensor([fit.prototype]), fit.paint[None])
        with torch.no_grad():
            candidates.shift.copy_(torch.tensor([fit.shift_m]))
            candidates.turn.fill_(fit.turn_rad)
            candidates.stretch.copy_(torch.tensor([fit.stretch]).log())
            candidates.glass.copy_(fit.glass[None])
            candidates.detail.copy_(fit.detail[None])
        return candidates

    def _photograph(self, vehicle: Photographed) -> Float[Tensor, "3 S S"]:
        return photographs(self._tiles, [vehicle.scene], torch.device("cpu"))[0]

    def _nearest(self, vehicle: Photographed) -> Int[Tensor, " K"]:
        """Chooses the bodies whose length and width are nearest to the vehicle's."""
        size = torch.tensor([vehicle.length_m, vehicle.width_m])
        off = ((self._bodies.sizes_m - size) / torch.tensor([0.3, 0.15])).square().sum(1)
        count = min(self._settings.candidates, len(off))
        return off.argsort(stable=True)[:count].sort().values

    def _paint(self, vehicle: Photographed) -> Float[Tensor, " 3"]:
        """Guesses the paint: of the pixels well inside the vehicle, the median in full light."""
        shown = srgb_to_linear(self._photograph(vehicle))
        light = self._renderer.backgrounds.light_of(vehicle.scene.background)
        lights = scene_lights([light], [vehicle.scene], shown)
        inside = shown_pixels(vehicle, -0.25)
        inside = inside if bool(inside.any()) else shown_pixels(vehicle, 0.0)
        received = lights.received(shown[None])[0][:, inside]
        return linear_to_srgb(received.median(dim=1).values.clamp(0.0, 1.0))

    def _descend(
        self,
        candidates: _Candidates,
        vehicle: Photographed,
        scenes: list[Scene],
        steps: int,
        with_detail: bool,
    ) -> Float[Tensor, " N"]:
        """Takes optimiser steps, and returns each row's remaining error plus improbability."""
        target = self._photograph(vehicle)
        shown = shown_pixels(vehicle)
        # The detail needs no gradient before it is fitted.
        candidates.detail.requires_grad_(with_detail)
        groups = [
            {"params": [getattr(candidates, name)], "lr": rate} for name, rate in _RATES.items()
        ]
        if with_detail:
            groups.append({"params": [candidates.detail], "lr": _DETAIL_RATE})
        optimiser = torch.optim.Adam(groups, betas=(0.8, 0.98))
        schedule = torch.optim.lr_scheduler.LambdaLR(
            optimiser, lambda step: 0.1 + 0.9 * 0.5 * (1 + math.cos(math.pi * step / steps))
        )
        for _ in range(steps):
            optimiser.zero_grad()
            self._errors(candidates, scenes, target, shown).sum().backward()
            optimiser.step()
            schedule.step()
            candidates.project_()
        with torch.no_grad():
            return self._errors(candidates, scenes, target, shown)

    def _errors(
        self, candidates: _Candidates, scenes: list[Scene], target: Tensor, shown: Tensor
    ) -> Float[Tensor, " N"]:
        image = self._renderer(scenes, candidates.vehicles()).image
        difference = (image - target)[:, :, shown]
        robust = torch.hypot(difference, difference.new_tensor(_LARGE_ERROR)) - _LARGE_ERROR
        return robust.mean((1, 2)) + candidates.improbability()

    def _result(
        self,
        vehicle: Photographed,
        fitted: _Candidates,
        scene: Scene,
        reversed_: bool,
        runner_up: float,
    ) -> Fit:
        image = self._renderer([scene], fitted.vehicles()).image[0]
        shown = shown_pixels(vehicle)
        (to_detail,) = torch.autograd.grad(image[:, shown].sum(), [fitted.detail])
        seen = to_detail[0].abs().mean(0)
        misfit = (image.detach() - self._photograph(vehicle))[:, shown].abs().mean()
        along, across = fitted.shift.detach()[0].tolist()
        length, width = fitted.stretch.detach()[0].exp().tolist()
        return Fit(
            id=vehicle.scene.id,
            prototype=int(fitted.chosen[0]),
            reversed=reversed_,
            shift_m=(along, across),
            turn_rad=float(fitted.turn.detach()[0]),
            stretch=(length, width),
            paint=fitted.paint.detach()[0],
            glass=fitted.glass.detach()[0],
            detail=fitted.detail.detach()[0],
            seen=seen / seen.max().clamp(min=1e-9),
            misfit=float(misfit),
            runner_up=runner_up,
        )


def _reversed(scene: Scene) -> Scene:
    placement = scene.placements[0]
    turned = replace(placement, heading_rad=placement.heading_rad + math.pi)
    return replace(scene, placements=(turned,))
