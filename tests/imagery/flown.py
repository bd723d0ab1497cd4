"""Photographs of drawn ground at known places, headings and scales."""

import math
from dataclasses import dataclass

import numpy as np
import torch
from PIL import Image, ImageDraw

from skyproof.ground.procedural import draw_ground
from skyproof.imagery.labels.label import ImageLabels, Label

GSD_M = 0.125


@dataclass(frozen=True)
class Flown:
    """A photograph: its pixel z, x + iy, shows the pixel `turn` z + `start` of ground `place`."""

    place: int
    turn: complex
    start: complex
    side_px: int
    image: Image.Image
    vehicles: list

    def to_ground(self, z):
        return self.turn * z + self.start


def photograph(ground, place, middle, turn, side_px, vehicles=()):
    """Photographs ground around a pixel, with vehicles: four corners in its pixels and a colour.

    Without a colour they cannot be seen.
    """
    turn = complex(turn)
    start = middle - turn * (side_px + side_px * 1j) / 2
    picture = ground.copy()
    draw = ImageDraw.Draw(picture)
    for corners, colour in vehicles:
        if colour is not None:
            draw.polygon([(z.real, z.imag) for z in corners], fill=colour)
    affine = (turn.real, -turn.imag, start.real, turn.imag, turn.real, start.imag)
    size = (side_px, side_px)
    image = picture.transform(size, Image.Transform.AFFINE, affine, Image.Resampling.BICUBIC)
    seen = [[(z - start) / turn for z in corners] for corners, _ in vehicles]
    return Flown(place, turn, start, side_px, image, seen)


def fly(rng, *, places, each, side_px=480, ground_px=1000, seed=0, gsd_m=GSD_M):
    """Photographs drawn places with any heading, 0.7 to 1.3 times the scale, in another light.

    Of 60 vehicles that stand on the ground four in ten move.
    """
    flown = []
    finer = GSD_M / gsd_m
    for place in range(places):
        generator = torch.Generator().manual_seed(1000 * seed + place)
        drawn = draw_ground(ground_px, gsd_m, generator=generator).image
        ground = Image.fromarray(drawn.permute(1, 2, 0).numpy())
        stand = rng.uniform(60 * finer, ground_px - 60 * finer, (60, 2)) @ [1, 1j]
        heading = np.exp(1j * rng.uniform(0, math.pi, 60))
        moves = rng.random(60) < 0.4
        colours = [tuple(map(int, colour)) for colour in rng.integers(0, 255, (60, 3))]
        for _ in range(each):
            at = stand + moves * (rng.normal(0, 60 * finer, (60, 2)) @ [1, 1j])
            box = finer * np.array([18 + 7.5j, 18 - 7.5j, -18 - 7.5j, -18 + 7.5j])
            corners = at[:, None] + heading[:, None] * box
            scale = math.exp(rng.uniform(math.log(0.7), math.log(1.3)))
            turn = scale * np.exp(1j * rng.uniform(0, 2 * math.pi))
            room = max(0.0, ground_px / 2 - 0.72 * side_px * scale)
            middle = ground_px * (0.5 + 0.5j) + complex(rng.uniform(-room, room, 2) @ [1, 1j])
            vehicles = list(zip(corners, colours, strict=True))
            one = photograph(ground, place, middle, complex(turn), side_px, vehicles)
            light = np.asarray(one.image, np.float32) / 255 * rng.uniform(0.7, 1.25)
            light = np.clip(light, 0, 1) ** rng.uniform(0.8, 1.25)
            light += rng.normal(0, rng.uniform(0.005, 0.03), light.shape)
            image = Image.fromarray((np.clip(light, 0, 1) * 255).astype(np.uint8))
            flown.append(Flown(place, one.turn, one.start, side_px, image, one.vehicles))
    return flown


def store(flown, folder, quality=75):
    """Writes the photographs as JPEG; returns their paths and labels."""
    paths, labels = [], {}
    for number, one in enumerate(flown):
        paths.append(folder / f"{number:03d}.jpg")
        one.image.save(paths[-1], quality=quality)
        labels[paths[-1].stem] = tuple(
            Label("car", tuple((z.real, z.imag) for z in corners))
            for corners in one.vehicles
            if min(np.mean(corners).real, np.mean(corners).imag) >= 0
            and max(np.mean(corners).real, np.mean(corners).imag) < one.side_px
        )
    return paths, ImageLabels(("car",), labels, {})


def overlap(one, other):
    """The share of the smaller photograph's ground that both show."""
    from shapely import Polygon

    outlines = []
    for each in (one, other):
        side = each.side_px
        corners = (each.to_ground(z) for z in (0, side, side + side * 1j, side * 1j))
        outlines.append(Polygon([(z.real, z.imag) for z in corners]))
    smaller = min(outline.area for outline in outlines)
    return outlines[0].intersection(outlines[1]).area / smaller
