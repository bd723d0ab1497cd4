"""`skyproof score`: detectors judged, with and without camouflages."""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Any

from skyproof.cli.console import say
from skyproof.cli.rendering import Rendering
from skyproof.errors import ConfigurationError
from skyproof.files import alone
from skyproof.ranges import Seed, is_name

if TYPE_CHECKING:
    import torch

    from skyproof.detectors.loaded import Load, LoadedDetector


@dataclass(frozen=True, kw_only=True)
class Score(Rendering):
    """Judges detectors: with and without camouflages, and on annotated images.

    Camouflage folders are rendered here, onto the vehicles and scenes of --original, and their
    images are not kept. Datasets that are rendered already are given with --camouflaged. With
    --frames alone it is only checked how good the detectors are. A score folder inside the `scores`
    folder of a run is taken into the run's report.

    Attributes:
        detectors: detector folders.
        out: score folder to write, such as `my_run/scores/mine`.
        original: dataset without camouflage; its scenes are the ones that are judged.
        camouflages: camouflage folders; a folder's name is the camouflage's in the tables.
        camouflaged: NAME=FOLDER for datasets of the same scenes with a camouflage, such as
            T-U=data/test-T-U. A camouflage T-x is compared with its random controls R-x-0,
            R-x-1, ...
        backgrounds: background set folder of the scenes; needed for --camouflages.
        fleet: fleet folder of the scenes' vehicles; needed for --camouflages.
        frames: annotated images to check the detectors on, [NAME=]FOLDER[/PATTERN][:LABELS]@GSD
            and #CLASS,... where it has classes of its own, such as 'kit/MOS*@0.116#car';
            rendered datasets and tiled folders, too. Arguments of one NAME are one set of several
            places.
        frame_classes: class names that count as vehicles in the other frames; all else is
            ignored, not counted as mistakes.
        seed: of the bootstrap.
        device: auto, cpu or cuda.
    """

    detectors: tuple[Path, ...]
    out: Path
    original: Path | None = None
    camouflages: tuple[Path, ...] = ()
    camouflaged: tuple[str, ...] = ()
    backgrounds: Path | None = None
    fleet: Path | None = None
    frames: tuple[str, ...] = ()
    frame_classes: tuple[str, ...] = ("car", "minibus")
    seed: Seed = 0
    device: str = "auto"

    def run(self, load: Load | None = None) -> None:
        """Judges, and prints success rates and checks; `load` as of `Precheck.run`."""
        from skyproof.cli.console import progress_bar
        from skyproof.cli.device import choose_device
        from skyproof.cli.frames import read_frames
        from skyproof.datasets.dataset import Dataset
        from skyproof.detectors.card import read_card
        from skyproof.files import refuse_existing
        from skyproof.measure.score import score_detectors

        self._refuse_what_cannot_work()
        given = self._given()
        # The scoring refuses what exists, too, but only once everything is rendered.
        refuse_existing(self.out)
        device = choose_device(self.device)
        gsd_m = (
            read_card(self.detectors[0]).gsd_m
            if self.original is None
            else Dataset.open(self.original).gsd_m
        )
        judges = self._judges(device, gsd_m, load)
        clean = read_frames(self.frames, self.frame_classes, gsd_m)
        with self._rendered(device) as rendered, progress_bar("score") as update:
            score_detectors(
                judges,
                self.out,
                original=self.original,
                camouflaged={**rendered, **given},
                clean=clean,
                seed=self.seed,
                sources=self._sources(),
                add=self._add_patterns,
                progress=update,
            )
        self._say_results()

    def _refuse_what_cannot_work(self) -> None:
        """Shows a mistake in the options before anything is rendered.

        Raises:
            ConfigurationError: nothing to judge, or something that belongs to it is missing.
        """
        worn = bool(self.camouflages or self.camouflaged)
        if not worn and not self.frames:
            raise ConfigurationError(
                "Scoring expects something to judge the detectors on: --original with "
                "--camouflages or --camouflaged, or --frames."
            )
        if worn != (self.original is not None):
            raise ConfigurationError(
                "Scoring compares --original, a dataset without camouflage, with --camouflages "
                "or --camouflaged; give both sides."
            )
        if self.camouflages and (self.backgrounds is None or self.fleet is None):
            raise ConfigurationError(
                "--camouflages are rendered on --backgrounds and --fleet, those of the scenes of "
                "--original; give both."
            )

    def _given(self) -> dict[str, Path]:
        """The datasets with camouflage by name.

        Raises:
            ConfigurationError: a text of another form, or one name twice.
        """
        given: dict[str, Path] = {}
        for text in self.camouflaged:
            name, _, place = text.partition("=")
            if not is_name(name) or not place:
                raise ConfigurationError(
                    f"--camouflaged expects NAME=FOLDER with a plain name (no separators, not dots "
                    f"alone), got {text[:300]!r}."
                )
            if name in given:
                raise ConfigurationError(
                    f"--camouflaged names {name} twice; give each camouflage once."
                )
            given[name] = Path(place)
        names = [*(folder.name for folder in self.camouflages), *given]
        unfit = next((name for name in names if not is_name(name)), None)
        if unfit is not None:
            raise ConfigurationError(
                f"--camouflages expects folders whose names can name a camouflage, got {unfit!r}; "
                "give each by its own name."
            )
        if len(set(names)) != len(names):
            raise ConfigurationError(
                "--camouflages expects folders of different names; score the others separately."
            )
        return given

    def _judges(
        self, device: torch.device, gsd_m: float, load: Load | None
    ) -> list[LoadedDetector[Any]]:
        """Loads the detectors; if they are only checked, folders tell those of one kind apart."""
        from skyproof.detectors.loaded import load_apart, load_ensemble

        load_all = load_apart if self.original is None else load_ensemble
        return load_all(self.detectors, device, gsd_m, load)

    @contextmanager
    def _rendered(self, device: torch.device) -> Iterator[dict[str, Path]]:
        """Yields datasets of the original's scenes with each camouflage folder; keeps no images."""
        if self.original is None or self.backgrounds is None or self.fleet is None:
            yield {}
            return
        from skyproof.camouflage.folder import load_camouflage
        from skyproof.cli.console import progress_bar
        from skyproof.cli.renderers import open_renderer
        from skyproof.datasets.dataset import Dataset
        from skyproof.render.dataset import render_dataset
        from skyproof.scenes.backgrounds import BackgroundSet
        from skyproof.vehicles.fleet import Fleet

        original = Dataset.open(self.original)
        if self.camouflages and original.renderer != self.renderer:
            raise ConfigurationError(
                f"{self.original} was rendered by {original.renderer}, not by {self.renderer}; "
                f"give --renderer {original.renderer}, or the same scenes rendered by "
                f"{self.renderer}."
            )
        # Read once for all: decoding tiles and loading vehicles takes a fair part of rendering.
        backgrounds = BackgroundSet.open(self.backgrounds)
        fleet = Fleet.load(self.fleet)
        self.out.parent.mkdir(parents=True, exist_ok=True)
        # A lock of its own: that of the score folder is held while it is written.
        with (
            alone(self.out.with_name(f"{self.out.name}.images")),
            self._fresh_folder() as images,
            open_renderer(self, backgrounds, self.out) as renderer,
        ):
            if self.camouflages and renderer.record(original.scenes) != original.rendering:
                raise ConfigurationError(
                    f"{self.original} was rendered with other settings than are asked for here, "
                    "or by another version of skyproof or Blender; give the same "
                    "--cycles.samples and --cycles.finish, or render it anew."
                )
            rendered = {}
            for folder in self.camouflages:
                place = Path(images) / folder.name
                camouflage = load_camouflage(folder).to(device)
                with progress_bar(f"render {folder.name}") as update:
                    render_dataset(
                        place,
                        original.scenes,
                        fleet,
                        renderer,
                        camouflage=camouflage,
                        device=device,
                        progress=update,
                    )
                rendered[folder.name] = place
            # Within, so that path-traced crops are kept until their images have been judged.
            yield rendered

    @contextmanager
    def _fresh_folder(self) -> Iterator[str]:
        """Yields a folder for images beside --out; removes what kills have left there before."""
        prefix = f".{self.out.name}.images."
        for entry in self.out.parent.iterdir():
            if entry.name.startswith(prefix) and entry.is_dir() and not entry.is_symlink():
                shutil.rmtree(entry)
        with TemporaryDirectory(dir=self.out.parent, prefix=prefix) as images:
            yield images

    def _sources(self) -> list[str]:
        """What the ground of the scenes was cut from, or ["procedural"]; empty if not known."""
        from skyproof.datasets.dataset import Dataset
        from skyproof.scenes.backgrounds import BackgroundSet

        if self.original is None or self.backgrounds is None:
            return []
        backgrounds = BackgroundSet.open(self.backgrounds)
        tiles = dict.fromkeys(scene.background.tile for scene in Dataset.open(self.original).scenes)
        return list(dict.fromkeys(backgrounds.tile(name).source for name in tiles))

    def _add_patterns(self, folder: Path) -> None:
        """Adds what the pictured camouflages look like, and what they ask of their makers."""
        from skyproof.camouflage.account import practicality_account
        from skyproof.camouflage.folder import load_camouflage
        from skyproof.camouflage.name import CamouflageName
        from skyproof.files import inside, write_beside, write_bytes, write_json
        from skyproof.render.portrait import portrait
        from skyproof.results.score_folder import is_pictured
        from skyproof.vehicles.fleet import Fleet

        pictured = [
            folder for folder in self.camouflages if is_pictured(CamouflageName.read(folder.name))
        ]
        if not pictured or self.fleet is None:
            return
        from PIL import Image

        fleet = Fleet.load(self.fleet)
        vehicles = fleet.batch(fleet.ids)
        rows = []
        for place in pictured:
            camouflage = load_camouflage(place)
            picture = portrait(fleet, camouflage)
            with write_beside(folder / "patterns" / place.name / "on_vehicle.png") as temporary:
                Image.fromarray(picture.permute(1, 2, 0).numpy()).save(temporary)
            for file in ("texture.png", "steps.jsonl"):
                if (place / file).exists():
                    path = folder / "patterns" / place.name / file
                    write_bytes(path, inside(place, file, place).read_bytes())
            rows.append({**practicality_account(camouflage, vehicles), "name": place.name})
        write_json(folder / "practicality.json", {"vehicles": len(vehicles), "rows": rows})

    def _say_results(self) -> None:
        from skyproof.results.results import Results
        from skyproof.words import interval, number, percent

        results = Results.open(self.out)
        for headline in results.headlines():
            for row in headline.by_detector:
                limits = interval(row.easr.low, row.easr.high)
                say(
                    f"  {row.camouflage!s:<24} {row.detector:<14} EASR "
                    f"{percent(row.easr.estimate)} ({limits})"
                )
        for check in results.checks:
            ap = check.ap_centre_1m
            if not check.vehicles:
                say(
                    f"  {check.dataset:<24} {check.detector:<14} "
                    f"{number(check.false_alarms_per_km2)} false alarms per km², no vehicles"
                )
                continue
            say(
                f"  {check.dataset:<24} {check.detector:<14} AP {percent(ap.estimate)} "
                f"({interval(ap.low, ap.high)}, over {check.clusters} {check.clustered_by}), "
                f"{check.vehicles} vehicles"
            )
        say(f"Scores: {self.out.resolve()}")
