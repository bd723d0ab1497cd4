"""What attacks ask of those who would make them: the paper's signs, and measured quantities."""

from typing import Any

from skyproof.reproduction.cells import TextTable, Topic, sign, value
from skyproof.reproduction.reproduction import Reproduction


def practicality_part(run: Reproduction) -> Topic:
    """Gives the paper's signs, and what was measured beside them."""
    measured = _rows(run)
    tables = {"practicality": measured}
    if not measured:
        return Topic.of("Practicality", tables)
    text = "The paper’s signs, summed, and means over the test fleet measured beside them."
    grid = TextTable.of(
        measured,
        [
            ("attack", "attack"),
            ("practicality", lambda row: sign(row["practicality"])),
            ("painted, m²", value("texture_painted_area_m2")),
            ("colours", value("texture_colours", 0)),
            ("blocks", value("texture_blocks", 0)),
            ("block on the roof, cm", value("texture_block_roof_u_cm", 0)),
            ("boundaries, m", value("texture_boundary_m", 0)),
            ("added volume, m³", value("shape_added_volume_m3", 2)),
            ("share self-intersecting", value("shape_share_self_intersecting", 2)),
        ],
    )
    return Topic.of("Practicality", tables, text, grid)


def _rows(run: Reproduction) -> list[dict[str, Any]]:
    rows = []
    for name, measured in run.results.practicality.items():
        row: dict[str, Any] = {"attack": str(name), "practicality": measured.score.total}
        for told in (measured.score, measured):
            for side in ("texture", "shape"):
                values = getattr(told, side) or {}
                row |= {f"{side}_{what}": value for what, value in values.items()}
        rows.append(row)
    return rows
