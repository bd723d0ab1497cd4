"""How attacks and trainings went: losses against steps, as parts of the page."""

from markupsafe import Markup

from skyproof.camouflage.name import CamouflageName
from skyproof.layout import Layout
from skyproof.report.figures import loss_figure
from skyproof.results.results import Results
from skyproof.results.stored import read_log


def attack_loss(results: Results, name: CamouflageName) -> Markup | None:
    """Draws the losses of an attack against its steps; None where they are not kept."""
    path = results.pattern(name, "steps.jsonl")
    curves: dict[str, list[tuple[float, float]]] = {}
    for row in [] if path is None else read_log(path):
        losses = row.losses or ({} if row.loss is None else {"all": row.loss})
        for detector, loss in losses.items():
            curves.setdefault(detector, []).append((float(row.step), loss))
    title = f"Attack {name}: loss per detector"
    return Markup(loss_figure(title, curves)) if curves else None


def training_loss(results: Results) -> Markup | None:
    """Draws the losses of the trainings of all detectors; None where none is kept."""
    curves = {}
    for name in results.cards:
        path = Layout(results.folder).detector(name) / "steps.jsonl"
        # The log holds validations too, which have no loss.
        rows = read_log(path) if path.exists() else []
        points = [(float(row.step), row.loss) for row in rows if row.loss is not None]
        if points:
            curves[name] = points
    return Markup(loss_figure("Training of the detectors", curves)) if curves else None
