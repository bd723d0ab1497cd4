"""Turns a finished run of the preset `reference` into the detectors that come with skyproof.

    skyproof reproduce --preset reference --out runs/reference --cores 2
    python tools/ship_reference.py runs/reference
    for name in retinanet faster_rcnn; do
      skyproof assess $name --out runs/$name
      skyproof harden runs/$name --data runs/reference/datasets/train \\
        --out runs/${name}_hardened
    done
    python tools/ship_reference.py runs/reference \\
        --hardened runs/retinanet_hardened runs/faster_rcnn_hardened

Weights are halved. What is told of the detectors is measured on the halved ones: the threshold and
the scores of validation on the run's validation images, the check on the run's own scenes.
"""

from __future__ import annotations

import shutil
import tempfile
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import tyro

from skyproof.cli.precheck import Precheck
from skyproof.datasets.dataset import Dataset
from skyproof.detectors.card import (
    HARDENED_DETECTORS,
    PARENT_FILE,
    REFERENCE_DETECTORS,
    REFERENCE_FOLDER,
    DetectorCard,
    write_card,
)
from skyproof.detectors.inference import detect_all
from skyproof.detectors.loaded import load_detector
from skyproof.detectors.matching import MatchTable, match_images
from skyproof.detectors.validation import validate
from skyproof.documents import read_document
from skyproof.errors import ConfigurationError
from skyproof.layout import Layout
from skyproof.reproduction.plan import reproduction_plan
from skyproof.reproduction.preset import Preset
from skyproof.results.precheck import findings, read_precheck, worst
from skyproof.results.stored import read_environment
from skyproof.storage import write_tensors
from skyproof.words import detector_name, percent

PRESET = "reference"
LARGEST_BYTES = 5_000_000

README = """\
# The reference detectors

Slim versions of RetinaNet and Faster R-CNN that come with skyproof, so that a first report needs no
training, and both after `skyproof harden`. Each is a detector folder like any other:
`detector.json`, `weights.safetensors` and `precheck.json`, what `skyproof precheck` found of it.

**What they are for:** a first report, tests, examples, and to compare a detector of your own with.
**What they are not for:** finding vehicles for a purpose of yours. They learnt from procedural
ground and procedural vehicles alone, at 12.5 cm per pixel, and saw no photograph; what they score
on your imagery `skyproof precheck` tells.

## How they were made

```
skyproof reproduce --preset reference --out runs/reference --cores 2
python tools/ship_reference.py runs/reference
for name in retinanet faster_rcnn; do
  skyproof assess $name --out runs/$name
  skyproof harden runs/$name --data runs/reference/datasets/train \\
    --out runs/${{name}}_hardened
done
python tools/ship_reference.py runs/reference \\
    --hardened runs/retinanet_hardened runs/faster_rcnn_hardened
```

in a checkout. No data and no weights of others went in.

- Seed {seed}; all settings: [reference.json](../../reproduction/reference.json).
- Versions: {versions}.
- Processor: {cpu}. Another one, or another version, ends in somewhat other weights.
- Weights are stored in half precision and computed with in single precision. Threshold, validation
  and check are those of the halved weights.

| detector | AP in validation | threshold | check | halving moves a vehicle's score by at most | vehicles that it wins or loses |
| -- | -- | -- | -- | -- | -- |
{rows}

AP is that of centres within 1 m on rendered images. YOLOv5 is not among them: its library is under
the AGPL-3.0, so it is trained on your machine (`skyproof train`).

## Licence

Apache-2.0, as skyproof itself.
"""  # noqa: E501


@dataclass(frozen=True)
class ShipReference:
    """Writes the folders of the detectors and the page beside them, in place of those before.

    Attributes:
        run_folder: a finished run of the preset `reference`.
        out: folder that comes with the package.
        hardened: runs of `skyproof harden` on its detectors, to be shipped, too.
        device: auto, cpu or cuda.
    """

    run_folder: Annotated[Path, tyro.conf.Positional]
    out: Path = REFERENCE_FOLDER
    hardened: tuple[Path, ...] = ()
    device: str = "auto"

    def run(self) -> None:
        """Halves, measures, and says what became of it."""
        layout = Layout(self.run_folder)
        config: dict[str, Any] = read_document(layout.config, dict[str, Any], "give a finished run")
        if config.get("preset") != PRESET:
            raise ConfigurationError(
                f"{self.run_folder} is no run of the preset {PRESET}; the detectors that are "
                "shipped are made by it alone."
            )
        plan = reproduction_plan(Preset.parse(config), self.run_folder, device=self.device)
        (check,) = (step.settings for step in plan.steps if isinstance(step.settings, Precheck))
        self.out.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory() as scratch:
            sources = {Path(scratch) / name: layout.detector(name) for name in REFERENCE_DETECTORS}
            for run in self.hardened:
                (source,) = Layout(run).detectors.iterdir()
                sources[Path(scratch) / f"{source.name}_hardened"] = source
            rows = []
            for folder, source in sources.items():
                # Each alone, because a precheck tells detectors apart by their names.
                change = _halve(layout, source, folder)
                replace(check, detectors=(folder,)).run()
                rows.append(_row(folder, change))
            for folder in sources:
                shutil.rmtree(self.out / folder.name, ignore_errors=True)
                shutil.move(folder, self.out)
        machine = read_environment(layout.environment)
        packages = ("skyproof", "python", "torch", "torchvision")
        versions = ", ".join(f"{name} {machine[name]}" for name in packages if machine.get(name))
        page = README.format(
            seed=config["seed"],
            versions=versions or "not noted",
            cpu=machine.get("cpu", "not noted"),
            rows="\n".join(rows),
        )
        (self.out / "README.md").write_text(page, encoding="utf-8")
        print(page.partition("## How they were made")[2])


def _halve(layout: Layout, source: Path, folder: Path) -> tuple[float, int, int]:
    """Writes the folder of a trained detector with halved weights, but for its check.

    Returns:
        By how much halving moves the score of any vehicle of the test images at most; how many
        vehicles it wins or loses at the threshold; and how many vehicles there are.
    """
    trained = load_detector(source)
    before = _matched(trained, layout)
    halves = {
        name: tensor.half() if tensor.is_floating_point() else tensor
        for name, tensor in trained.state_dict().items()
    }
    weights = folder / "weights.safetensors"
    write_tensors(weights, halves)
    if weights.stat().st_size > LARGEST_BYTES:
        raise ConfigurationError(
            f"{folder.name} has {weights.stat().st_size:,} bytes in half precision, more than the "
            f"{LARGEST_BYTES:,} that a package may carry; train a smaller one."
        )
    trained.load_state_dict(halves)
    scores = validate(trained, Dataset.open(layout.dataset("validation")))
    card = replace(trained.card, threshold=scores.pop("threshold"), validation=scores)
    write_card(folder / "detector.json", replace(card, weights_sha256=trained.weights_sha256))
    if (source / PARENT_FILE).exists():
        shutil.copy(source / PARENT_FILE, folder)
    after = _matched(trained, layout)
    moved = float(np.abs(after.score_of_vehicle - before.score_of_vehicle).max())
    changed = before.found_at(trained.threshold) != after.found_at(card.threshold)
    return moved, int(changed.sum()), before.vehicles


def _matched(detector: Any, layout: Layout) -> MatchTable:
    test = Dataset.open(layout.dataset("test"))
    return match_images(detect_all(detector, test), test, criterion="centre_1m")


def _row(folder: Path, change: tuple[float, int, int]) -> str:
    """What the page says of a detector; opening it shows that its files belong together."""
    card: DetectorCard = load_detector(folder).card
    moved, changed, vehicles = change
    cells = [
        "hardened " * (folder.name in HARDENED_DETECTORS) + detector_name(card.name),
        percent(card.validation["ap_centre_1m"], 1),
        f"{card.threshold:.3f}",
        worst(findings(read_precheck(folder))).outcome,
        f"{moved:.4f}",
        f"{changed} of {vehicles}",
    ]
    return f"| {' | '.join(cells)} |"


if __name__ == "__main__":
    tyro.cli(ShipReference).run()
