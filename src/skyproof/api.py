"""The names that programs need, in one place: `import skyproof.api as sp`."""

from skyproof.attacks.attack import attack
from skyproof.attacks.settings import AttackSettings
from skyproof.attacks.sign_test import sign_test
from skyproof.attacks.world import AttackWorld
from skyproof.camouflage.account import practicality_account
from skyproof.camouflage.camouflage import Camouflage, NoCamouflage
from skyproof.camouflage.combination import Combination
from skyproof.camouflage.constraints import TextureConstraints
from skyproof.camouflage.displacement import DisplacementMap
from skyproof.camouflage.folder import load_camouflage, save_camouflage
from skyproof.camouflage.palette import fit_palette
from skyproof.camouflage.recipe import Materials, make_camouflage, read_recipe
from skyproof.camouflage.texture import UniversalTexture
from skyproof.cycles.blender import find_blender
from skyproof.cycles.renderer import CyclesRenderer
from skyproof.cycles.settings import CyclesSettings
from skyproof.cycles.workers import Workers
from skyproof.datasets.coco import read_coco
from skyproof.detectors.bring import Checkpoint, bring_detector
from skyproof.detectors.card import DetectorCard
from skyproof.detectors.detector import Candidates, Detections, Detector, TrainableDetector
from skyproof.detectors.loaded import LoadedDetector, load_detector
from skyproof.detectors.training import validate
from skyproof.render.dataset import render_dataset
from skyproof.render.renderer import TorchRenderer
from skyproof.report.report import write_report
from skyproof.results.clean import CleanSet
from skyproof.results.evaluation import evaluate_pairs
from skyproof.scenes.backgrounds import BackgroundSet
from skyproof.scenes.sampling import sample_scenes
from skyproof.scenes.scene import read_scenes
from skyproof.scenes.settings import SceneSettings
from skyproof.vehicles.fleet import Fleet

__all__ = [
    "AttackSettings",
    "AttackWorld",
    "BackgroundSet",
    "Camouflage",
    "Candidates",
    "Checkpoint",
    "CleanSet",
    "Combination",
    "CyclesRenderer",
    "CyclesSettings",
    "Detections",
    "Detector",
    "DetectorCard",
    "DisplacementMap",
    "Fleet",
    "LoadedDetector",
    "Materials",
    "NoCamouflage",
    "SceneSettings",
    "TextureConstraints",
    "TorchRenderer",
    "TrainableDetector",
    "UniversalTexture",
    "Workers",
    "attack",
    "bring_detector",
    "evaluate_pairs",
    "find_blender",
    "fit_palette",
    "load_camouflage",
    "load_detector",
    "make_camouflage",
    "practicality_account",
    "read_coco",
    "read_recipe",
    "read_scenes",
    "render_dataset",
    "sample_scenes",
    "save_camouflage",
    "sign_test",
    "validate",
    "write_report",
]
