"""Draws contact sheets for a person: every changed tile before and after, page by page."""

from __future__ import annotations

import html
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType

import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float, UInt8
from PIL import Image, ImageDraw, ImageFont
from torch import Tensor

from skyproof.files import write_beside, write_bytes

__all__ = ["ContactSheet", "SheetRow"]

ROWS_A_PAGE = 4
LARGEST_SIDE_PX = 640
CAPTION_PX = 26
GAP_PX = 8
# Yellow and vermilion of Okabe and Ito.
MASKED, REMAINING = (240, 228, 66), (255, 106, 0)


@dataclass(frozen=True)
class SheetRow:
    """One tile of the sheet.

    Attributes:
        tile: its id.
        caption: what was done.
        before, after: `[3, H, W]` bytes.
        mask: `[H, W]` what was filled; outlined in the picture before.
        remaining: `[n, 4]` what the check still finds; drawn in the picture after.
    """

    tile: str
    caption: str
    before: UInt8[Tensor, "3 H W"]
    after: UInt8[Tensor, "3 H W"]
    mask: Bool[Tensor, "H W"]
    remaining: Float[Tensor, "n 4"]


class ContactSheet:
    """Writes `page-0001.png` and so on, and `index.html` when the block ends well.

    Args:
        folder: gets the files.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = Path(folder)
        self._waiting: list[SheetRow] = []
        self._pages: list[tuple[str, list[str]]] = []

    def __enter__(self) -> ContactSheet:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        if error is None:
            self._write_page()
            write_bytes(self.folder / "index.html", self._index().encode())

    def add(self, row: SheetRow) -> None:
        """Takes a tile; a full page is written at once."""
        self._waiting.append(row)
        if len(self._waiting) == ROWS_A_PAGE:
            self._write_page()

    def _write_page(self) -> None:
        if not self._waiting:
            return
        pictures = [_draw_row(row) for row in self._waiting]
        page = Image.new(
            "RGB", (max(p.width for p in pictures), sum(p.height for p in pictures)), "white"
        )
        top = 0
        for picture in pictures:
            page.paste(picture, (0, top))
            top += picture.height
        name = f"page-{len(self._pages) + 1:04d}.png"
        with write_beside(self.folder / name) as temporary:
            page.save(temporary, compress_level=3)
        self._pages.append((name, [f"{row.tile}: {row.caption}" for row in self._waiting]))
        self._waiting = []

    def _index(self) -> str:
        parts = [
            '<!doctype html><html lang="en"><meta charset="utf-8"><title>Cleared tiles</title>',
            "<h1>Cleared tiles</h1><p>Left: before, with what was removed outlined in yellow. "
            "Right: after; orange boxes are what a detector still finds. Tiles not listed had no "
            "vehicle.</p>",
        ]
        for name, captions in self._pages:
            text = "; ".join(html.escape(caption, quote=True) for caption in captions)
            parts.append(f'<p><img src="{name}" alt="{text}" style="max-width:100%"></p>')
        return "\n".join([*parts, "</html>", ""])


def _draw_row(row: SheetRow) -> Image.Image:
    scale = min(1.0, LARGEST_SIDE_PX / max(row.mask.shape))
    before = torch.where(
        _outline(row.mask), torch.tensor(MASKED, dtype=torch.uint8)[:, None, None], row.before
    )
    pictures = []
    for pixels in (before, row.after):
        picture = Image.fromarray(pixels.permute(1, 2, 0).contiguous().numpy())
        size = (round(picture.width * scale), round(picture.height * scale))
        pictures.append(picture if scale == 1 else picture.resize(size, Image.Resampling.LANCZOS))
    draw = ImageDraw.Draw(pictures[1])
    for box in (row.remaining * scale).tolist():
        draw.rectangle([round(value) for value in box], outline=REMAINING, width=2)
    width, height = pictures[0].size
    text = f"{row.tile}   {row.caption}"
    font = ImageFont.load_default(15)
    page = Image.new(
        "RGB",
        (max(2 * width + GAP_PX, int(font.getlength(text)) + 8), height + CAPTION_PX),
        "white",
    )
    ImageDraw.Draw(page).text((4, 4), text, fill="black", font=font)
    page.paste(pictures[0], (0, CAPTION_PX))
    page.paste(pictures[1], (width + GAP_PX, CAPTION_PX))
    return page


def _outline(mask: Bool[Tensor, "H W"]) -> Bool[Tensor, "H W"]:
    """Returns the mask's own outermost pixels; along the tile's edge too."""
    padded = F.pad(~mask[None, None], (1, 1, 1, 1), value=True).float()
    return mask & (F.max_pool2d(padded, 3, stride=1)[0, 0] > 0)
