"""The page of a reproduction: the paper's tables, and one part for every topic that backs them."""

from collections.abc import Sequence

from skyproof.reproduction.agreement import agreement_part
from skyproof.reproduction.cells import Part
from skyproof.reproduction.colours import colours_part
from skyproof.reproduction.criteria import criteria_part
from skyproof.reproduction.cycles import cycles_part
from skyproof.reproduction.features import features_part
from skyproof.reproduction.held_out import held_out_part
from skyproof.reproduction.looks import looks_part
from skyproof.reproduction.practicality import practicality_part
from skyproof.reproduction.reproduction import Reproduction
from skyproof.reproduction.tables import main_part
from skyproof.reproduction.trainings import trainings_part
from skyproof.reproduction.transfer import transfer_part
from skyproof.reproduction.trust import trust_part
from skyproof.reproduction.variability import variability_part
from skyproof.reproduction.weather import weather_part


def paper_parts(run: Reproduction) -> Sequence[Part]:
    """Says what is to be said of a reproduction beside the paper, topic by topic.

    Raises:
        ConfigurationError: scores do not belong together.
        StoredFileError: a file is damaged.
    """
    main = main_part(run)
    textures, shapes, _ = main.tables
    rows = [*textures.rows, *shapes.rows]
    return [
        main,
        agreement_part(run),
        cycles_part(run, rows),
        held_out_part(run),
        trust_part(run, rows),
        criteria_part(run),
        transfer_part(run),
        trainings_part(run),
        weather_part(run),
        features_part(run),
        practicality_part(run),
        colours_part(run),
        variability_part(run),
        looks_part(run),
    ]
