"""A program of a user that checks its types with mypy --strict."""

import os
import subprocess
import sys
from importlib.util import find_spec
from pathlib import Path

import pytest

from tests.test_docs import public_names

ROOT = Path(__file__).parents[1]
PROGRAM = """
from pathlib import Path

import torch

import skyproof as sp


class Own(sp.TrainableDetector):
    def loss(self, images: torch.Tensor, targets: object) -> torch.Tensor:
        return images.mean((1, 2, 3))


def service(images: torch.Tensor) -> list[tuple[torch.Tensor, torch.Tensor]]:
    return [(torch.zeros(0, 4), torch.zeros(0)) for _ in images]


def name_of(detector: sp.Detector) -> str:
    return detector.name


def camouflages(ground: sp.BackgroundSet) -> dict[str, sp.Camouflage]:
    control = sp.make_camouflage("R-U-0", generator=torch.Generator().manual_seed(0))
    sp.save_camouflage("runs/mine/R-U-0", control)
    return {"R-U-0": control, "T-U": sp.load_camouflage("runs/demo/camouflages/T-U")}


def main() -> None:
    report: Path = sp.assess("best.pt", "runs/town", imagery="town.tif", vehicle_classes=["car"])
    report = sp.assess(["retinanet", Path("town")], Path("runs/two"), accept=0.2, reject=0.3)
    report = sp.assess(service, "runs/service", name="theirs", device="cpu")
    images: sp.Dataset = sp.Dataset.open("runs/images/validation")
    ours = sp.load_detector("runs/demo/detectors/retinanet")
    theirs = sp.load_detector(service, images, name="theirs")
    world = sp.World.open("runs/demo/backgrounds", "runs/demo/fleets/attack", size_px=128)
    texture = sp.make_camouflage("T-U", generator=torch.Generator().manual_seed(0))
    settings = sp.AttackSettings(steps=400)
    texture = sp.attack(texture, [ours, Own()], world, settings, "runs/mine/T-U")
    texture = sp.query_attack(texture, theirs, world, sp.QuerySettings(images=2000), "runs/mine/q")
    scenes: list[sp.Scene] = images.scenes
    fleet: sp.Fleet = sp.Fleet.load("runs/demo/fleets/test")
    ground: sp.BackgroundSet = sp.BackgroundSet.open("runs/demo/backgrounds")
    renderer: sp.TorchRenderer | sp.CyclesRenderer = sp.TorchRenderer(ground)
    outcomes = sp.measure(
        [ours, theirs], scenes, camouflages(ground), fleet=fleet, renderer=renderer, folder="runs/s"
    )
    hidden = [each.vehicle for each in outcomes if not each.detected_adversarial]
    try:
        easr: float = sp.Results.open("runs/mine").rows[0].easr.estimate
        report = sp.write_report("runs/mine")
    except sp.SkyproofError as error:
        raise SystemExit(str(error)) from error
    print(report, easr, hidden, name_of(theirs), sp.import_detector)
"""


def test_the_program_uses_every_public_name():
    assert [name for name in public_names() if f"sp.{name}" not in PROGRAM] == []


# Without a cache, mypy reads torch for a minute. No public name has a type of these packages and of
# these parts of torch.
UNREAD = [
    *("_decomp", "_dynamo", "_export", "_functorch", "_higher_order_ops", "_inductor", "_prims"),
    *("_refs", "_subclasses", "ao", "distributed", "export", "fx", "jit", "masked", "onnx"),
    *("package", "profiler", "quantization", "sparse", "testing", "utils._sympy"),
]
OTHERS = [
    *("geopandas", "jinja2", "matplotlib", "networkx", "onnx", "onnxruntime", "pandas", "pyarrow"),
    *("rasterio", "rich", "scipy", "skimage", "sklearn", "sympy", "torchvision", "transformers"),
    *("trimesh", "warp"),
]


@pytest.mark.slow
@pytest.mark.skipif(find_spec("mypy") is None, reason="needs mypy (pip install 'skyproof[dev]')")
def test_the_public_names_satisfy_mypy_in_strict_mode(tmp_path: Path):
    program = tmp_path / "program.py"
    program.write_text(PROGRAM)
    unread = ",".join(f"{name}.*" for name in [*(f"torch.{name}" for name in UNREAD), *OTHERS])
    config = tmp_path / "mypy.ini"
    config.write_text(f"[mypy]\n[mypy-{unread}]\nfollow_imports = skip\n")
    words = ["--strict", "--follow-imports=silent", "--config-file", config.name, program.name]
    # Nobody reads its cache.
    words += ["--cache-dir", os.devnull]
    done = subprocess.run(
        [sys.executable, "-m", "mypy", *words],
        cwd=tmp_path,
        env={**os.environ, "MYPYPATH": str(ROOT / "src")},
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stdout + done.stderr
