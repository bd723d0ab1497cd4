"""What query attacks and the random search from nothing hide from a detector as a black box.

    python tools/queries.py RUN DETECTOR T-U T-PixFc T-PixFcMa

RUN is a run folder with ground and fleets, such as that of `make demo`. Starts are optimised on
both reference detectors. DETECTOR is a detector folder, of which only boxes and scores are used.
Both searches show it 6,000 images. Printed are shares hidden on 256 scenes that no attack saw, by
the main and the lenient rule.
"""

import sys
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory

import torch
from torch import Tensor

import skyproof as sp
from skyproof.attacks.held_out import HeldOut
from skyproof.camouflage.name import CamouflageName
from skyproof.camouflage.palette import ground_palette
from skyproof.detectors.answers import BlackBoxDetector
from skyproof.detectors.card import REFERENCE_DETECTORS, reference_folder
from skyproof.detectors.detector import Detections
from skyproof.results.result import LENIENT_MATCH, MAIN_MATCH

SEED = 999
BATCH_SIZE = 32


class Box:
    """A detector behind its detections."""

    name = "box"

    def __init__(self, detector: sp.Detector) -> None:
        self.detector = detector

    def detect(self, images: Tensor) -> list[Detections]:
        """Gives the detections alone."""
        return self.detector.detect(images)


def main(run: Path, folder: Path, names: list[str]) -> None:
    """Prints a row for each camouflage."""
    world = sp.World.open(run / "backgrounds", run / "fleets/attack", size_px=128)
    palette = ground_palette(world.backgrounds)
    network = sp.load_detector(folder)
    detector = BlackBoxDetector(Box(network), card=replace(network.card, name="box"))
    references = [sp.load_detector(reference_folder(name)) for name in REFERENCE_DETECTORS]
    rules = (MAIN_MATCH, LENIENT_MATCH)
    judges = [HeldOut([detector], world, SEED, BATCH_SIZE, rule) for rule in rules]

    def hidden(camouflage: sp.Camouflage) -> str:
        return ", ".join(f"{100 * judge.measure(camouflage).hidden:.0f}" for judge in judges)

    with TemporaryDirectory() as place:
        for text in names:
            name = CamouflageName.parse(text)
            settings = sp.AttackSettings(steps=200, preview_every=1000)
            draws = torch.Generator().manual_seed(0)
            start = sp.make_camouflage(name, generator=draws, palette=palette)
            start = sp.attack(start, references, world, settings, Path(place) / text)
            control = name.control.with_variant("search")
            draws = torch.Generator().manual_seed(1)
            drawn = sp.make_camouflage(control, generator=draws, palette=palette)
            budget = sp.QuerySettings()
            found = sp.query_attack(start, detector, world, budget, Path(place) / f"{text}_asked")
            search = sp.query_attack(drawn, detector, world, budget, Path(place) / str(control))
            print(f"| {text} | {hidden(start)} | {hidden(found)} | {hidden(search)} |", flush=True)


if __name__ == "__main__":
    main(Path(sys.argv[1]), Path(sys.argv[2]), sys.argv[3:])
