"""`skyproof check`: how good detectors are on annotated images, before anyone attacks them."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from skyproof.cli.console import progress_bar, say
from skyproof.cli.device import choose_device
from skyproof.cli.frames import read_frames
from skyproof.detectors.inference import detect_all
from skyproof.detectors.loaded import load_detector
from skyproof.errors import ConfigurationError
from skyproof.files import refuse_existing, write_json
from skyproof.results.clean import check_clean
from skyproof.words import interval, percent

__all__ = ["Check"]


@dataclass(frozen=True)
class Check:
    """Average precision on annotated images, and precision and recall at the frozen threshold, with intervals.

    Attributes:
        detectors: detector folders.
        frames: annotated images as [NAME=]FOLDER[/PATTERN][:LABELS]@GSD, e.g. 'kit/MOS*@0.116'; rendered datasets and
            tiled folders, too. Arguments of one NAME are one set of several places.
        out: JSON file to write.
        frame_classes: class names that count as vehicles in them; other classes are ignored, not counted as mistakes.
        seed: of the bootstrap.
        device: auto, cpu or cuda.
    """

    detectors: tuple[Path, ...]
    frames: tuple[str, ...]
    out: Path
    frame_classes: tuple[str, ...] = ("car", "minibus")
    seed: int = 0
    device: str = "auto"

    def run(self) -> None:
        """Checks every detector on every set, prints and writes the rows."""
        if not self.detectors or not self.frames:
            raise ConfigurationError("A check expects at least one detector and one set of frames.")
        refuse_existing(self.out)
        device = choose_device(self.device)
        loaded = [load_detector(folder) for folder in self.detectors]
        gsd_m = loaded[0].card.gsd_m
        for folder, judge in zip(self.detectors, loaded, strict=True):
            if judge.card.gsd_m != gsd_m:
                raise ConfigurationError(
                    f"{folder} was made for {judge.card.gsd_m} m per pixel, the first detector for {gsd_m}; "
                    "check them separately."
                )
        sets = read_frames(self.frames, self.frame_classes, gsd_m)
        rows = []
        with progress_bar("check") as update:
            for folder, judge in zip(self.detectors, loaded, strict=True):
                for each in sets:
                    found = detect_all(judge.detector.to(device), each.images)
                    row = check_clean(
                        judge, each, found, generator=np.random.default_rng(self.seed)
                    )
                    rows.append({**row, "folder": folder.name})
                    update(len(rows), len(sets) * len(loaded))
        write_json(self.out, {"rows": rows})
        for row in rows:
            say(
                f"  {row['folder']:<14} {row['dataset']:<28} AP {percent(row['ap_centre_1m'])} "
                f"({interval(row['ap_centre_1m_low'], row['ap_centre_1m_high'])}, over {row['clusters']} "
                f"{row['clustered_by']}), {row['vehicles']} vehicles"
            )
        say(f"Checks: {self.out.resolve()}")
