"""The names that programs need; `__init__.py` imports each one when it is first asked for."""

__version__: str

from .attacks.attack import attack as attack
from .attacks.settings import AttackSettings as AttackSettings
from .attacks.sign_test import sign_test as sign_test
from .attacks.world import AttackWorld as AttackWorld
from .camouflage.account import practicality_account as practicality_account
from .camouflage.camouflage import Camouflage as Camouflage
from .camouflage.combination import Combination as Combination
from .camouflage.constraints import TextureConstraints as TextureConstraints
from .camouflage.displacement import DisplacementMap as DisplacementMap
from .camouflage.folder import load_camouflage as load_camouflage
from .camouflage.folder import save_camouflage as save_camouflage
from .camouflage.make import make_camouflage as make_camouflage
from .camouflage.name import CamouflageName as CamouflageName
from .camouflage.palette import ground_palette as ground_palette
from .camouflage.palette import load_palette as load_palette
from .camouflage.settings import CamouflageSettings as CamouflageSettings
from .camouflage.texture import UniversalTexture as UniversalTexture
from .cycles.blender import find_blender as find_blender
from .cycles.renderer import CyclesRenderer as CyclesRenderer
from .cycles.settings import CyclesSettings as CyclesSettings
from .cycles.workers import Workers as Workers
from .datasets.dataset import Dataset as Dataset
from .detectors.card import DetectorCard as DetectorCard
from .detectors.detector import Candidates as Candidates
from .detectors.detector import Detections as Detections
from .detectors.detector import Detector as Detector
from .detectors.detector import TrainableDetector as TrainableDetector
from .detectors.import_checkpoint import Checkpoint as Checkpoint
from .detectors.import_checkpoint import import_detector as import_detector
from .detectors.loaded import LoadedDetector as LoadedDetector
from .detectors.loaded import load_detector as load_detector
from .detectors.training import validate as validate
from .render.dataset import render_dataset as render_dataset
from .render.renderer import TorchRenderer as TorchRenderer
from .report.report import write_report as write_report
from .results.clean import CleanSet as CleanSet
from .results.results import Results as Results
from .results.scoring import score_detectors as score_detectors
from .scenes.backgrounds import BackgroundSet as BackgroundSet
from .scenes.sampling import sample_scenes as sample_scenes
from .scenes.scene import read_scenes as read_scenes
from .scenes.settings import SceneSettings as SceneSettings
from .vehicles.fleet import Fleet as Fleet
