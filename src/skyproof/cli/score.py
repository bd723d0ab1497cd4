"""`skyproof score`: what camouflages hide from detectors, and how good these are without."""

from collections.abc import Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from tyro.conf import Suppress

from skyproof.console import progress_bar, say
from skyproof.cycles.settings import Rendering
from skyproof.errors import ConfigurationError
from skyproof.files import refuse_existing
from skyproof.ranges import Seed, is_name

if TYPE_CHECKING:
    from skyproof.detectors.detector import Detector


@dataclass(frozen=True, kw_only=True)
class Score(Rendering):
    """Measures detectors with and without camouflages, and on annotated images.

    The scenes of `--original` are rendered again in every camouflage. T-x is compared with its
    random controls R-x-0, R-x-1, and so on. With `--frames` alone only the baseline is measured. A
    run's report includes every score folder in its `scores` folder.

    Attributes:
        detectors: detector folders.
        out: score folder to write, such as my_run/scores/mine.
        original: dataset without camouflage, whose scenes are rendered again.
        camouflages: camouflage folders, named as in the tables.
        backgrounds: background set folder of the scenes; needed for `--camouflages`.
        fleet: fleet folder of the scenes' vehicles; needed for `--camouflages`.
        frames: annotated images for the baseline, [NAME=]FOLDER[/PATTERN][:LABELS]@GSD[#CLASS,...],
            such as 'kit/MOS*@0.116#car'. The classes are those of vehicles (car and minibus by
            default). Arguments of one NAME are one set of several places.
        frame_classes: vehicle classes of frames that name none. Other objects are ignored.
        seed: seed of the bootstrap.
        device: auto, cpu or cuda.
    """

    detectors: tuple[Path, ...]
    out: Path
    original: Path | None = None
    camouflages: tuple[Path, ...] = ()
    backgrounds: Path | None = None
    fleet: Path | None = None
    frames: tuple[str, ...] = ()
    frame_classes: Suppress[tuple[str, ...]] = ("car", "minibus")
    seed: Suppress[Seed] = 0
    device: str = "auto"

    def run(self) -> None:
        """Measures, and prints success rates and baselines."""
        self._refuse_what_cannot_work()
        self.measure()
        self._say_results()

    def measure(self, loaded: "Sequence[Detector]" = ()) -> None:
        """Writes the score folder; the detectors may be `loaded` already."""
        from skyproof.camouflage.folder import load_camouflage
        from skyproof.cycles.renderer import open_renderer
        from skyproof.datasets.dataset import Dataset
        from skyproof.detectors.card import read_card
        from skyproof.detectors.loaded import load_ensemble
        from skyproof.device import choose_device
        from skyproof.measure.baseline import read_frames
        from skyproof.measure.score import score
        from skyproof.measure.views import SceneChange, SceneRenderer
        from skyproof.scenes.backgrounds import BackgroundSet
        from skyproof.vehicles.fleet import Fleet

        refuse_existing(self.out)
        device = choose_device(self.device)
        original = None if self.original is None else Dataset.open(self.original)
        gsd_m = read_card(self.detectors[0]).gsd_m if original is None else original.gsd_m
        # Detectors of one kind can stand in one table of baselines, told apart by their folders.
        detectors = loaded or load_ensemble(self.detectors, device, gsd_m, apart=original is None)
        baselines = read_frames(self.frames, self.frame_classes, gsd_m)
        worn = {folder: load_camouflage(folder) for folder in self.camouflages}
        scenes = [] if original is None else original.scenes
        backgrounds = None if self.backgrounds is None else BackgroundSet.open(self.backgrounds)
        tiles = dict.fromkeys(scene.background.tile for scene in scenes)
        shown = [backgrounds.tile(name).source for name in tiles] if backgrounds else []
        with ExitStack() as opened, progress_bar("score") as update:
            stage = None
            if backgrounds is not None and self.fleet is not None and original is not None:
                fleet = Fleet.load(self.fleet)
                renderer = opened.enter_context(open_renderer(self, backgrounds, self.out))
                stage = SceneRenderer(fleet, renderer, device)
            score(
                detectors,
                self.out,
                scenes,
                [SceneChange(folder.name, camouflage) for folder, camouflage in worn.items()],
                stage,
                unchanged=original,
                baselines=baselines,
                seed=self.seed,
                sources=list(dict.fromkeys(shown)),
                worn=worn,
                progress=update,
            )

    def _refuse_what_cannot_work(self) -> None:
        """Refuses options that do not fit, before anything is rendered."""
        names = [folder.name for folder in self.camouflages]
        unfit = next((name for name in names if not is_name(name)), None)
        on_nothing = self.backgrounds is None or self.fleet is None
        mistakes = {
            "Scoring expects something to measure the detectors on: --original with --camouflages, "
            "or --frames.": not self.camouflages and not self.frames,
            "Scoring compares --original, a dataset without camouflage, with --camouflages; give "
            "both sides.": bool(self.camouflages) != (self.original is not None),
            "--camouflages are rendered on --backgrounds and --fleet, those of the scenes of "
            "--original; give both.": bool(self.camouflages) and on_nothing,
            "--camouflages expects folders whose names can name a camouflage, got "
            f"{unfit!r}; give each by its own name.": unfit is not None,
            "--camouflages expects folders of different names; score the others separately.": (
                len(set(names)) != len(names)
            ),
        }
        for sentence, made in mistakes.items():
            if made:
                raise ConfigurationError(sentence)

    def _say_results(self) -> None:
        from skyproof.results.results import Results
        from skyproof.words import interval, number, percent

        results = Results.open(self.out)
        for quoted in results.quoted:
            for row in results.by_detector(quoted):
                easr = f"{percent(row.easr.estimate)} ({interval(row.easr.low, row.easr.high)})"
                say(f"  {row.camouflage!s:<24} {row.detector:<14} EASR {easr}")
        for check in results.baselines:
            ap = check.ap_centre_1m
            told = (
                f"AP {percent(ap.estimate)} ({interval(ap.low, ap.high)}, over {check.clusters} "
                f"{check.clustered_by}), {check.vehicles} vehicles"
                if check.vehicles
                else f"{number(check.false_alarms_per_km2)} false alarms per km², no vehicles"
            )
            say(f"  {check.dataset:<24} {check.detector:<14} {told}")
        say(f"Scores: {self.out.resolve()}")
