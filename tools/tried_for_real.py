"""Four detectors that learnt elsewhere, each assessed on photographs it never saw.

    python tools/tried_for_real.py --which yolo torchvision http maite

After `tools/learn_from_photographs.py`, whose folder is given as `--out`: the checkpoint of
Ultralytics' trainer, that of a plain torchvision loop, the YOLO behind HTTP, where only its answers
are known, and the torchvision network as a MAITE model.
"""

from __future__ import annotations

import io
import json
import threading
from collections.abc import Sequence
from dataclasses import dataclass
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any, Literal
from urllib.request import Request, urlopen

import numpy as np
import torch
import tyro
from learn_from_photographs import FIRST_PLACE_GSD_M, GSD_M, OUT, TWICE
from PIL import Image
from torch import Tensor
from torch.nn import functional
from torchvision.models.detection import fasterrcnn_mobilenet_v3_large_fpn

import skyproof as sp
from skyproof.cli.console import say


@dataclass(frozen=True)
class Assessments:
    """Puts the detectors to `skyproof assess` on the first place.

    Attributes:
        which: detectors, one after the other.
        out: folder of `learn_from_photographs.py`; the run folders go to `assessed` in it.
    """

    which: tuple[Literal["yolo", "torchvision", "http", "maite"], ...] = ("yolo", "torchvision")
    out: Path = OUT

    def run(self) -> None:
        """Assesses."""
        for name in self.which:
            given: dict[str, Any] = {
                "imagery": self.out / "first/images",
                "gsd": FIRST_PLACE_GSD_M,
                "labels": self.out / "first",
                "label_classes": ("car",),
            }
            detector: Any = self.out / "yolo/run/weights/best.pt"
            if name == "yolo":
                given |= {"vehicle_classes": ("car",), "detector_gsd": GSD_M}
            elif name == "torchvision":
                detector = self.out / "torchvision.pth"
                # The same weights, but a hundred and fifty regions an image instead of a thousand.
                architecture = "fasterrcnn_mobilenet_v3_large_320_fpn"
                given |= {"vehicle_classes": ("1",), "architecture": architecture}
                given["detector_gsd"] = GSD_M / TWICE
            elif name == "http":
                detector = Service(serve(self.out / "assessed/yolo/detectors/yolo"))
            else:
                detector = Cars(self.out / "torchvision.pth")
                given["vehicle_classes"] = ("car",)
            say(f"{name}: {sp.assess(detector, self.out / 'assessed' / name, **given)}")


class Service:
    """A detector behind an address.

    Args:
        address: takes a PNG and answers boxes and scores.
    """

    name = "service"

    def __init__(self, address: str) -> None:
        self.address = address

    def detect(self, images: Tensor) -> list[sp.Detections]:
        """See `Detector.detect`."""
        return [self._ask(picture) for picture in (images * 255).round().byte().cpu()]

    def _ask(self, picture: Tensor) -> sp.Detections:
        png = io.BytesIO()
        Image.fromarray(picture.permute(1, 2, 0).numpy()).save(png, "png")
        with urlopen(Request(self.address, png.getvalue()), timeout=60) as answer:
            found = json.load(answer)
        boxes = torch.tensor(found["boxes"]).reshape(-1, 4)
        return sp.Detections(boxes, torch.tensor(found["scores"]))


def serve(folder: Path) -> str:
    """Puts a detector folder behind an address of this machine, until the program ends."""
    detector = sp.load_detector(folder).detector

    class Handler(BaseHTTPRequestHandler):
        def do_POST(self) -> None:
            body = self.rfile.read(int(self.headers["Content-Length"]))
            picture = np.array(Image.open(io.BytesIO(body)).convert("RGB"))
            found = detector.detect(torch.from_numpy(picture).permute(2, 0, 1)[None] / 255)[0]
            answer = {"boxes": found.boxes.tolist(), "scores": found.scores.tolist()}
            self.send_response(200)
            self.end_headers()
            self.wfile.write(json.dumps(answer).encode())

        def log_message(self, *_: Any) -> None:
            pass

    server = ThreadingHTTPServer(("127.0.0.1", 0), Handler)
    threading.Thread(target=server.serve_forever, daemon=True).start()
    return f"http://127.0.0.1:{server.server_port}"


@dataclass
class Found:
    """MAITE's targets: boxes `[N, 4]` in pixels, labels `[N]` and scores `[N]`."""

    boxes: np.ndarray
    labels: np.ndarray
    scores: np.ndarray


class Cars:
    """A network of torchvision as a MAITE model of object detection.

    Args:
        path: its weights, as `torchvision` stores them.
    """

    metadata = {"id": "cars", "index2label": {0: "background", 1: "car"}}  # noqa: RUF012

    def __init__(self, path: Path) -> None:
        # Two hundred regions hold every vehicle of such an image; a thousand take much longer.
        self.network = fasterrcnn_mobilenet_v3_large_fpn(
            weights=None, weights_backbone=None, num_classes=2, box_score_thresh=0.01,
            rpn_post_nms_top_n_test=200,
        ).eval()  # fmt: skip
        self.network.load_state_dict(torch.load(path, weights_only=True)["model"])

    def __call__(self, batch: Sequence[Any]) -> list[Found]:
        """Answers a batch of images `[3, H, W]` in [0, 1]."""
        answers = []
        for each in batch:
            image = torch.as_tensor(np.asarray(each)).float()
            larger = functional.interpolate(image[None], scale_factor=TWICE, mode="bilinear")[0]
            # torchvision would resize the image to 800 px.
            transform: Any = self.network.transform
            transform.min_size, transform.max_size = (min(larger.shape[1:]),), max(larger.shape[1:])
            with torch.no_grad():
                found = self.network([larger])[0]
            boxes, labels, scores = (found[name].numpy() for name in ("boxes", "labels", "scores"))
            answers.append(Found(boxes / TWICE, labels, scores))
        return answers


if __name__ == "__main__":
    tyro.cli(Assessments).run()
