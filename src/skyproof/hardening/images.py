"""Images to harden a detector that is trained elsewhere."""

from pathlib import Path
from typing import Any

from skyproof.assessment.suite import read_suite
from skyproof.camouflage.camouflage import Camouflage
from skyproof.camouflage.folder import load_camouflage
from skyproof.camouflage.random_controls import RandomPatterns
from skyproof.cli.render import sampled_scenes
from skyproof.console import progress_bar, say
from skyproof.cycles.renderer import open_renderer
from skyproof.cycles.settings import Rendering
from skyproof.detectors.card import DetectorCard
from skyproof.device import choose_device
from skyproof.documents import read_document
from skyproof.errors import ConfigurationError
from skyproof.files import file_digest, refuse_existing, write_json
from skyproof.hardening.command import Harden
from skyproof.hardening.training import EMPTY_SHARE
from skyproof.layout import Layout
from skyproof.loop import refuse_other
from skyproof.render.dataset import render_dataset
from skyproof.report.advice import hardening
from skyproof.results.result import MAIN_MATCH
from skyproof.results.results import RENDERER, Results
from skyproof.scenes.backgrounds import BackgroundSet
from skyproof.scenes.places import Places
from skyproof.scenes.settings import TRAINING_MARGIN_M, TRAINING_WEATHER, SceneSettings, side_px
from skyproof.vehicles.fleet import Fleet

_PAINTED, _CAMOUFLAGED = 400, 800


def strongest(results: Results) -> list[str]:
    """Returns the folders of at most two attacks, as the report names them, and of one control.

    Raises ConfigurationError if no attack surely hides anything.
    """
    found = hardening(results, results.quoted)
    if found is None:
        raise ConfigurationError(
            f"No attack in {results.folder} surely hides anything, or its scenes and camouflages "
            "are gone, so there is nothing to harden against; copy the whole folder again."
        )
    controls = {
        str(row.camouflage): row.easr.estimate
        for row in results.rows
        if row.camouflage.random and row.match == MAIN_MATCH and row.renderer == RENDERER
        # A random shape on an attack's own texture is no control of that texture.
        if row.easr.low > 0 and row.camouflage.order != "seq"
        if str(row.camouflage) in results.records
    }
    return [*found.attacks, *sorted(controls, key=lambda name: -controls[name])[:1]]


def render_images(
    request: Harden, card: DetectorCard, names: list[str], backgrounds: Path, places: Places
) -> None:
    """Renders vehicles in many paints and in the named camouflages of an assessment.

    The shares are those of `harden`, where a quarter of the images are labelled photographs.
    Finished folders are left as they are.
    """
    layout, out = Layout(request.run_folder), Layout(request.out)
    device = choose_device("auto")
    ground, fleet = BackgroundSet.open(backgrounds), Fleet.load(out.fleets / "train")
    images = dict.fromkeys(names, (_CAMOUFLAGED // len(names), 0.0))
    images["paints"] = (_PAINTED, EMPTY_SHARE)
    with open_renderer(Rendering(), ground, out.folder) as renderer:
        for name, (count, empty) in images.items():
            if out.dataset(name).exists():
                continue
            settings = SceneSettings(
                size_px=side_px(read_suite().image_m, card.gsd_m),
                places=places,
                conditions=TRAINING_WEATHER,
                empty_share=empty,
                margin_m=TRAINING_MARGIN_M,
            )
            worn: Camouflage | RandomPatterns = RandomPatterns(fleet)
            if name in names:
                worn = load_camouflage(layout.camouflages / name).to(device)
            with progress_bar(f"render {name}") as update:
                render_dataset(
                    out.dataset(name),
                    # Image names differ between folders, so that all images can be put into one.
                    sampled_scenes(
                        settings, ground, fleet, "attack", count, request.seed, name=name
                    ),
                    fleet,
                    renderer,
                    camouflage=worn,
                    yolo=True,
                    device=device,
                    progress=update,
                )
    say(
        f"skyproof cannot train {card.name}. Add the images of "
        f"{out.dataset('paints').parent.resolve()} to its training, about three for each labelled "
        "photograph. Each folder has labels for Ultralytics (data.yaml, class 0 is vehicle) and in "
        "COCO format (annotations.json). Then assess the detector anew: one that resists these "
        "camouflages may not resist new ones."
    )


def refuse_other_images(request: Harden, card: DetectorCard, names: list[str]) -> None:
    """Refuses to mix images of two assessments, and refuses options without effect."""
    layout, out = Layout(request.run_folder), Layout(request.out)
    if request.data or request.steps != Harden.steps:
        raise ConfigurationError(
            f"{card.name} cannot be trained here, and images are rendered for its own training; "
            "leave out --data and --steps."
        )
    wanted = {
        "results_sha256": file_digest(layout.results),
        "camouflages": names,
        "seed": request.seed,
    }
    identity = out.folder / "images.json"
    if identity.exists():
        stored: Any = read_document(identity, dict[str, Any], "choose another --out")
        refuse_other(out.folder, stored, wanted, "images of another assessment or seed")
    else:
        refuse_existing(out.folder)
        write_json(identity, wanted)
