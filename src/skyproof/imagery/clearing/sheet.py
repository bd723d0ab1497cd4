"""Draws a contact sheet of every changed tile, before and after, to inspect and reject."""

import html
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Bool, UInt8
from PIL import Image, ImageDraw
from scipy import ndimage
from torch import Tensor

from skyproof.datasets.pictures import Boxes, Pixels
from skyproof.files import write_bytes
from skyproof.pictures import write_png

LARGEST_SIDE_PX = 640
GAP_PX = 8
_PAGE = Path(__file__).with_name("sheet.html")
# Yellow and vermilion of Okabe and Ito.
MASKED, REMAINING = (240, 228, 66), (255, 106, 0)


@dataclass(frozen=True)
class SheetRow:
    """One tile: its mask is outlined on the picture before, remaining vehicles on that after."""

    tile: str
    caption: str
    kept: bool
    before: Pixels
    after: Pixels
    mask: Bool[Tensor, "H W"]
    remaining: Boxes


def write_figure(folder: Path, number: int, row: SheetRow) -> str:
    """Writes the picture of a tile, and returns the tile's part of the page."""
    picture = f"{number:05d}.png"
    write_png(folder / picture, _draw_row(row), 3)
    tile, caption = (html.escape(text, quote=True) for text in (row.tile, row.caption))
    disabled = "" if row.kept else " disabled"
    return (
        f'<figure><label><input type="checkbox" value="{tile}"{disabled}> <b>{tile}</b> '
        f'{caption}<img src="{picture}" alt="{tile}: {caption}" loading="lazy"></label></figure>'
    )


def write_page(folder: Path, figures: Sequence[str]) -> None:
    """Writes `index.html`."""
    page = _PAGE.read_text(encoding="utf-8").replace("{figures}", "\n".join(figures))
    write_bytes(folder / "index.html", page.encode())


def _draw_row(row: SheetRow) -> UInt8[np.ndarray, "H W 3"]:
    scale = min(1.0, LARGEST_SIDE_PX / max(row.mask.shape))
    inner = ndimage.binary_erosion(row.mask.numpy(), np.ones((3, 3)))
    outline = row.mask & ~torch.from_numpy(inner)
    yellow = torch.tensor(MASKED, dtype=torch.uint8)[:, None, None]
    before = torch.where(outline, yellow, row.before)
    height, width = (round(side * scale) for side in row.mask.shape)
    pictures = []
    for pixels in (before, row.after):
        picture = Image.fromarray(pixels.permute(1, 2, 0).contiguous().numpy())
        pictures.append(picture.resize((width, height), Image.Resampling.LANCZOS))
    draw = ImageDraw.Draw(pictures[1])
    for box in (row.remaining * scale).tolist():
        draw.rectangle([round(value) for value in box], outline=REMAINING, width=2)
    both = Image.new("RGB", (2 * width + GAP_PX, height), "white")
    both.paste(pictures[0], (0, 0))
    both.paste(pictures[1], (width + GAP_PX, 0))
    return np.asarray(both)
