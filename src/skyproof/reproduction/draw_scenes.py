"""The step that draws scenes."""

from pathlib import Path

from skyproof.console import say
from skyproof.files import new_file
from skyproof.randomness import generator_of
from skyproof.scenes.backgrounds import BackgroundSet
from skyproof.scenes.sampling import sample_scenes
from skyproof.scenes.scene import write_scenes
from skyproof.scenes.settings import SceneSettings
from skyproof.scenes.splits import Split
from skyproof.vehicles.fleet import Fleet


def draw_scenes(
    *,
    backgrounds: Path,
    fleet: Path,
    out: Path,
    split: Split,
    count: int,
    settings: SceneSettings,
    seed: int,
) -> None:
    """Samples scenes on a split's ground, and writes them as JSON lines."""
    with new_file(out):
        scenes = sample_scenes(
            settings,
            BackgroundSet.open(backgrounds),
            split,
            Fleet.load(fleet).sizes_m,
            count,
            generator=generator_of(seed, "scenes", split),
            prefix=split,
        )
        write_scenes(out, scenes)
    say(f"Scenes: {out.resolve()}")
