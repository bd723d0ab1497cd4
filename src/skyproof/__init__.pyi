"""The names that programs need; `__init__.py` imports each one when it is first asked for."""

__version__: str

from .assessment.assess import assess as assess
from .attacks.attack import attack as attack
from .attacks.queries import query_attack as query_attack
from .attacks.settings import AttackSettings as AttackSettings
from .attacks.settings import QuerySettings as QuerySettings
from .attacks.world import World as World
from .camouflage.camouflage import Camouflage as Camouflage
from .camouflage.folder import load_camouflage as load_camouflage
from .camouflage.folder import save_camouflage as save_camouflage
from .camouflage.make import make_camouflage as make_camouflage
from .cycles.renderer import CyclesRenderer as CyclesRenderer
from .datasets.dataset import Dataset as Dataset
from .detectors.detector import Detector as Detector
from .detectors.detector import TrainableDetector as TrainableDetector
from .detectors.import_checkpoint import import_detector as import_detector
from .detectors.loaded import load_detector as load_detector
from .errors import SkyproofError as SkyproofError
from .measure.measure import measure as measure
from .render.renderer import TorchRenderer as TorchRenderer
from .report.report import write_report as write_report
from .results.results import Results as Results
from .scenes.backgrounds import BackgroundSet as BackgroundSet
from .scenes.scene import Scene as Scene
from .vehicles.fleet import Fleet as Fleet
