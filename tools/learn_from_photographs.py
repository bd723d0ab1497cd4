"""Photographs to learn from, and detectors that learn from them outside skyproof.

    python tools/learn_from_photographs.py prepare --kit kit_ais_munich --drone minsk_drone
    python tools/learn_from_photographs.py yolo
    python tools/learn_from_photographs.py torchvision --drawn DATASET
    python tools/learn_from_photographs.py frames --kit kit_ais_munich --drone minsk_drone

`prepare` cuts the second place of the KIT AIS frames and the drone's `*.jpg` into tiles of 12 cm
per pixel with YOLO labels, and puts the first place aside. `yolo` has Ultralytics' own trainer
learn from the tiles; `torchvision` is a plain loop that is shown rendered scenes as well, such as

    skyproof ground --out drawn/ground --tiles 64 4 4 4 --tiling.gsd-m 0.12 --seed 5
    skyproof vehicles --out drawn/fleets --counts 96 4 4 4 --seed 5
    skyproof scenes --backgrounds drawn/ground --fleet drawn/fleets/train --split train --seed 5 \\
        --count 700 --settings.size-px 256 --settings.vehicles-maximum 8 --out drawn/train.jsonl
    skyproof render --scenes drawn/train.jsonl --backgrounds drawn/ground \\
        --fleet drawn/fleets/train --out drawn/train

Each of the two trainings takes 45 minutes on one core.

`frames` is for `skyproof ground`, which takes photographs of one resolution: it puts the first
place of the KIT AIS frames and the drone's pictures, reduced to that place's 11.6 cm per pixel,
into one folder with their labels.
"""

from __future__ import annotations

import random
import shutil
import subprocess
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
import tyro
from PIL import Image
from torch import Tensor
from torch.nn import functional
from torchvision.models.detection import fasterrcnn_mobilenet_v3_large_fpn

import skyproof as sp
from skyproof.cli.console import say

GSD_M = 0.12
FIRST_PLACE_GSD_M = 0.116
# Metres per pixel by the beginning of a file's name.
SOURCES_GSD_M = {
    "MOS": FIRST_PLACE_GSD_M,
    "MunichStreet02": 0.121,
    "DJI_0010": 0.04,
    "DJI_0012": 0.04,
    "DJI_00": 0.055,
}
# The last frames of a flight, and one of the drone's flights, choose the best weights.
VALIDATION = ("DJI_0013", "MunichStreet02-MOS91", "MunichStreet02-MOS92", "MunichStreet02-MOS93")
VEHICLES = ("0", "1", "2", "3")
TILE_PX = 320
STEP_PX = 160
# A vehicle of which less is left at a tile's edge is painted over, and is no label.
LEAST_VISIBLE = 0.6
GREY = 114
# The network of torchvision has no anchor smaller than 32 px; it is shown pictures twice as large.
TWICE = 2
WINDOW_PX = 144
OUT = Path("runs/real")


@dataclass(frozen=True)
class Prepare:
    """Cuts the tiles to train on, and copies the frames to assess on.

    Attributes:
        kit: folder with the KIT AIS frames of Munich and YOLO labels.
        drone: folder with the drone's pictures of Minsk and YOLO labels.
        out: gets `data`, for training, and `first`, the place to assess on.
    """

    kit: Path
    drone: Path
    out: Path = OUT

    def run(self) -> None:
        """Writes both folders."""
        chance = random.Random(0)
        frames = [*sorted(self.kit.glob("MunichStreet02*.png")), *sorted(self.drone.glob("*.jpg"))]
        for frame in frames:
            picture = reduced(frame, GSD_M)
            self._cut(frame, np.asarray(picture), chance)
        text = (
            f"path: {(self.out / 'data').resolve()}\ntrain: images/train\nval: images/validation\n"
        )
        (self.out / "data/data.yaml").write_text(text + "names:\n  0: car\n")
        (self.out / "first/images").mkdir(parents=True)
        (self.out / "first/labels").mkdir()
        for frame in sorted(self.kit.glob("MOS*.png")):
            shutil.copy(frame, self.out / "first/images")
            shutil.copy(frame.with_suffix(".txt"), self.out / "first/labels")
        shutil.copy(self.kit / "aerial.names", self.out / "first")

    def _cut(self, frame: Path, pixels: np.ndarray, chance: random.Random) -> None:
        height, width = pixels.shape[:2]
        boxes = boxes_of(frame.with_suffix(".txt"), width, height)
        part = "validation" if frame.name.startswith(VALIDATION) else "train"
        for top in starts(height):
            for left in starts(width):
                tile, kept = cut_tile(pixels, boxes, top, left)
                # Of the ground without vehicles a third is enough.
                if not len(kept) and chance.random() > 0.3:
                    continue
                # Quarter turns, which leave boxes upright.
                for turn in range(4 if part == "train" else 1):
                    name = f"{frame.stem}_{left}_{top}_{turn}"
                    write_tile(
                        self.out / "data", part, name, np.rot90(tile, turn), turned(kept, turn)
                    )


@dataclass(frozen=True)
class Frames:
    """Puts photographs of one resolution and their labels into one folder.

    Attributes:
        kit: folder with the KIT AIS frames of Munich and YOLO labels.
        drone: folder with the drone's pictures of Minsk and YOLO labels.
        out: gets `frames`.
    """

    kit: Path
    drone: Path
    out: Path = OUT

    def run(self) -> None:
        """Writes the folder."""
        frames = self.out / "frames"
        frames.mkdir(parents=True)
        drone = [path for path in self.drone.iterdir() if path.suffix.lower() == ".jpg"]
        for path in sorted([*self.kit.glob("MOS*.png"), *drone]):
            reduced(path, FIRST_PLACE_GSD_M).save(frames / f"{path.stem}.png")
            # YOLO's numbers are shares of an image, whatever its size.
            shutil.copy(path.with_suffix(".txt"), frames)
        shutil.copy(self.kit / "aerial.names", frames)


@dataclass(frozen=True)
class Yolo:
    """Has Ultralytics' own trainer learn from the tiles, as its command line does it.

    Attributes:
        out: as of `prepare`; gets `yolo/run/weights/best.pt`.
        hours: how long.
    """

    out: Path = OUT
    hours: float = 0.75

    def run(self) -> None:
        """Runs the trainer."""
        settings = {
            "model": "yolo11n.yaml",
            "data": self.out / "data/data.yaml",
            "project": (self.out / "yolo").resolve(),
            "name": "run",
            "imgsz": TILE_PX,
            "time": self.hours,
            "batch": 16,
            "device": "cpu",
            "workers": 0,
            "pretrained": False,
            "warmup_epochs": 0.5,
            "flipud": 0.5,
            "close_mosaic": 3,
            "optimizer": "AdamW",
            "lr0": 0.002,
            "plots": False,
        }
        words = [f"{name}={value}" for name, value in settings.items()]
        subprocess.run(["yolo", "detect", "train", *words], check=True)


@dataclass(frozen=True)
class Torchvision:
    """Trains Faster R-CNN on MobileNet by a plain loop, on photographs and on rendered scenes.

    Attributes:
        drawn: dataset folder of rendered scenes at 12 cm per pixel, as `render` writes it; half of
            what is shown comes from there.
        out: as of `prepare`; gets `torchvision.pth`.
        seconds: how long.
    """

    drawn: Path
    out: Path = OUT
    seconds: float = 2500.0

    def run(self) -> None:
        """Trains, and stores the weights."""
        torch.manual_seed(0)
        chance = random.Random(0)
        real = sorted((self.out / "data/images/train").glob("*.png"))
        drawn = sp.Dataset.open(self.drawn)
        side = WINDOW_PX * TWICE
        # Fewer regions are enough for a handful of vehicles, and train in an eighth of the time.
        model = fasterrcnn_mobilenet_v3_large_fpn(
            weights=None,
            weights_backbone=None,
            num_classes=2,
            min_size=side,
            max_size=side,
            box_batch_size_per_image=64,
            box_positive_fraction=0.35,
            rpn_pre_nms_top_n_train=600,
            rpn_post_nms_top_n_train=300,
        )
        optimiser = torch.optim.AdamW(model.parameters(), lr=1e-3, weight_decay=0.02)
        begun = time.monotonic()
        step = 0
        while (share := (time.monotonic() - begun) / self.seconds) < 1:
            for group in optimiser.param_groups:
                group["lr"] = 1e-3 * min(1.0, share / 0.05) * (1 + np.cos(np.pi * share)) / 2
            shown = [window(*sample(real, drawn, chance), chance) for _ in range(8)]
            images = [image for image, _ in shown]
            targets = [
                {"boxes": boxes, "labels": torch.ones(len(boxes), dtype=torch.long)}
                for _, boxes in shown
            ]
            loss = sum(model(images, targets).values())
            optimiser.zero_grad()
            loss.backward()
            torch.nn.utils.clip_grad_norm_(model.parameters(), 10)
            optimiser.step()
            step += 1
            if step % 50 == 0:
                say(f"  {step} steps, {share:.0%}, loss {float(loss.detach()):.2f}")
        torch.save({"model": model.state_dict()}, self.out / "torchvision.pth")


def reduced(path: Path, gsd_m: float) -> Image.Image:
    """Opens a photograph, and makes it smaller where it is finer than it should be."""
    picture = Image.open(path).convert("RGB")
    scale = next(own for name, own in SOURCES_GSD_M.items() if path.name.startswith(name)) / gsd_m
    if scale >= 0.9:
        return picture
    size = (round(picture.width * scale), round(picture.height * scale))
    return picture.resize(size, Image.Resampling.LANCZOS)


def boxes_of(labels: Path, width: int, height: int) -> np.ndarray:
    """Reads YOLO text of vehicles as boxes `[N, 4]`, pixel xyxy."""
    rows = [line.split() for line in labels.read_text().splitlines() if line.strip()]
    numbers = np.array([row[1:5] for row in rows if row[0] in VEHICLES], float).reshape(-1, 4)
    corners = [numbers[:, :2] - numbers[:, 2:] / 2, numbers[:, :2] + numbers[:, 2:] / 2]
    return np.concatenate(corners, axis=1) * [width, height, width, height]


def starts(length: int) -> list[int]:
    """Where tiles begin along a side: every `STEP_PX`, and one that ends with it."""
    last = max(0, length - TILE_PX)
    return sorted({*range(0, last + 1, STEP_PX), last})


def cut_tile(
    pixels: np.ndarray, boxes: np.ndarray, top: int, left: int
) -> tuple[np.ndarray, np.ndarray]:
    """Cuts a tile and its boxes; vehicles of which too little is left are painted over."""
    tile = np.full((TILE_PX, TILE_PX, 3), GREY, np.uint8)
    part = pixels[top : top + TILE_PX, left : left + TILE_PX]
    tile[: part.shape[0], : part.shape[1]] = part
    own = boxes - [left, top, left, top]
    clipped = own.clip(0, TILE_PX)
    seen = sides(clipped).prod(axis=1) / sides(own).prod(axis=1)
    for x0, y0, x1, y1 in clipped[(seen > 0) & (seen < LEAST_VISIBLE)].round().astype(int):
        tile[y0:y1, x0:x1] = GREY
    return tile, clipped[seen >= LEAST_VISIBLE]


def sides(boxes: Any) -> Any:
    """Gives widths and heights, 0 where a box is empty."""
    return (boxes[:, 2:] - boxes[:, :2]).clip(0)


def turned(boxes: np.ndarray, turns: int) -> np.ndarray:
    """Turns boxes with their tile, a quarter to the left each time."""
    for _ in range(turns):
        x0, y0, x1, y1 = boxes.T
        boxes = np.stack([y0, TILE_PX - x1, y1, TILE_PX - x0], axis=1)
    return boxes


def write_tile(folder: Path, part: str, name: str, tile: np.ndarray, boxes: np.ndarray) -> None:
    """Writes a tile and its labels as Ultralytics reads them."""
    for kind in ("images", "labels"):
        (folder / kind / part).mkdir(parents=True, exist_ok=True)
    Image.fromarray(np.ascontiguousarray(tile)).save(folder / "images" / part / f"{name}.png")
    centred = np.concatenate([(boxes[:, :2] + boxes[:, 2:]) / 2, sides(boxes)], axis=1) / TILE_PX
    lines = ["0 " + " ".join(f"{number:.6f}" for number in row) for row in centred]
    (folder / "labels" / part / f"{name}.txt").write_text("".join(f"{line}\n" for line in lines))


def sample(real: Sequence[Path], drawn: sp.Dataset, chance: random.Random) -> tuple[Tensor, Tensor]:
    """Draws a tile or a rendered scene with its boxes."""
    if chance.random() < 0.5:
        index = chance.randrange(len(drawn))
        return drawn.image(index) / 255, drawn.boxes[index].float()
    path = chance.choice(real)
    labels = path.parents[2] / "labels" / path.parent.name / f"{path.stem}.txt"
    boxes = torch.from_numpy(boxes_of(labels, TILE_PX, TILE_PX)).float()
    return torch.from_numpy(np.array(Image.open(path))).permute(2, 0, 1) / 255, boxes


def window(image: Tensor, boxes: Tensor, chance: random.Random) -> tuple[Tensor, Tensor]:
    """Cuts a window, mostly over a vehicle, mirrors and lights it anew, and makes it larger."""
    if chance.random() < 0.5:
        width = image.shape[2]
        image = image.flip(2)
        boxes = torch.stack([width - boxes[:, 2], boxes[:, 1], width - boxes[:, 0], boxes[:, 3]], 1)
    room = image.shape[1] - WINDOW_PX
    left, top = chance.randrange(room + 1), chance.randrange(room + 1)
    if len(boxes) and chance.random() < 0.8:
        chosen = boxes[chance.randrange(len(boxes))]
        left, top = (
            min(max(0, int(chosen[[axis, axis + 2]].mean()) - chance.randrange(20, 124)), room)
            for axis in (0, 1)
        )
    image = image[:, top : top + WINDOW_PX, left : left + WINDOW_PX].clone()
    own = boxes - torch.tensor([left, top, left, top])
    clipped = own.clamp(0, WINDOW_PX)
    seen = sides(clipped).prod(dim=1) / sides(own).prod(dim=1)
    for x0, y0, x1, y1 in clipped[(seen > 0) & (seen < LEAST_VISIBLE)].round().int().tolist():
        image[:, y0:y1, x0:x1] = GREY / 255
    image = (image * (0.7 + 0.6 * chance.random()) + 0.2 * (chance.random() - 0.5)).clamp(0, 1)
    larger = functional.interpolate(image[None], scale_factor=TWICE, mode="bilinear")[0]
    return larger, clipped[seen >= LEAST_VISIBLE] * TWICE


if __name__ == "__main__":
    tyro.extras.subcommand_cli_from_dict(
        {"prepare": Prepare, "yolo": Yolo, "torchvision": Torchvision, "frames": Frames},
        config=(tyro.conf.CascadeSubcommandArgs,),
    ).run()
