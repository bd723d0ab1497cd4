"""Images with known vehicles, to train and evaluate detectors on."""

import hashlib
import json
import math
import os
from collections.abc import Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import cache, cached_property
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Float, UInt8
from torch import Tensor
from torchvision import ops

from skyproof.datasets.coco import (
    ANNOTATIONS,
    CATEGORY,
    REMEDY,
    AnnotationRow,
    ImageRow,
    Information,
    is_within,
    read_annotations,
)
from skyproof.datasets.pictures import Boxes, Picture, PictureInMemory, Pixels
from skyproof.errors import ConfigurationError, StoredFileError
from skyproof.scenes.backgrounds import BackgroundSet
from skyproof.scenes.scene import Scene, read_scenes

_YOLO_DATA = f"""\
# One dataset serves both splits; to validate on another, name its images folder.
train: images
val: images
names:
  0: {CATEGORY["name"]}
"""


@dataclass(frozen=True, eq=False)
class Dataset:
    """Images with the boxes of every vehicle in them; pixels are decoded on demand.

    Make one with `open`, `of_images` or `joined`.

    Attributes:
        pictures: the images; `image` and `images` decode them.
        boxes: `[n, 4]` true vehicles of each image, pixel xyxy.
        ignore: `[m, 4]` regions of each image that are not scored.
        ids: name of each image.
        gsd_m: metres per pixel of all images.
        visible_fractions: `[n]` visible share of each vehicle's pixels, by image; nan if not known.
        folder: folder of the images; None if they come from several folders or from memory.
    """

    pictures: Sequence[Picture]
    boxes: Sequence[Float[Tensor, "_n 4"]]
    ignore: Sequence[Float[Tensor, "_m 4"]]
    ids: Sequence[str]
    gsd_m: float
    visible_fractions: Sequence[Float[Tensor, " _n"]]
    folder: Path | None = None
    info: Information | None = None

    @classmethod
    def open(cls, folder: str | Path) -> "Dataset":
        """Opens a dataset folder that `CocoWriter` wrote; reads its annotations and no image.

        Annotations with iscrowd become ignore regions.

        Raises:
            StoredFileError: `annotations.json` is missing, damaged or of another form, or names an
                image outside the folder, or a vehicle outside its image.
        """
        folder = Path(folder)
        document, pictures = read_annotations(folder)
        rows = document.rows_by_image
        vehicles = [[row for row in of_image if not row.iscrowd] for of_image in rows]
        for image, of_image in zip(document.images, vehicles, strict=True):
            _refuse_outside(folder, image, of_image)
        crowds = [[row for row in of_image if row.iscrowd] for of_image in rows]
        return cls(
            pictures=pictures,
            boxes=[boxes_of(of_image) for of_image in vehicles],
            ignore=[boxes_of(of_image) for of_image in crowds],
            ids=[image.scene_id for image in document.images],
            gsd_m=document.info.gsd_m,
            visible_fractions=[_visible_fractions(of_image) for of_image in vehicles],
            folder=folder,
            info=document.info,
        )

    @classmethod
    def of_images(
        cls,
        images: Sequence[UInt8[Tensor, "3 _H _W"]],
        boxes: Sequence[Float[Tensor, "_n 4"]],
        *,
        gsd_m: float,
        ignore: Sequence[Float[Tensor, "_m 4"]] | None = None,
        ids: Sequence[str] | None = None,
    ) -> "Dataset":
        """Makes a dataset of images in memory, `[3, H, W]` sRGB bytes of any sizes.

        `boxes` holds the true vehicles and `ignore` the regions that are not scored, pixel xyxy.
        Without `ids`, images are numbered.
        """
        count = len(images)
        return cls(
            pictures=[PictureInMemory(image) for image in images],
            boxes=boxes,
            ignore=[torch.zeros(0, 4)] * count if ignore is None else ignore,
            ids=[str(index) for index in range(count)] if ids is None else ids,
            gsd_m=gsd_m,
            visible_fractions=[torch.full((len(of_image),), math.nan) for of_image in boxes],
        )

    @classmethod
    def joined(cls, parts: Sequence["Dataset"]) -> "Dataset":
        """Joins sets of one resolution in their order; ConfigurationError for several or none."""
        first = next(iter(parts), None)
        if first is None or not all(math.isclose(one.gsd_m, first.gsd_m) for one in parts):
            given = ", ".join(f"{one.folder} of {one.gsd_m} m" for one in parts) or "none"
            raise ConfigurationError(f"expected datasets of one resolution, got {given}.")
        if len(parts) == 1:
            return first
        fields = ("pictures", "boxes", "ignore", "ids", "visible_fractions")
        together: dict[str, Any] = {
            name: [one for part in parts for one in getattr(part, name)] for name in fields
        }
        return cls(gsd_m=first.gsd_m, **together)

    def __len__(self) -> int:
        return len(self.pictures)

    @property
    def sizes_px(self) -> list[tuple[int, int]]:
        """Width and height of each image, known without decoding."""
        return [picture.size_px for picture in self.pictures]

    @property
    def area_m2(self) -> float:
        """The area of ground in all images together."""
        return sum(width * height for width, height in self.sizes_px) * self.gsd_m**2

    def image(self, index: int) -> Pixels:
        """Decodes one image, as sRGB bytes; StoredFileError for a file damaged or missing."""
        return self.pictures[index].read()

    def images(self, indices: Iterable[int]) -> list[UInt8[Tensor, "3 _H _W"]]:
        """Decodes several images at once, each in its own thread."""
        return list(_decoders().map(self.image, indices))

    @cached_property
    def scenes(self) -> list[Scene]:
        """The scenes that the images show; StoredFileError without a whole `scenes.jsonl`."""
        if self.folder is None:
            raise StoredFileError("Images in memory have no scenes; give a rendered dataset.")
        return read_scenes(self.folder / "scenes.jsonl")

    @property
    def renderer(self) -> str:
        """The renderer of the images: "torch" or "cycles"; empty if they are not rendered."""
        return "" if self.info is None else self.info.renderer or ""

    @property
    def rendering(self) -> dict[str, Any]:
        """The settings of the renderer; empty if they are not known."""
        return {} if self.info is None else dict(self.info.rendering)

    @property
    def digest(self) -> str:
        """SHA-256 of the images' names, sizes, labels and rendering, not their pixels or folder."""
        images = zip(self.ids, self.sizes_px, self.boxes, self.ignore, strict=True)
        told = [
            [name, size_px, boxes.tolist(), ignored.tolist()]
            for name, size_px, boxes, ignored in images
        ]
        about = [self.gsd_m, self.renderer, self.rendering, told]
        if self.info is not None and self.info.camouflage:
            # Added only if there is one, so that the digests of other sets stay as they were.
            about.append(self.info.camouflage)
        return hashlib.sha256(json.dumps(about, sort_keys=True, default=str).encode()).hexdigest()

    @property
    def origin(self) -> str:
        """The set's name, and its renderer or source imagery; empty without one folder."""
        if self.folder is None or self.info is None:
            return ""
        above, name = self.folder.resolve().parent, self.folder.resolve().name
        if self.info.renderer is None and (above / "index.json").exists():
            # The set is a split of a tiled folder.
            tiles = BackgroundSet.open(above).tiles(name)
            sources = list(dict.fromkeys(tile.source for tile in tiles))
            if sources:
                more = f" and {len(sources) - 3} more" if len(sources) > 3 else ""
                return f"{name}: tiles of real imagery ({', '.join(sources[:3])}{more})"
        renderers = {"torch": "the differentiable renderer", "cycles": "Blender Cycles"}
        if self.renderer not in renderers:
            return f"{name}: images of unknown origin"
        return f"{name}: rendered by {renderers[self.renderer]}"


@cache
def _decoders() -> ThreadPoolExecutor:
    # Pillow releases the interpreter's lock while it decodes.
    return ThreadPoolExecutor(max_workers=os.cpu_count(), thread_name_prefix="decoder")


def _refuse_outside(folder: Path, image: ImageRow, rows: Sequence[AnnotationRow]) -> None:
    """Refuses boxes outside their image, except the empty ones of vehicles out of sight."""
    for row in rows:
        left, top, width, height = row.bbox
        box = (left, top, left + width, top + height)
        if width and height and not is_within(box, (image.width, image.height)):
            raise StoredFileError(
                f"{folder / ANNOTATIONS} has a box {list(row.bbox)} (left, top, width, height) "
                f"outside its image {image.scene_id} of {image.width} x {image.height} px; "
                f"{REMEDY}."
            )


def boxes_of(rows: Sequence[AnnotationRow]) -> Boxes:
    """Returns the boxes of annotations, pixel xyxy."""
    boxes = torch.tensor([row.bbox for row in rows], dtype=torch.float32).reshape(-1, 4)
    return torch.cat([boxes[:, :2], boxes[:, :2] + boxes[:, 2:]], 1)


def _visible_fractions(rows: Sequence[AnnotationRow]) -> Tensor:
    known = [math.nan if row.visible_fraction is None else row.visible_fraction for row in rows]
    return torch.tensor(known, dtype=torch.float32)


def write_yolo(folder: Path) -> None:
    """Writes `labels/*.txt` and `data.yaml` for Ultralytics beside a dataset's images.

    The format has no ignore regions, so they are left out, as are vehicles out of sight.
    """
    dataset = Dataset.open(folder)
    labels = folder / "labels"
    labels.mkdir()
    images = zip(dataset.ids, dataset.sizes_px, dataset.boxes, strict=True)
    for name, (width, height), boxes in images:
        seen = boxes[(boxes[:, 2:] > boxes[:, :2]).all(1)].double()
        shares = ops.box_convert(seen, "xyxy", "cxcywh") / torch.tensor([width, height] * 2)
        lines = ["0 " + " ".join(f"{part:.7f}" for part in row) + "\n" for row in shares.tolist()]
        (labels / f"{name}.txt").write_text("".join(lines), encoding="utf-8")
    (folder / "data.yaml").write_text(_YOLO_DATA, encoding="utf-8")
