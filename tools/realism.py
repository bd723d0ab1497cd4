"""Measures how well rendered vehicles are told from photographed ones, and by what.

    python tools/realism.py --real RUN/tiles --cleared RUN/cleared \\
        --rendered RUN/{train,validation,attack,test} --out RUN/realism

RUN/tiles is labelled imagery cut by `skyproof ground`, RUN/cleared what `skyproof clear` made of
it, and the rest what `skyproof render` drew on that, of scenes as large as the tiles with vehicles
where others were removed (docs/results/reality/README.md).

A small network learns to tell windows around rendered vehicles from those around the real ones
that stood there, at other places than it is tested on. The area under its ROC curve (AUC) is 0.5
where it sees no difference and 1 where it is always right. It sees the whole window, the vehicle
alone, or the ground alone. With `--real` another rendered dataset on the same tiles, the AUC should
be near 0.5. How sharp both are is read off their edges, as `skyproof ground` does with imagery.

OUT gets realism.json, pairs.png (real above, rendered below), told.png (the same of the rendered
windows that are told best) and occlusion.png. The pictures show the imagery: they are for looking
at, not for a repository.
"""

from __future__ import annotations

import time
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
import tyro
from numpy.typing import NDArray
from realism_classifier import VIEWS, Network, area, folds_of, occlusion, spots_of, tell
from realism_pairs import Pairs, read_pairs
from realism_pictures import write_occlusion, write_sheet

from skyproof.errors import ImageryError
from skyproof.files import finished_folder, write_json
from skyproof.imagery.sharpness import measure_sensor

_SHEET = 56
_OCCLUDED = 40
_SHOWN = 7
_PATCH_M = 1.25
_STRIDE_M = 0.5


@dataclass(frozen=True)
class Realism:
    """Tells rendered vehicles from real ones.

    Attributes:
        real: the labelled tiled folder; or rendered datasets, to compare renders with renders.
        rendered: rendered datasets.
        cleared: the tiled folder that they were rendered on.
        out: folder to write.
        folds: parts that the places are cut into; each is tested by networks that learnt from the
            others.
        seeds: how many networks judge each fold together.
        steps: of each training.
    """

    real: tuple[Path, ...]
    rendered: tuple[Path, ...]
    cleared: Path
    out: Path
    folds: int = 4
    seeds: int = 1
    steps: int = 120

    def run(self) -> dict[str, Any]:
        """Measures, prints, writes, and returns what realism.json holds."""
        started = time.process_time()
        with finished_folder(self.out) as folder:
            pairs = read_pairs(self.real, self.rendered, self.cleared)
            spots = spots_of(pairs)
            folds = folds_of(pairs, spots, self.folds)
            counts = {
                "pairs": len(spots),
                "spots": int(spots.max()) + 1,
                "left_out_at_borders": pairs.left_out,
                "tested": np.bincount(folds).tolist(),
            }
            print(counts, flush=True)
            real_px, rendered_px = _blurs(pairs)
            print(f"blur     real {real_px} px, rendered {rendered_px} px", flush=True)
            areas = {}
            found = {}
            for view in VIEWS:
                found[view] = tell(pairs, folds, view, steps=self.steps, seeds=self.seeds)
                interval = area(found[view][0], folds, spots, generator=np.random.default_rng(0))
                values = (interval.estimate, interval.low, interval.high)
                areas[view] = [round(value, 3) for value in values]
                print(
                    f"{view:<8} AUC {areas[view][0]} ({areas[view][1]}–{areas[view][2]})",
                    flush=True,
                )
            scores, networks = found["whole"]
            _draw(folder, pairs, folds, scores, networks)
            settings = asdict(self) | {"out": str(self.out), "cleared": str(self.cleared)}
            for name in ("real", "rendered"):
                settings[name] = [str(path) for path in settings[name]]
            record = {
                "settings": settings,
                "counts": counts,
                "blur_sigma_px": {"real": real_px, "rendered": rendered_px},
                "auc": areas,
                "cpu_s": round(time.process_time() - started, 1),
            }
            write_json(folder / "realism.json", record)
        print(f"{self.out}, {record['cpu_s']} CPU-seconds")
        return record


def _blurs(pairs: Pairs) -> list[float | None]:
    """Returns how sharp the windows are, real and rendered; None where they show too few edges."""
    found: list[float | None] = []
    for side in (0, 1):
        try:
            found.append(measure_sensor(pairs.pixels[:, side]).blur_sigma_px)
        except ImageryError:
            found.append(None)
    return found


def _draw(
    folder: Path,
    pairs: Pairs,
    folds: NDArray[np.int64],
    scores: NDArray[np.float64],
    networks: list[Network],
) -> None:
    """Draws the three pictures; single ones are of pairs that are told best."""
    order = np.random.default_rng(0).permutation(len(folds))
    write_sheet(folder / "pairs.png", pairs, order[:_SHEET].tolist())
    best = order[np.argsort(-scores[order, 1], kind="stable")]
    write_sheet(folder / "told.png", pairs, best[:_SHEET].tolist())
    chosen = np.concatenate([best[:_SHOWN], order[: _OCCLUDED - _SHOWN]])
    patch_px = round(_PATCH_M / pairs.gsd_m)
    stride_px = round(_STRIDE_M / pairs.gsd_m)
    falls: dict[int, np.ndarray] = {}
    for number, network in enumerate(networks):
        own = torch.from_numpy(chosen[folds[chosen] == number])
        if len(own):
            of_fold = occlusion(network, pairs, own, patch_px=patch_px, stride_px=stride_px)
            falls.update(zip(own.tolist(), of_fold, strict=True))
    maps = np.stack([falls[index] for index in chosen.tolist()])
    write_occlusion(folder / "occlusion.png", pairs, chosen.tolist(), maps, _SHOWN)


if __name__ == "__main__":
    tyro.cli(Realism).run()
