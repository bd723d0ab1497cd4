"""The demo: a detector, and what hardening made of it, assessed one after the other."""

from dataclasses import replace
from pathlib import Path

from msgspec import to_builtins

from skyproof.assessment.assess import run_assessment
from skyproof.assessment.command import Request
from skyproof.assessment.suite import DEMO_SUITE
from skyproof.console import say
from skyproof.detectors.card import PARENT_FILE, read_card
from skyproof.detectors.loaded import copy_detector, load_detector
from skyproof.documents import read_document
from skyproof.files import finished_folder, write_json
from skyproof.layout import Layout
from skyproof.report.hardened import Parent, as_parent
from skyproof.results.precheck import PRECHECK_FILE
from skyproof.results.results import Results


def run_demo(request: Request, hardened: Path) -> None:
    """Assesses a detector, and then `hardened` beside it."""
    load_detector(hardened)  # refuses a damaged one before any work
    run_assessment(request, DEMO_SUITE)
    folder = Layout(request.out / "hardening").detector(read_card(hardened).name)
    if not folder.exists():
        # What it keeps of its parent is of other scenes than the demo's.
        kept: Parent = read_document(hardened / PARENT_FILE, Parent, "install skyproof again")
        parent = as_parent(Results.open(request.out), kept.attacks, kept.weights_sha256)
        with finished_folder(folder) as partial:
            copy_detector(hardened, partial, [PRECHECK_FILE])
            write_json(partial / PARENT_FILE, to_builtins(parent))
    say("The same attacks on the hardened detector, optimised anew:")
    run_assessment(replace(request, detectors=(folder,), out=request.out / "hardened"), DEMO_SUITE)
