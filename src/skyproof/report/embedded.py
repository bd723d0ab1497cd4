"""Pictures inside the page, as data URIs."""

import base64
import io
from pathlib import Path

from PIL import Image

from skyproof.errors import StoredFileError
from skyproof.pictures import open_picture, read_pixels

_REMEDY = "copy the whole folder again, or score again"


def embedded_jpeg(path: Path) -> str:
    """Gives a JPEG file as a data URI."""
    picture = open_picture(path, _REMEDY)
    with picture:
        if picture.format != "JPEG":
            raise StoredFileError(f"{path} is a {picture.format} file, not JPEG; {_REMEDY}.")
    return f"data:image/jpeg;base64,{base64.b64encode(path.read_bytes()).decode()}"


def embedded(path: Path | None, *, lossless: bool = True) -> str | None:
    """Gives a picture as a data URI: PNG where texels matter, else JPEG."""
    if path is None:
        return None
    buffer = io.BytesIO()
    picture = Image.fromarray(read_pixels(path, _REMEDY))
    if lossless:
        picture.save(buffer, "PNG", optimize=True)
    else:
        picture.save(buffer, "JPEG", quality=80)
    kind = "png" if lossless else "jpeg"
    return f"data:image/{kind};base64,{base64.b64encode(buffer.getvalue()).decode()}"
