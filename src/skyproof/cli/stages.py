"""What the stages of a run do; the demo strings them together, single commands run one of them."""

from __future__ import annotations

import tempfile
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import torch
from PIL import Image

from skyproof.camouflage.account import practicality_account
from skyproof.camouflage.camouflage import Camouflage
from skyproof.camouflage.folder import load_camouflage
from skyproof.cli.console import progress_bar
from skyproof.cli.renderers import open_renderer
from skyproof.cli.rendering import Rendering
from skyproof.datasets.dataset import Dataset
from skyproof.detectors.loaded import load_ensemble
from skyproof.errors import ConfigurationError
from skyproof.files import refuse_existing, write_beside, write_json
from skyproof.render.dataset import render_dataset
from skyproof.render.frames import Renderer
from skyproof.render.portrait import portrait
from skyproof.results.clean import CleanSet
from skyproof.results.evaluation import evaluate_pairs
from skyproof.scenes.backgrounds import BackgroundSet
from skyproof.scenes.scene import Scene, read_scenes
from skyproof.vehicles.fleet import Fleet

__all__ = [
    "evaluate_folders",
    "measure_camouflages",
    "paint_portrait",
    "render_folder",
    "score_camouflages",
]


def render_folder(
    scenes: Path,
    backgrounds: Path,
    fleet: Path,
    out: Path,
    *,
    camouflage: Path | None = None,
    rendering: Rendering | None = None,
    device: torch.device | str = "cpu",
) -> None:
    """Draws a scene file to a dataset folder, with a camouflage folder or without."""
    with open_renderer(rendering or Rendering(), BackgroundSet.open(backgrounds), out) as renderer:
        _render(read_scenes(scenes), renderer, Fleet.load(fleet), out, camouflage, device)


def _render(
    scenes: Sequence[Scene],
    renderer: Renderer,
    fleet: Fleet,
    out: Path,
    camouflage: Path | None,
    device: torch.device | str,
) -> None:
    worn: Camouflage | None = load_camouflage(camouflage).to(device) if camouflage else None
    with progress_bar(f"render {out.name}") as update:
        render_dataset(
            out, scenes, fleet, renderer, camouflage=worn, device=device, progress=update
        )


def evaluate_folders(
    detectors: Sequence[Path],
    original: Path,
    camouflaged: Mapping[str, Path],
    out: Path,
    *,
    clean: Sequence[CleanSet] = (),
    seed: int = 0,
    device: torch.device | str = "cpu",
) -> list[dict[str, Any]]:
    """Compares matched datasets and writes outcomes and the table of results."""
    scenes = read_scenes(original / "scenes.jsonl")
    ensemble = load_ensemble(detectors, device, scenes[0].camera.gsd_m)
    with progress_bar("evaluate") as update:
        return evaluate_pairs(
            ensemble, original, camouflaged, out, clean=clean, seed=seed, progress=update
        )


def score_camouflages(
    detectors: Sequence[Path],
    camouflages: Sequence[Path],
    scenes: Path,
    backgrounds: Path,
    fleet: Path,
    original: Path,
    out: Path,
    *,
    clean: Sequence[CleanSet] = (),
    rendering: Rendering | None = None,
    seed: int = 0,
    device: torch.device | str = "cpu",
) -> list[dict[str, Any]]:
    """Renders the scenes with each camouflage folder (its name is the camouflage's) and compares; keeps no images."""
    names = [folder.name for folder in camouflages]
    if len(set(names)) != len(names):
        raise ConfigurationError(
            "--camouflages expects folders of different names; score the others separately."
        )
    # The evaluation refuses what follows too, but only once everything is rendered.
    refuse_existing(out)
    rendering = rendering or Rendering()
    plain = Dataset.open(original)
    if plain.renderer != rendering.renderer:
        raise ConfigurationError(
            f"{original} was rendered by {plain.renderer}, not by {rendering.renderer}; give --renderer {plain.renderer}, or the "
            f"same scenes rendered by {rendering.renderer}."
        )
    out.parent.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(dir=out.parent, prefix=f".{out.name}.images.") as images:
        rendered = {folder.name: Path(images) / folder.name for folder in camouflages}
        # Read once for all: decoding tiles and loading vehicles takes a fair part of rendering one set.
        shown, vehicles = read_scenes(scenes), Fleet.load(fleet)
        with open_renderer(rendering, BackgroundSet.open(backgrounds), out) as renderer:
            if renderer.record() != plain.rendering:
                raise ConfigurationError(
                    f"{original} was rendered with other settings than are asked for here, or by another version of "
                    "skyproof or Blender; give the same --cycles.samples and --cycles.finish, or render it anew."
                )
            for folder in camouflages:
                _render(shown, renderer, vehicles, rendered[folder.name], folder, device)
            # Within, so that path-traced crops are kept until their images have been judged.
            return evaluate_folders(
                detectors, original, rendered, out, clean=clean, seed=seed, device=device
            )


def measure_camouflages(
    camouflages: Sequence[Path], fleet: Path, out: Path
) -> list[dict[str, Any]]:
    """Practicality of each camouflage folder on a fleet, as JSON (PAPER 54, 55)."""
    vehicles = Fleet.load(fleet)
    batch, rows = vehicles.batch(vehicles.ids), []
    with progress_bar("measure") as update:
        for folder in camouflages:
            rows.append(
                {**practicality_account(load_camouflage(folder), batch), "name": folder.name}
            )
            update(len(rows), len(camouflages))
    write_json(out, {"fleet": str(fleet), "vehicles": len(batch), "rows": rows})
    return rows


def paint_portrait(camouflage: Path, fleet: Path, out: Path) -> None:
    """One vehicle of each of a few body types wearing a camouflage, close up, beside the original."""
    picture = portrait(Fleet.load(fleet), load_camouflage(camouflage))
    with write_beside(out) as temporary:
        Image.fromarray(picture.permute(1, 2, 0).numpy()).save(temporary)
