"""The one way to open a picture: known formats, a stated limit, one sentence."""

from __future__ import annotations

import warnings
from pathlib import Path

import numpy as np
from jaxtyping import UInt8
from PIL import Image

from skyproof.errors import SkyproofError, StoredFileError

__all__ = ["LARGEST_PX", "open_picture", "read_pixels"]

LARGEST_PX = 178_956_970
"""The most pixels of a picture that is decoded as a whole, some 13,377 x 13,377: what Pillow allows
at most. A header that claims more is refused before memory is asked for; imagery that is cut into
tiles is read window by window, and may be larger."""

# Others of Pillow's readers start programs (EPS runs Ghostscript) or are rarely looked after. What
# reads JPEG also reads the pictures in pairs (MPO) of some cameras.
_FORMATS = ("PNG", "JPEG", "TIFF", "JPEG2000", "BMP", "WEBP")


def open_picture(
    path: Path, remedy: str, *, error: type[SkyproofError] = StoredFileError
) -> Image.Image:
    """Reads the header of a picture; its pixels are decoded by `read_pixels`, or by Pillow.

    Args:
        path: a PNG, JPEG, TIFF, JPEG 2000, BMP or WebP file.
        remedy: what the error advises, such as "replace or remove it".
        error: the class of the error.

    Raises:
        SkyproofError: the file is missing, of another format, damaged, or has more than
            `LARGEST_PX` pixels.
    """
    try:
        with warnings.catch_warnings():
            # Aerial pictures are large; only what Pillow refuses is too large. Nor are notes on
            # damaged metadata for the user: pixels are all that is taken.
            warnings.simplefilter("ignore")
            picture = Image.open(path, formats=_FORMATS)
    except FileNotFoundError:
        raise error(f"{path} is missing; {remedy}.") from None
    except Image.DecompressionBombError:
        raise error(
            f"{path} says that it has more than {LARGEST_PX:,} pixels (some 13,377 x 13,377), "
            f"which is too large to be read at once; cut it into parts, or {remedy}."
        ) from None
    except Exception as damage:
        # Pillow's readers meet damage with any exception there is.
        raise error(
            f"{path} cannot be read as a picture ({_reason(damage)}); {remedy}."
        ) from damage
    width, height = picture.size
    if width * height > LARGEST_PX:
        picture.close()
        raise error(
            f"{path} has {width:,} x {height:,} px, more than {LARGEST_PX:,} pixels in all, which "
            f"is too large to be read at once; cut it into parts, or {remedy}."
        )
    return picture


def read_pixels(
    path: Path,
    remedy: str,
    *,
    size_px: tuple[int, int] | None = None,
    error: type[SkyproofError] = StoredFileError,
) -> UInt8[np.ndarray, "H W 3"]:
    """Decodes a whole picture as sRGB bytes.

    Args:
        path: as of `open_picture`.
        remedy: what the error advises.
        size_px: width and height that it must have, where they are known; refused before decoding.
        error: the class of the error.

    Raises:
        SkyproofError: as of `open_picture`, or the size is another.
    """
    with open_picture(path, remedy, error=error) as picture:
        if size_px is not None and picture.size != size_px:
            width, height = picture.size
            raise error(
                f"{path} has {width} x {height} px, expected are {size_px[0]} x {size_px[1]}; "
                f"{remedy}."
            )
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")
                picture.load()
                # A conversion copies even where there is nothing to convert.
                return np.array(picture if picture.mode == "RGB" else picture.convert("RGB"))
        except Exception as damage:
            # As above.
            raise error(
                f"{path} cannot be read as a picture ({_reason(damage)}); {remedy}."
            ) from damage


def _reason(damage: Exception) -> str:
    return " ".join(str(damage).split())[:200] or type(damage).__name__
