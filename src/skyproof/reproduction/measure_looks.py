"""What camouflages look like: colours of textures, how alike repeats are, and sheets of samples."""

from __future__ import annotations

import itertools
from collections import Counter, defaultdict
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import torch
from jaxtyping import Bool, Float, UInt8
from msgspec import to_builtins
from msgspec.structs import replace
from torch import Tensor

from skyproof.camouflage.folder import load_camouflage
from skyproof.camouflage.name import CamouflageName
from skyproof.camouflage.texture import UniversalTexture
from skyproof.console import progress_bar, say
from skyproof.datasets.dataset import Dataset
from skyproof.errors import ConfigurationError
from skyproof.files import finished_folder, write_json
from skyproof.geometry.colour import linear_to_srgb, srgb_to_cielab, srgb_to_linear
from skyproof.pictures import write_png
from skyproof.render.dataset import placed_vehicles
from skyproof.render.renderer import TorchRenderer
from skyproof.render.settings import RenderSettings
from skyproof.reproduction.practicality import practicality_account, worn_texels
from skyproof.reproduction.stored import Looks, PairLooks, Strip, TextureLooks
from skyproof.results.score_folder import is_pictured
from skyproof.scenes.backgrounds import BackgroundSet
from skyproof.scenes.scene import Scene
from skyproof.vehicles.fleet import Fleet
from skyproof.vehicles.texels import texel_metric
from skyproof.vehicles.vehicle import TEXTURE_SIZE, VehicleBatch

_SEEN_TEXELS = 4
"""Side in texels of the blocks that the renderer reads most: five samples in eight see the mean of
4 x 4 texels (docs/conventions.md)."""

_BINS = 16
"""Bins of a channel's histogram. A channel is at an end in the first and the last of them."""

_SAMPLES = 6
"""Scenes of a sheet."""

_CROP_PX = 48

_SENSOR_STEPS = {
    "one sample a pixel": RenderSettings(
        supersampling=1, shadow_supersampling=1, blur_sigma_px=0.0
    ),
    "anti-aliasing": RenderSettings(blur_sigma_px=0.0),
    "anti-aliasing and blur": RenderSettings(),
}


def write_looks(
    *,
    out: Path,
    original: Path,
    camouflages: Sequence[Path],
    finished: Sequence[Path],
    backgrounds: Path,
    fleet: Path,
) -> None:
    """Measures what camouflages look like on a fleet, and draws samples of them in `out`.

    The practicality of `finished` ones is measured beside it.
    """
    vehicles = Fleet.load(fleet)
    with finished_folder(out) as partial, progress_bar("looks") as update:
        batch = vehicles.batch(vehicles.ids)
        looks = measure_looks(camouflages, batch, update)
        rows = [
            {**practicality_account(load_camouflage(each), batch), "name": each.name}
            for each in finished
        ]
        write_json(partial / "practicality.json", {"vehicles": len(batch), "rows": rows})
        ground = BackgroundSet.open(backgrounds)
        every = Dataset.open(original).scenes
        scenes = [scene for scene in every if scene.placements][:_SAMPLES]
        if scenes:
            shown = {folder.name: load_camouflage(folder) for folder in _extremes(camouflages)}
            looks = replace(
                looks,
                samples=_drawn(partial, "samples", _sample_strips(scenes, vehicles, ground, shown)),
                sensor=_drawn(partial, "sensor", _sensor_strips(scenes, vehicles, ground)),
            )
        write_json(partial / "looks.json", to_builtins(looks))
    say(f"Looks of {len(camouflages)} camouflages: {out.resolve()}")


def _extremes(camouflages: Sequence[Path]) -> dict[Path, None]:
    """The first and the last texture, shape and combination: the freest, the most constrained."""
    kinds = defaultdict(list)
    for folder in camouflages:
        name = CamouflageName.read(folder.name)
        if is_pictured(name):
            kinds[name.kind].append(folder)
    return dict.fromkeys(
        folder for folders in kinds.values() for folder in folders[:: len(folders) - 1 or 1]
    )


def _drawn(
    folder: Path, sheet: str, strips: Iterable[tuple[str, UInt8[Tensor, "3 H W"]]]
) -> list[Strip]:
    found = []
    for number, (label, pixels) in enumerate(strips):
        file = f"{sheet}/{number}.png"
        write_png(folder / file, pixels.permute(1, 2, 0).numpy())
        found.append(Strip(label, file))
    return found


@torch.no_grad()
def _sample_strips(
    scenes: Sequence[Scene],
    fleet: Fleet,
    backgrounds: BackgroundSet,
    camouflages: Mapping[str, Callable[[VehicleBatch], VehicleBatch]],
) -> Iterator[tuple[str, UInt8[Tensor, "3 H W"]]]:
    """Draws the same scenes as bare ground, as built, and camouflaged, each with what is shown."""
    side_px = scenes[0].camera.size_px
    yield "ground", _strip([backgrounds.window(scene.background, side_px) for scene in scenes])
    vehicles = placed_vehicles(fleet, scenes)
    renderer = TorchRenderer(backgrounds)
    yield "as built", _strip(list(renderer(scenes, vehicles).image))
    for name, camouflage in camouflages.items():
        yield name, _strip(list(renderer(scenes, camouflage(vehicles)).image))


@torch.no_grad()
def _sensor_strips(
    scenes: Sequence[Scene], fleet: Fleet, backgrounds: BackgroundSet
) -> Iterator[tuple[str, UInt8[Tensor, "3 H W"]]]:
    """One vehicle of each scene by the renderer's steps towards a photograph (S2.1, S2.2)."""
    vehicles = placed_vehicles(fleet, scenes)
    for label, settings in _SENSOR_STEPS.items():
        frames = TorchRenderer(backgrounds, settings)(scenes, vehicles)
        crops = []
        for index, image in enumerate(frames.image):
            box = frames.boxes[frames.scene_index == index][0]
            across, down = ((box[:2] + box[2:]) / 2).tolist()
            left, top = (
                round(min(max(middle - _CROP_PX / 2, 0), image.shape[-1] - _CROP_PX))
                for middle in (across, down)
            )
            crops.append(image[:, top : top + _CROP_PX, left : left + _CROP_PX])
        yield label, _strip(crops)


def _strip(images: Sequence[Float[Tensor, "3 H W"]]) -> UInt8[Tensor, "3 H sheet"]:
    return (torch.cat([image.cpu() for image in images], dim=2) * 255).round().byte()


def measure_looks(
    folders: Sequence[Path], vehicles: VehicleBatch, progress: Callable[[int, int], None]
) -> Looks:
    """Measures textures where vehicles show them; compares repeats, and as many random draws."""
    compared = _compared([folder.name for folder in folders])
    # Which texels show a texture depends on its mask alone.
    areas: dict[bool, Float[Tensor, "512 512"]] = {}
    worn: dict[str, tuple[Worn, Worn]] = {}
    textures = []
    for done, folder in enumerate(folders, 1):
        texture = load_camouflage(folder)
        if isinstance(texture, UniversalTexture):
            masked = texture.constraints.masked
            if masked not in areas:
                areas[masked] = worn_area(vehicles, texture.mask(vehicles))
            textures.append(count_colours(folder.name, texture.bytes(), areas[masked]))
            if folder.name in compared:
                fine = Worn(texture.bytes().float() / 255, areas[masked])
                worn[folder.name] = (fine, fine.seen())
        progress(done, len(folders))
    pairs = []
    for first, second in itertools.combinations(worn, 2):
        if compared[first] == compared[second]:
            (one, seen_one), (other, seen_other) = worn[first], worn[second]
            pairs.append(
                PairLooks(first, second, *likeness(one, other), *likeness(seen_one, seen_other))
            )
    return Looks(len(vehicles), textures, pairs)


def _compared(names: Sequence[str]) -> dict[str, CamouflageName]:
    """Returns the attack or control of each compared repeat: optimised ones, and as many draws."""
    pooled = {name: CamouflageName.read(name).pooled for name in names}
    optimised = Counter(of for of in pooled.values() if not of.random)
    most: Counter[CamouflageName] = Counter()
    for of, repeats in optimised.items():
        most[of.control] = max(most[of.control], repeats)
    kept: dict[str, CamouflageName] = {}
    for name, of in pooled.items():
        if not of.random or list(kept.values()).count(of) < most[of]:
            kept[name] = of
    return kept


@dataclass(frozen=True)
class Worn:
    """A texture's colours, sRGB in [0, 1], and the area of each on the vehicles that wear it."""

    colours: Float[Tensor, "3 H W"]
    area: Float[Tensor, "H W"]

    def seen(self) -> Worn:
        """Averages over blocks of 4 x 4 texels, in linear light, as the renderer does."""
        total = _summed(self.area)
        light = _summed(srgb_to_linear(self.colours) * self.area)
        return Worn(linear_to_srgb(light / total.clamp(min=1e-12)), total)


def likeness(first: Worn, second: Worn) -> tuple[float | None, float]:
    """Returns correlation and distance of two textures, weighted by the area that both cover."""
    area = torch.minimum(first.area, second.area).double().flatten()
    shares = area / area.sum()
    one, other = (worn.colours.double().flatten(1) for worn in (first, second))
    one = one - (one @ shares)[:, None]
    other = other - (other @ shares)[:, None]
    spread = ((one**2 @ shares) * (other**2 @ shares)).sqrt()
    products = ((one * other) @ shares / spread).clamp(-1.0, 1.0)
    correlation = float(products.mean()) if bool((spread > 1e-9).all()) else None
    cielab = [srgb_to_cielab(worn.colours.flatten(1).T) for worn in (first, second)]
    return correlation, float((cielab[0] - cielab[1]).norm(dim=-1).double() @ shares)


def _summed(values: Float[Tensor, "*C H W"]) -> Float[Tensor, "*C h w"]:
    return values.unflatten(-1, (-1, _SEEN_TEXELS)).unflatten(-3, (-1, _SEEN_TEXELS)).sum((-3, -1))


def count_colours(
    name: str, colours: UInt8[Tensor, "3 ..."], area: Float[Tensor, ...]
) -> TextureLooks:
    """Counts colours of 8 bits by where they lie in the RGB cube, each by its area."""
    bins = colours.flatten(1).long() // (256 // _BINS)
    weights = area.flatten().double()
    whole = float(weights.sum())
    if whole <= 0:
        raise ConfigurationError(
            "Counting colours expects an area above 0, got none; give vehicles that wear them."
        )
    shares = weights / whole
    channels = ((bins == 0) | (bins == _BINS - 1)).sum(0)
    # Sums of many shares may be a little above one.
    faces, edges, corners = (
        min(float(shares[channels >= least].sum()), 1.0) for least in (1, 2, 3)
    )
    histogram = [
        torch.bincount(channel, weights=shares, minlength=_BINS).clamp(max=1.0).tolist()
        for channel in bins
    ]
    return TextureLooks(name, faces, edges, corners, histogram)


def worn_area(
    vehicles: VehicleBatch, mask: Bool[Tensor, "N 512 512"] | None
) -> Float[Tensor, "512 512"]:
    """Returns the area of each texel that shows a texture, in m², mean over the vehicles."""
    worn = worn_texels(vehicles, mask)
    total = torch.zeros(TEXTURE_SIZE, TEXTURE_SIZE)
    # One by one: the maps of a whole fleet take gigabytes.
    for index, texels in enumerate(worn):
        _, _, area = texel_metric(vehicles.row(index))
        total += area[0].masked_fill(~texels, 0.0)
    return total / len(worn)
