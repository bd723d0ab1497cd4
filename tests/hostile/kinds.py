"""Every kind of document, each with the cheapest command that reads it."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path

from tests.hostile.sandbox import Kind
from tests.hostile.world import ASSESS

__all__ = ["CARDS", "DATASETS", "GROUND", "JSON_KINDS", "LABELS", "PRESETS", "RUNS"]
__all__ += ["SCENES", "SCORES", "TEXTS"]

ON_CPU = ("--device", "cpu")


def render(inputs: Path, out: Path, *more: object) -> Sequence[object]:
    words = ["render", "--scenes", inputs / "scenes/test.jsonl", *ON_CPU, "--out", out / "new"]
    words += ["--backgrounds", inputs / "backgrounds", "--fleet", inputs / "fleets/test"]
    return [*words, *more]


def scenes(inputs: Path, out: Path) -> Sequence[object]:
    words = ["render", "--backgrounds", inputs / "backgrounds", "--fleet", inputs / "fleets/test"]
    sizes = ["--count", 1, "--settings.size-px", 96, "--settings.vehicles-maximum", 1]
    return [*words, *sizes, "--settings.vehicles-minimum", 1, *ON_CPU, "--out", out / "new"]


def reject(inputs: Path, out: Path) -> Sequence[object]:
    return ["clear", out / "copy", "--reject", "epsg2193-e1550005-n5190000"]


def cut(inputs: Path, out: Path, *more: object) -> Sequence[object]:
    size = ("--tiling.size-px", 40)
    return ["ground", inputs / "imagery", "--out", out / "new", *size, *more]


def labelled(name: str) -> Callable[[Path, Path], Sequence[object]]:
    def words(inputs: Path, out: Path) -> Sequence[object]:
        given = ["--labels.path", inputs / "labels" / name, "--labels.classes", "car"]
        return cut(inputs, out, *given)

    return words


def clear(inputs: Path, out: Path) -> Sequence[object]:
    return ["clear", inputs / "tiled", "--out", out / "new", *ON_CPU]


def score(inputs: Path, out: Path) -> Sequence[object]:
    words = ["score", "--detectors", inputs / "detectors/retinanet", "--out", out / "new"]
    return [
        *words,
        "--frames",
        f"{inputs / 'datasets/validation'}@0.125",
        "--frame-classes",
        "vehicle",
        *ON_CPU,
    ]


def compare(inputs: Path, out: Path) -> Sequence[object]:
    words = ["score", "--detectors", inputs / "detectors/retinanet", "--out", out / "new"]
    words += ["--original", inputs / "datasets/test", *ON_CPU]
    words += ["--backgrounds", inputs / "backgrounds", "--fleet", inputs / "fleets/test"]
    return [*words, "--camouflages", inputs / "camouflages/T-U"]


def train(inputs: Path, out: Path) -> Sequence[object]:
    words = ["train", "--detector", "retinanet", "--data", inputs / "datasets/train"]
    words += ["--validation", inputs / "datasets/train", "--settings.steps", 1, *ON_CPU]
    words += ["--settings.batch-size", 1, "--settings.validate-every", 1]
    return [*words, "--settings.checkpoint-every", 1, "--out", out / "new"]


def worn(inputs: Path, out: Path) -> Sequence[object]:
    return render(inputs, out, "--camouflage", inputs / "camouflages/R-U-0")


def mix(inputs: Path, out: Path) -> Sequence[object]:
    return ["vehicles", inputs / "fleets/test", inputs / "fleets/train", "--out", out / "new"]


def learnt(inputs: Path, out: Path) -> Sequence[object]:
    given = ["--out", inputs / "learnt", "--counts", 1, 1, 1, 1, "--fleets", out / "new"]
    return ["learn", *given]


def draw_fixed(inputs: Path, out: Path) -> Sequence[object]:
    palette = ("--palette", inputs / "palette.json")
    return ["attack", "R-Fc", "--out", out / "new", *palette, *ON_CPU]


def report(inputs: Path, out: Path) -> Sequence[object]:
    return ["report", out / "copy"]


def assess(inputs: Path, out: Path) -> Sequence[object]:
    return [*ASSESS, "--out", out / "copy"]


def reproduce(inputs: Path, out: Path) -> Sequence[object]:
    words = ["reproduce", "--preset", inputs / "preset.json", "--out", out / "new", *ON_CPU]
    return [*words, "--cores", 1, "--dry-run"]


SCENES = [
    Kind("scenes", "scenes/test.jsonl", render, lines=True, called=("fleet",)),
    Kind("fleet", "fleets/test/fleet.json", mix),
    Kind("fleet of scenes", "fleets/test/fleet.json", scenes),
]
GROUND = [
    Kind("index, rendered", "backgrounds/index.json", render),
    Kind("index, cleared", "tiled/index.json", clear, slow=True),
    Kind("index with places", "cleared/index.json", reject, copied="cleared"),
    Kind("places of tiles", "tiled/index.geojson", reject, copied="tiled"),
    Kind("record of clearing", "cleared/clearing.json", reject, copied="cleared"),
    Kind("annotations, cleared", "tiled/test/annotations.json", clear, slow=True),
]
DATASETS = [
    Kind("annotations, scored", "datasets/validation/annotations.json", score, slow=True),
    Kind("annotations, compared", "datasets/test/annotations.json", compare, slow=True),
    Kind("annotations, trained on", "datasets/train/annotations.json", train, slow=True),
]
LABELS = [
    Kind("COCO labels", "labels/coco.json", labelled("coco.json"), slow=True),
    Kind("GeoJSON labels", "labels/points.geojson", labelled("points.geojson"), slow=True),
]
TEXTS = [
    Kind("YOLO text", "labels/yolo/photo.txt", labelled("yolo"), slow=True),
    Kind("YOLO classes", "labels/yolo/data.yaml", labelled("yolo"), slow=True),
    Kind("DOTA text", "labels/dota/photo.txt", labelled("dota"), slow=True),
    Kind("VisDrone text", "labels/visdrone/photo.txt", labelled("visdrone"), slow=True),
    Kind("Pascal VOC", "labels/voc/photo.xml", labelled("voc"), slow=True),
]
CARDS = [
    Kind("card of a detector", "detectors/retinanet/detector.json", score, slow=True),
    Kind("camouflage", "camouflages/R-U-0/camouflage.json", worn),
    Kind("palette", "palette.json", draw_fixed),
    Kind("generator", "learnt/generator.json", learnt),
    Kind("check", "detectors/retinanet/precheck.json", report, copied=".", slow=True),
]
SCORE = "scores/test-0"
SCORES = [
    Kind(f"report of {name}", f"{SCORE}/{name}.json", report, copied=SCORE, slow=True)
    for name in ("score", "sets", "baselines", "likeness", "pairs/pairs")
]
RUNS = [
    # What has no bearing on the steps does not end the command before its report.
    Kind(f"run with {name}", f"{name}.json", assess, copied=".", slow=name != "config")
    for name in ("config", "environment", "timings", "steps")
]
# Presets have a module of their own.
JSON_KINDS = [*SCENES, *GROUND, *DATASETS, *LABELS, *CARDS, *SCORES, *RUNS]
PRESETS = [Kind("preset", "preset.json", reproduce, called=("preset", "--"))]
