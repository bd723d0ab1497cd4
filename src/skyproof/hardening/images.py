"""Images to harden a detector that is trained elsewhere."""

from pathlib import Path

from skyproof.assessment.suite import read_suite, side_px
from skyproof.camouflage.name import CamouflageName
from skyproof.cli.render import Render
from skyproof.console import say
from skyproof.detectors.card import DetectorCard
from skyproof.hardening.training import EMPTY_SHARE, WEATHER
from skyproof.layout import Layout
from skyproof.results.results import RENDERER, Results
from skyproof.scenes.places import Places
from skyproof.scenes.settings import SceneSettings

_PAINTED, _CAMOUFLAGED = 400, 800
_ATTACKS = 2


def render_images(
    layout: Layout, out: Layout, backgrounds: Path, places: Places, card: DetectorCard, seed: int
) -> None:
    """Renders vehicles in many paints and in the camouflages of an assessment that hide most.

    These are two attacks and one control. The shares are those of `harden`, where a quarter of the
    images are labelled photographs. Finished folders are left as they are.
    """
    names = _strongest(Results.open(layout.folder))
    images: dict[str, tuple[Path | None, int, float]] = {
        name: (layout.camouflages / name, _CAMOUFLAGED // len(names), 0.0) for name in names
    }
    images["paints"] = (None, _PAINTED, EMPTY_SHARE)
    for row, (name, (camouflage, count, empty)) in enumerate(images.items()):
        folder = out.dataset(name)
        if folder.exists():
            continue
        Render(
            backgrounds=backgrounds,
            fleet=out.fleets / "train",
            out=folder,
            split="attack",
            count=count,
            settings=SceneSettings(
                size_px=side_px(read_suite().image_m, card.gsd_m),
                places=places,
                conditions=WEATHER,
                empty_share=empty,
            ),
            # Ground and vehicles of one camouflage are not those of the next.
            seed=seed + row,
            camouflage=camouflage,
            labels="yolo",
        ).run()
    say(
        f"{card.name} cannot be trained here, so add these images to its own training, three to "
        "every labelled photograph. Ultralytics reads data.yaml in each folder, others "
        "annotations.json (COCO). Then assess it anew: a detector that is hardened against a known "
        "camouflage is not thereby hardened against the next."
    )


def _strongest(results: Results) -> list[str]:
    """Folders of the attacks, of different kinds, and of the control that hide most."""
    rates: dict[tuple[bool, str], tuple[float, str]] = {}
    for row in results.rows:
        name = row.camouflage
        # A random shape on an attack's own texture is no control of that texture.
        other = row.renderer != RENDERER or (name.random and name.order == "seq")
        folder = next((each for each in _folders(name) if each in results.records), None)
        if folder and not other and row.easr.low > 0:
            kind = (name.random, str(name.control))
            rates[kind] = max(rates.get(kind, (0.0, "")), (row.easr.estimate, folder))
    ranked = sorted(rates, key=lambda kind: -rates[kind][0])
    attacks = [rates[kind][1] for kind in ranked if not kind[0]]
    controls = [rates[kind][1] for kind in ranked if kind[0]]
    return attacks[:_ATTACKS] + controls[:1]


def _folders(name: CamouflageName) -> tuple[str, str]:
    return str(name), str(name.with_repeat(0))
