"""`sp.assess` of a detector behind a local server, as the example asks it."""

from __future__ import annotations

import io
import json
import threading
from collections.abc import Iterator
from dataclasses import replace
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

import skyproof as sp
from skyproof.assessment import assess as assess_module
from skyproof.camouflage.folder import read_record
from skyproof.detectors.loaded import load_detector
from skyproof.errors import ConfigurationError, DetectorAnswerError
from tests.cli.test_assess import TINY

EXAMPLE = Path(__file__).parents[2] / "examples" / "detections_over_http.py"
ASKED = replace(TINY, attacks=("T-PixFc", "S-O@0.2"))


class Server(ThreadingHTTPServer):
    """RetinaNet behind HTTP; after so many pictures it fails, until told otherwise."""

    def __init__(self) -> None:
        super().__init__(("127.0.0.1", 0), _Handler)
        self.detector = load_detector("retinanet")
        self.pictures = 0
        self.fails_after: float = float("inf")


class _Handler(BaseHTTPRequestHandler):
    server: Server

    def do_POST(self) -> None:
        self.server.pictures += 1
        content = self.rfile.read(int(self.headers["Content-Length"]))
        if self.server.pictures > self.server.fails_after:
            self.send_error(503, "Out for lunch")
            return
        picture = np.asarray(Image.open(io.BytesIO(content)))
        image = torch.from_numpy(picture.copy()).permute(2, 0, 1)[None] / 255
        (found,) = self.server.detector.detect(image)
        answer = {"boxes": found.boxes.tolist(), "scores": found.scores.tolist()}
        body = json.dumps(answer).encode()
        self.send_response(200)
        self.send_header("Content-Length", str(len(body)))
        self.end_headers()
        self.wfile.write(body)

    def log_message(self, *args: object) -> None:
        """Says nothing."""


@pytest.fixture(scope="module")
def server() -> Iterator[Server]:
    with Server() as server:
        thread = threading.Thread(target=server.serve_forever, daemon=True)
        thread.start()
        yield server
        server.shutdown()


@pytest.fixture(scope="module", autouse=True)
def suite() -> Iterator[None]:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(assess_module, "read_suite", lambda *_: ASKED)
        yield


@pytest.fixture(scope="module")
def assessed(server: Server, suite: None, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The run folder that the example leaves, after a server that stopped half-way."""
    folder = tmp_path_factory.mktemp("service")
    code = EXAMPLE.read_text(encoding="utf-8")
    assert "http://127.0.0.1:8000/" in code
    code = code.replace(":8000/", f":{server.server_port}/")
    code = code.replace('"runs/mine/service"', repr(str(folder / "run")) + ', device="cpu"')
    # Within the queries: what comes before them needs 180 pictures or so.
    server.fails_after = 230
    with pytest.raises(DetectorAnswerError, match="HTTP Error 503: Out for lunch"):
        exec(compile(code, str(EXAMPLE), "exec"), {"__name__": "example"})
    assert not (folder / "run" / "report.html").exists()
    (folder / "asked_before.txt").write_text(str(server.pictures))
    server.fails_after = float("inf")
    exec(compile(code, str(EXAMPLE), "exec"), {"__name__": "example"})
    return folder / "run"


@pytest.mark.slow
def test_a_service_is_assessed_by_its_answers_alone(assessed: Path, server: Server) -> None:
    card = json.loads((assessed / "detectors/service/detector.json").read_text())
    assert card["name"] == "service"
    assert card["weights_sha256"] == ""
    assert card["validation"]["f1"] > 0.5
    assert not (assessed / "detectors/service/weights.safetensors").exists()
    results = json.loads((assessed / "results.json").read_text())
    rows = {row["camouflage"]: row for row in results["rows"] if row["match"] == "centre_1m"}
    assert rows.keys() >= {
        *("T-PixFc", "T-PixFc_transfer", "T-PixFc_asked15", "S-O@0.2", "S-O@0.2_transfer"),
        *("R-PixFc", "R-PixFc_search", "R-U_plain", "R-PixFc_best"),
    }
    assert {row["detector"] for row in results["rows"]} == {"service"}
    asked = read_record(assessed / "camouflages/T-PixFc")["queries"]
    assert asked["detector"] == "service"
    assert 50 < asked["images"] <= 72
    taught = read_record(assessed / "camouflages/T-PixFc_transfer")["attack"]["detectors"]
    assert set(taught) == {"retinanet", "faster_rcnn"}
    assert server.pictures > int((assessed.parent / "asked_before.txt").read_text())


@pytest.mark.slow
def test_the_report_says_that_only_answers_are_known(assessed: Path) -> None:
    page = (assessed / "report.html").read_text()
    assert "This detector is a black box" in page
    assert "images shown to the detector" in page
    assert "Gradient masking: " not in page


@pytest.mark.slow
def test_a_finished_run_asks_nothing(assessed: Path, server: Server) -> None:
    before = server.pictures

    class Silent:
        name = "service"

        def detect(self, images: object) -> list[object]:
            raise AssertionError("asked")

    assert sp.assess(Silent(), assessed, device="cpu") == assessed / "report.html"
    assert server.pictures == before


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"detector_gsd": 0.3}, "0.125 m per pixel, got 0.3"),
        ({"labels": "cars.json"}, "give --imagery too"),
        ({"accept": 0.4, "reject": 0.2}, "exchange them"),
        ({"seed": 2**70}, "seed expects"),
    ],
)
def test_options_that_cannot_be_are_one_sentence(
    tmp_path: Path, changes: dict[str, object], words: str
) -> None:
    class Silent:
        name = "service"

        def detect(self, images: object) -> list[object]:
            raise AssertionError("asked")

    with pytest.raises(ConfigurationError, match=words):
        sp.assess(Silent(), tmp_path / "run", **changes)
    assert not (tmp_path / "run").exists()


@pytest.mark.parametrize("name", [None, "", "../out", 7])
def test_a_detector_needs_a_plain_name(tmp_path: Path, name: object) -> None:
    class Nameless:
        def detect(self, images: object) -> list[object]:
            return []

    box = Nameless()
    if name is not None:
        box.name = name  # type: ignore[attr-defined]
    with pytest.raises(ConfigurationError, match="a callable with a plain name"):
        sp.assess(box, tmp_path / "run")
