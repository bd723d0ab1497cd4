"""What a detector's answers alone are worth, on the detector that some attacks of a run never saw.

    python tools/by_answers.py --run-folder runs/quick --detector yolov5

It takes what the run learnt on all other detectors (T-U_without_yolov5-0), asks the detector as a
black box, and judges start, result and the copies kept on the way on scenes of the attack's own
ground and vehicles that no candidate was tried on; beside it a random search with as many images.
"""

from __future__ import annotations

import time
from dataclasses import dataclass
from pathlib import Path

import torch
import tyro

from skyproof.attacks.held_out import HeldOut
from skyproof.attacks.queries import query_attack
from skyproof.attacks.settings import QuerySettings
from skyproof.attacks.world import AttackWorld
from skyproof.camouflage.camouflage import Camouflage
from skyproof.camouflage.folder import load_camouflage
from skyproof.camouflage.make import make_camouflage
from skyproof.camouflage.name import CamouflageName
from skyproof.detectors.detector import Detections, Detector
from skyproof.detectors.loaded import LoadedDetector, load_detector
from skyproof.layout import Layout
from skyproof.randomness import generator_of

SIZE_PX = 128


class Wall:
    """A detector behind a wall: it answers, and shows neither loss nor gradient."""

    def __init__(self, detector: Detector) -> None:
        self.name = detector.name
        self._detector = detector

    def detect(self, images: torch.Tensor) -> list[Detections]:
        """See `Detector.detect`."""
        return self._detector.detect(images)


@dataclass(frozen=True)
class ByAnswers:
    """Asks one detector of a finished run.

    Attributes:
        run_folder: of a reproduction with transfer.
        detector: its name.
        out: folder for what is found.
        texture: what was learnt without it, but for the variant.
        images: how many are asked, each time.
    """

    run_folder: Path
    detector: str = "yolov5"
    out: Path = Path("asked")
    texture: str = "T-U"
    images: int = 6000

    def run(self) -> None:
        """Asks, and prints what is hidden."""
        layout = Layout(self.run_folder)
        judge = load_detector(layout.detector(self.detector))
        box = LoadedDetector(Wall(judge.detector), judge.card)
        world = AttackWorld.open(layout.backgrounds, layout.fleets / "attack", size_px=SIZE_PX)
        # Eight batches of 24 scenes, of another seed than the searches'.
        held_out = HeldOut([box], world, seed=1, batch_size=24)
        print(f"Of what is found in {held_out.scenes()} scenes without camouflage:")
        base = CamouflageName.parse(self.texture)
        variant = base.with_variant(f"without_{self.detector}").with_repeat(0)
        carried = load_camouflage(layout.camouflage(str(variant)))
        carried.name = base
        search = base.control.with_variant("search")
        drawn = make_camouflage(search, generator=generator_of(0, "texture", str(search)))
        settings = QuerySettings(images=self.images, keep_at=(1500, 3000))
        for start in (carried, drawn):
            name = str(start.name)
            _say(f"{name}, start", start, held_out)
            began = time.monotonic()
            found = query_attack(start, box, world, settings, self.out / name)
            took_s = time.monotonic() - began
            for place in sorted((self.out / name / "snapshots").iterdir()):
                _say(place.name, load_camouflage(place), held_out)
            _say(f"{name}, {took_s:.0f} s", found, held_out)


def _say(text: str, camouflage: Camouflage, held_out: HeldOut) -> None:
    print(f"  {text}: {held_out.judge(camouflage).hidden:.1%} hidden", flush=True)


if __name__ == "__main__":
    tyro.cli(ByAnswers).run()
