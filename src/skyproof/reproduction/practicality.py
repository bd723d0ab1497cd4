"""What attacks ask of those who would make them: the paper's signs, and measured quantities."""

from __future__ import annotations

from typing import Any

from skyproof.reproduction.cells import Grid, Heading, Part, Table, number, sign
from skyproof.reproduction.reproduction import Reproduction


def practicality_part(run: Reproduction) -> Part:
    """Gives the paper's signs, and what was measured beside them."""
    measured = _rows(run)
    tables = [Table("practicality", measured)]
    heading = Heading("Practicality")
    chosen = {
        "texture_painted_area_m2": ("painted, m²", 1),
        "texture_colours": ("colours", 0),
        "texture_blocks": ("blocks", 0),
        "texture_block_roof_u_cm": ("block on the roof, cm", 0),
        "texture_boundary_m": ("boundaries, m", 0),
        "shape_added_volume_m3": ("added volume, m³", 2),
        "shape_share_self_intersecting": ("share self-intersecting", 2),
    }
    rows = [
        [
            row["attack"],
            sign(row["practicality"]),
            *(number(row.get(key), digits) for key, (_, digits) in chosen.items()),
        ]
        for row in measured
    ]
    if not rows:
        return Part(tables, [heading])
    text = "The paper’s signs, summed, and means over the test fleet measured beside them."
    labels = [label for label, _ in chosen.values()]
    grid = Grid(["attack", "practicality", *labels], rows)
    return Part(tables, [heading, text, grid])


def _rows(run: Reproduction) -> list[dict[str, Any]]:
    rows = []
    for name, measured in run.results.practicality.items():
        score = measured.score
        signs = {"texture": score.texture, "shape": score.shape}
        quantities = {"texture": measured.texture or {}, "shape": measured.shape or {}}
        flat = {
            f"{side}_{what}": value
            for told in (signs, quantities)
            for side, values in told.items()
            for what, value in values.items()
        }
        rows.append({"attack": str(name), "practicality": score.total, **flat})
    return rows
