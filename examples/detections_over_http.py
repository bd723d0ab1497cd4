"""Assesses a detector behind a network address in one call.

The service takes a PNG and returns boxes in pixels with scores. Change `ask` to suit yours.
"""

import io
import json
from urllib.request import Request, urlopen

from PIL import Image

import skyproof as sp


def ask(picture):
    png = io.BytesIO()
    Image.fromarray(picture).save(png, "png")
    request = Request("http://127.0.0.1:8000/detect", png.getvalue())
    with urlopen(request, timeout=60) as answer:
        return json.load(answer)  # {"boxes": [[left, top, right, bottom], ...], "scores": [...]}


def service(images):
    return [ask(each) for each in (images * 255).round().byte().permute(0, 2, 3, 1).cpu().numpy()]


print(sp.assess(service, "runs/mine/service"))
