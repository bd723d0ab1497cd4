"""Draws the pictures of the documentation with skyproof's own renderer.

They show procedural vehicles and ground, nothing else.

    python tools/make_pictures.py
    python tools/make_pictures.py runs/demo
    python tools/make_pictures.py runs/reproduce
    python tools/make_pictures.py runs/learnt

The first writes fleet, coats, scenes, weather, sharpness and clearing.png into docs/pictures; the
same code gives the same pictures. The second writes docs/pictures/demo-result.png from a finished
demo on procedural ground, the third attacks.png from the camouflages of a reproduction, the fourth
learnt.png from a generator of `skyproof learn-vehicles`: one that learnt from the 72 vehicles of
`tests.generator.photographs.take_photographs(FOLDER, 72)`.
"""

from __future__ import annotations

import math
import sys
import tempfile
from dataclasses import replace
from pathlib import Path

import torch
from PIL import Image, ImageDraw, ImageFont

from skyproof.camouflage.folder import load_camouflage
from skyproof.camouflage.random_controls import RandomPatterns, wear_random_shapes
from skyproof.detectors.detector import TrainableDetector
from skyproof.detectors.loaded import load_detector
from skyproof.ground.procedural import write_procedural_backgrounds
from skyproof.imagery.clearing.exemplar import fill_ground
from skyproof.imagery.clearing.vehicle_masks import darkness_profiles, estimate_shadow, vehicle_mask
from skyproof.layout import Layout
from skyproof.measure.measure import vehicles_seen
from skyproof.measure.score import draw_scene
from skyproof.measure.views import SceneChange, SceneRenderer, SceneView, views
from skyproof.render.dataset import placed_vehicles
from skyproof.render.portrait import close_up
from skyproof.render.renderer import TorchRenderer
from skyproof.render.settings import RenderSettings
from skyproof.results.result import MAIN_MATCH
from skyproof.results.results import Results
from skyproof.scenes.backgrounds import BackgroundSet
from skyproof.scenes.light import Light
from skyproof.scenes.sampling import sample_scenes
from skyproof.scenes.scene import BackgroundWindow, Camera, Placement, Scene, Sun, read_scenes
from skyproof.scenes.sensor import PAPER_BLUR_SIGMA_PX, Sensor
from skyproof.scenes.settings import SceneSettings
from skyproof.scenes.weather import CONDITIONS
from skyproof.vehicles.fleet import Fleet, FleetSettings, mix_fleets, sample_fleet
from skyproof.vehicles.settings import CATALOGUE_PAINTS, PaintVariety
from skyproof.vehicles.vehicle import VehicleBatch

FOLDER = Path(__file__).resolve().parents[1] / "docs" / "pictures"
GSD_M = 0.125
ENLARGE = 8
# A cell of whole pixels at 12.5 cm: 2.75 m x 6.25 m holds the longest van, nose up.
CELL_PX = (22, 50)
PER_TYPE = 4
COLUMNS = 12
PAPER, INK = (255, 255, 255), (30, 30, 30)
WEATHER_TILE_SEED, WEATHER_SCENE_SEED = 3, 11
SHARPNESS_SCENE_SEED, CLEARING_SEED = 11, 5


class PlainGround:
    """Even grey ground, as in `skyproof.render.portrait`."""

    def window(self, window: BackgroundWindow, size_px: int) -> torch.Tensor:
        """The same grey everywhere."""
        return torch.full((3, size_px, size_px), 0.46)

    def light_of(self, window: BackgroundWindow) -> Light:
        """A clear day."""
        return Light()

    def cover_of(self, window: BackgroundWindow, size_px: int) -> None:
        return None

    def sensor_of(self, window: BackgroundWindow) -> Sensor:
        """The usual one everywhere."""
        return Sensor()


def font(size: int) -> ImageFont.FreeTypeFont | ImageFont.ImageFont:
    """Pillow's own font."""
    return ImageFont.load_default(size)


def as_image(pixels: torch.Tensor) -> Image.Image:
    """`[3, H, W]` bytes to a picture."""
    return Image.fromarray(pixels.permute(1, 2, 0).contiguous().numpy())


@torch.no_grad()
def as_detectors_see(vehicles: VehicleBatch) -> torch.Tensor:
    """Draws the vehicles at 12.5 cm per pixel with the default sensor.

    Returns:
        `[N, 3, 50, 50]` bytes.
    """
    sun = Sun(azimuth_rad=math.radians(140), elevation_rad=math.radians(48))
    camera = Camera(0.0, 0.0, GSD_M, CELL_PX[1])
    scenes = [
        Scene(
            name,
            BackgroundWindow("plain", 0, 0, 0),
            camera,
            sun,
            (Placement(name, 0, 0, math.pi / 2),),
            index,
        )
        for index, name in enumerate(vehicles.ids)
    ]
    return (TorchRenderer(PlainGround())(scenes, vehicles).image * 255).round().byte()


def cells(pictures: torch.Tensor, scale: int) -> list[Image.Image]:
    """The middle strip of every square picture, enlarged by `scale` without smoothing."""
    width = CELL_PX[0] * pictures.shape[-1] // CELL_PX[1]
    left = (pictures.shape[-1] - width) // 2
    strips = [as_image(picture[:, :, left : left + width]) for picture in pictures]
    return [
        strip.resize((strip.width * scale, strip.height * scale), Image.Resampling.NEAREST)
        for strip in strips
    ]


def draw_fleet(paints: PaintVariety = CATALOGUE_PAINTS, shapes: float = 0.0) -> Image.Image:
    """Four vehicles of each body type, fine above, as detectors see them below."""
    fleets = []
    for index, body_type in enumerate(FleetSettings().weights):
        settings = FleetSettings(
            PER_TYPE,
            {body_type: 1.0},
            first_number=index * PER_TYPE,
            paints=paints,
            shapes=shapes,
        )
        fleets.append(sample_fleet(settings, generator=torch.Generator().manual_seed(24 + index)))
    fleet = wear_random_shapes(mix_fleets(fleets), generator=torch.Generator().manual_seed(24))
    names = fleet.ids
    vehicles = RandomPatterns(fleet)(fleet.batch(names))
    sharp = close_up(
        vehicles,
        gsd_m=GSD_M / ENLARGE,
        side_m=CELL_PX[1] * GSD_M,
        heading_rad=math.pi / 2,
        tilt_rad=0.0,
    )
    fine = cells(sharp, 1)
    coarse = cells(as_detectors_see(vehicles), ENLARGE)

    wide, high = fine[0].size
    gap, label, caption = 6, 30, 52
    rows = math.ceil(len(names) / COLUMNS)
    block = caption + rows * (high + label)
    sheet = Image.new("RGB", (COLUMNS * (wide + gap) + gap, 2 * block), PAPER)
    pen = ImageDraw.Draw(sheet)
    captions = (
        f"24 procedural vehicles from above, nose up, {100 * GSD_M / ENLARGE:.1f} cm per pixel, "
        "without sensor blur",
        "The same 24 at 12.5 cm per pixel with the default sensor (blur of "
        f"{Sensor.blur_sigma_px} px, noise), enlarged 8 times: what detectors see",
    )
    for part, (text, pictures) in enumerate(zip(captions, (fine, coarse), strict=True)):
        top = part * block
        pen.text((gap, top + 12), text, fill=INK, font=font(28))
        for place, (name, picture) in enumerate(zip(names, pictures, strict=True)):
            x = gap + place % COLUMNS * (wide + gap)
            y = top + caption + place // COLUMNS * (high + label)
            sheet.paste(picture, (x, y))
            pen.text(
                (x + wide / 2, y + high + label / 2), name, fill=INK, font=font(20), anchor="mm"
            )
    return sheet


@torch.no_grad()
def draw_scenes() -> Image.Image:
    """A contact sheet of rendered scenes: 2 x 4 images of 192 px on eight tiles, enlarged twice."""
    size_px, columns, count = 192, 4, 8
    fleet = sample_fleet(FleetSettings(count=40), generator=torch.Generator().manual_seed(7))
    sizes = fleet.sizes_m
    with tempfile.TemporaryDirectory() as folder:
        backgrounds = write_procedural_backgrounds(Path(folder), {"test": 16}, 386, seed=3)
        settings = SceneSettings(size_px=size_px, vehicles_minimum=2)
        drawn = sample_scenes(
            settings, backgrounds, "test", sizes, 60, generator=torch.Generator().manual_seed(5)
        )
        # One scene per kind of ground first, then any other tile, so that the sheet shows the
        # variety.
        chosen: dict[str, Scene] = {}
        for by in (
            lambda scene: backgrounds.tile(scene.background.tile).kind,
            lambda scene: scene.background.tile,
        ):
            used = {by(scene) for scene in chosen.values()}
            for scene in drawn:
                if len(chosen) < count and by(scene) not in used:
                    used.add(by(scene))
                    chosen[scene.id] = scene
        scenes = [replace(scene, id=f"{index}") for index, scene in enumerate(chosen.values())]
        frames = TorchRenderer(backgrounds)(scenes, placed_vehicles(fleet, scenes))
        kinds = [
            str(backgrounds.tile(scene.background.tile).kind).replace("_", " ") for scene in scenes
        ]
    side, gap, label = 2 * size_px, 6, 30
    sheet = Image.new(
        "RGB", (columns * (side + gap) + gap, count // columns * (side + label) + gap), PAPER
    )
    pen = ImageDraw.Draw(sheet)
    for index, pixels in enumerate((frames.image * 255).round().byte()):
        x, y = gap + index % columns * (side + gap), gap + index // columns * (side + label)
        sheet.paste(as_image(pixels).resize((side, side), Image.Resampling.NEAREST), (x, y))
        number = len(scenes[index].placements)
        pen.text((x, y + side + 3), f"{kinds[index]}, {number} vehicles", fill=INK, font=font(20))
    return sheet


@torch.no_grad()
def draw_weather_sheet() -> Image.Image:
    """One scene of 240 px under every condition: 2 x 4 pictures."""
    size_px, columns = 240, 4
    fleet = sample_fleet(FleetSettings(count=40), generator=torch.Generator().manual_seed(7))
    sizes = fleet.sizes_m
    with tempfile.TemporaryDirectory() as folder:
        backgrounds = write_procedural_backgrounds(
            Path(folder), {"test": 1}, 700, seed=WEATHER_TILE_SEED
        )
        renderer = TorchRenderer(backgrounds)
        pictures = []
        for condition in CONDITIONS:
            settings = SceneSettings(size_px=size_px, vehicles_minimum=5, conditions=(condition,))
            generator = torch.Generator().manual_seed(WEATHER_SCENE_SEED)
            scenes = sample_scenes(settings, backgrounds, "test", sizes, 1, generator=generator)
            frames = renderer(scenes, placed_vehicles(fleet, scenes))
            pictures.append((_caption(scenes[0]), as_image((frames.image[0] * 255).round().byte())))
    return _grid(pictures, columns=columns, side_px=size_px)


@torch.no_grad()
def draw_sharpness_sheet() -> Image.Image:
    """One scene of 144 px with vehicles blurred by six widths, enlarged twice: 2 x 3 pictures."""
    size_px, widths = 144, (0.4, 0.7, 1.0, 1.4, 1.8, PAPER_BLUR_SIGMA_PX)
    fleet = sample_fleet(FleetSettings(count=40), generator=torch.Generator().manual_seed(7))
    with tempfile.TemporaryDirectory() as folder:
        backgrounds = write_procedural_backgrounds(
            Path(folder), {"test": 1}, 500, seed=WEATHER_TILE_SEED
        )
        settings = SceneSettings(size_px=size_px, vehicles_minimum=5)
        generator = torch.Generator().manual_seed(SHARPNESS_SCENE_SEED)
        scenes = sample_scenes(settings, backgrounds, "test", fleet.sizes_m, 1, generator=generator)
        pictures = []
        for sigma_px in widths:
            renderer = TorchRenderer(backgrounds, RenderSettings(blur_sigma_px=sigma_px))
            frames = renderer(scenes, placed_vehicles(fleet, scenes))
            pictures.append(
                (f"blur {sigma_px} px", as_image((frames.image[0] * 255).round().byte()))
            )
    return _grid(pictures, columns=3, side_px=2 * size_px)


@torch.no_grad()
def draw_clearing_sheet() -> Image.Image:
    """Draws rendered vehicles on procedural ground.

    Beside it stand the ground that `skyproof clear` fills in, and the true ground.
    """
    size_px, count = 200, 3
    fleet = sample_fleet(FleetSettings(count=40), generator=torch.Generator().manual_seed(7))
    pictures = []
    with tempfile.TemporaryDirectory() as folder:
        backgrounds = write_procedural_backgrounds(
            Path(folder), {"test": 6}, 500, seed=CLEARING_SEED
        )
        renderer = TorchRenderer(backgrounds)
        settings = SceneSettings(size_px=size_px, vehicles_minimum=5)
        generator = torch.Generator().manual_seed(CLEARING_SEED)
        for scene in sample_scenes(
            settings, backgrounds, "test", fleet.sizes_m, count, generator=generator
        ):
            frames = renderer([scene], placed_vehicles(fleet, [scene]))
            image = (frames.image[0] * 255).round().byte()
            shadow = estimate_shadow([darkness_profiles(image, frames.boxes, gsd_m=GSD_M)])
            mask = vehicle_mask((size_px, size_px), frames.boxes, shadow, gsd_m=GSD_M, margin_m=0.4)
            true = (backgrounds.window(scene.background, size_px) * 255).round().byte()
            filled = fill_ground(image, mask)
            pictures += [
                ("rendered", as_image(image)),
                ("cleared", as_image(filled)),
                ("true ground", as_image(true)),
            ]
    return _grid(pictures, columns=3, side_px=2 * size_px)


def _grid(pictures: list[tuple[str, Image.Image]], *, columns: int, side_px: int) -> Image.Image:
    """Square pictures with their captions, row by row."""
    gap, label = 6, 30
    rows = math.ceil(len(pictures) / columns)
    sheet = Image.new(
        "RGB", (columns * (side_px + gap) + gap, rows * (side_px + label) + gap), PAPER
    )
    pen = ImageDraw.Draw(sheet)
    for index, (title, picture) in enumerate(pictures):
        x, y = gap + index % columns * (side_px + gap), gap + index // columns * (side_px + label)
        sheet.paste(picture.resize((side_px, side_px), Image.Resampling.NEAREST), (x, y))
        pen.text((x, y + side_px + 3), title, fill=INK, font=font(17))
    return sheet


def _caption(scene: Scene) -> str:
    """The condition and the number that makes it."""
    weather = scene.weather
    return {
        "clear": "clear",
        "haze": f"haze {weather.haze:.2f}",
        "rain": f"rain, wetness {weather.wetness:.2f}",
        "low_sun": f"low sun, {math.degrees(scene.sun.elevation_rad):.0f}°",
        "overcast": f"overcast {weather.overcast:.2f}",
        "exposure": f"exposure, {weather.exposure_stops:+.2f} stops",
        "noise": f"noise {weather.noise:.3f}",
        "jpeg": f"jpeg, quality {weather.jpeg_quality}",
    }[weather.condition]


def draw_demo_result(run_folder: Path, count: int = 8) -> Image.Image:
    """The demo's first test scenes: as built, then in T-PixFcMa before and after hardening."""
    rows: list[list[Image.Image]] = []
    for folder in (run_folder, run_folder / "hardened"):
        if Results.open(folder).sources != ["procedural"]:
            raise SystemExit(
                "expected a demo on procedural ground: pictures in the repository show procedural "
                "data"
            )
        layout = Layout(folder)
        detector = load_detector(layout.detector("retinanet"))
        texture = SceneChange("texture", load_camouflage(layout.camouflage("T-PixFcMa")))
        renderer = TorchRenderer(BackgroundSet.open(layout.backgrounds))
        stage = SceneRenderer(Fleet.load(layout.fleets / "test"), renderer)
        scenes = read_scenes(layout.scenes("test"))[:count]
        seen = views([detector], scenes, [texture], stage, progress=lambda _: None)
        drawn = [_detections(view, detector) for view in seen]
        rows += drawn[1:] if rows else drawn
    side, gap, label = 180, 4, 36
    sheet = Image.new("RGB", (count * (side + gap) + gap, len(rows) * (side + label) + gap), PAPER)
    pen = ImageDraw.Draw(sheet)
    texts = (
        "As built. RetinaNet: found green, missed orange and dashed, false alarm yellow and dotted",
        "Blocks in five ground colours on painted panels (T-PixFcMa), optimised against it",
        "After hardening, with such blocks optimised against the hardened RetinaNet",
    )
    for number, (row, text) in enumerate(zip(rows, texts, strict=True)):
        top = number * (side + label)
        pen.text((gap, top + 3), text, fill=INK, font=font(26))
        for column, picture in enumerate(row):
            place = (gap + column * (side + gap), top + label)
            sheet.paste(picture.resize((side, side), Image.Resampling.LANCZOS), place)
    return sheet


def _detections(view: SceneView, detector: TrainableDetector) -> list[Image.Image]:
    """Draws the detections in each image of a view, as the report does."""
    seen = vehicles_seen(view, detector, MAIN_MATCH)
    pictures = []
    for number, found in enumerate(view.found[detector.name]):
        boxes = view.images.boxes[number].numpy()
        vehicles = [
            (boxes[place], hit, score)
            for (image, place), (hit, score, _) in seen.items()
            if image == number
        ]
        pixels = view.images.image(number).permute(1, 2, 0).numpy()
        answer = (found.boxes.numpy(), found.scores.numpy(), detector.threshold)
        pictures.append(draw_scene(pixels, vehicles, *answer))
    return pictures


def draw_attacks(run_folder: Path) -> Image.Image:
    """Draws one saloon from above in every texture and shape that a reproduction learnt first.

    Each stands beside its map.
    """
    fleet = sample_fleet(
        FleetSettings(count=1, weights={"saloon": 1.0}), generator=torch.Generator().manual_seed(4)
    )
    saloon = fleet.batch(fleet.ids)
    width, height, map_px, per_row, head = 150, 330, 150, 6, 24
    rows = [
        ["T-U", "T-Pix", "T-Lc", "T-PixLc", "T-Fc", "T-PixFc"],
        ["T-Ma", "T-PixMa", "T-LcMa", "T-PixLcMa", "T-FcMa", "T-PixFcMa"],
        ["S-O@0.2", "S-O@0.4", "S-O@0.7", "C-Fc-seq@0.2", "C-PixFc-seq@0.4", "C-PixFc-par@0.2"],
    ]
    cell = (width + map_px + 16, height + head)
    sheet = Image.new("RGB", (per_row * cell[0] + 10, len(rows) * cell[1] + 6), PAPER)
    pen = ImageDraw.Draw(sheet)
    for row, names in enumerate(rows):
        for column, name in enumerate(names):
            folder = run_folder / "camouflages" / f"{name}-0"
            x, y = column * cell[0] + 10, row * cell[1] + 6
            pen.text((x, y), name, fill=INK, font=font(16))
            side_m = 0.02 * height
            shot = close_up(
                load_camouflage(folder)(saloon), gsd_m=0.02, side_m=side_m, heading_rad=math.pi / 2
            )[0]
            car = as_image(shot)
            left = (car.width - width) // 2
            sheet.paste(car.crop((left, 0, left + width, height)), (x, y + head))
            maps = [
                folder / file
                for file in ("texture.png", "displacement.png")
                if (folder / file).exists()
            ]
            for index, path in enumerate(maps):
                with Image.open(path) as image:
                    flat = image.convert("RGB").resize((map_px, map_px), Image.Resampling.NEAREST)
                sheet.paste(flat, (x + width + 4, y + head + index * (map_px + 4)))
    return sheet


def draw_learnt(folder: Path) -> Image.Image:
    """Shows what a generator learnt from photographs that the tests draw."""
    width_px = 1344
    shown = (
        ("Photograph, fit, difference, cut-out, texture, parts, how much is seen", "fits/00001", 4),
        ("Samples at 1.6 cm and at 12.5 cm per pixel, and their part maps", "samples", 3),
    )
    heights_px = {"fits/00001": 208, "samples": 208}
    strips = []
    for caption, name, rows in shown:
        with Image.open(folder / f"{name}.png") as image:
            strip = image.convert("RGB").crop((0, 0, image.width, rows * heights_px[name]))
        height_px = round(strip.height * width_px / strip.width)
        strips.append((caption, strip.resize((width_px, height_px), Image.Resampling.LANCZOS)))
    head = 28
    sheet = Image.new("RGB", (width_px, sum(strip.height + head for _, strip in strips)), "white")
    top = 0
    for caption, strip in strips:
        ImageDraw.Draw(sheet).text((4, top + 5), caption, fill="black", font=font(15))
        sheet.paste(strip, (0, top + head))
        top += strip.height + head
    return sheet


def main() -> None:
    """Writes the pictures asked for."""
    FOLDER.mkdir(parents=True, exist_ok=True)
    if len(sys.argv) > 1 and (Path(sys.argv[1]) / "camouflages" / "S-O@0.4-0").exists():
        sheets = {"attacks.png": draw_attacks(Path(sys.argv[1]))}
    elif len(sys.argv) > 1 and (Path(sys.argv[1]) / "generator.json").exists():
        sheets = {"learnt.png": draw_learnt(Path(sys.argv[1]))}
    elif len(sys.argv) > 1:
        sheets = {"demo-result.png": draw_demo_result(Path(sys.argv[1]))}
    else:
        sheets = {
            "fleet.png": draw_fleet(),
            "coats.png": draw_fleet(PaintVariety(0.25, 0.25, 0.25, 0.25), shapes=0.25),
            "scenes.png": draw_scenes(),
            "weather.png": draw_weather_sheet(),
            "sharpness.png": draw_sharpness_sheet(),
            "clearing.png": draw_clearing_sheet(),
        }
    for name, sheet in sheets.items():
        path = FOLDER / name
        sheet.save(path, optimize=True)
        print(f"{path.name}: {sheet.width} x {sheet.height} px, {path.stat().st_size // 1024} KB")


if __name__ == "__main__":
    main()
