"""Have the attacks converged? What the second half of their steps added."""

from __future__ import annotations

from typing import Any

from skyproof.reproduction.cells import Block, Grid, Heading, Table, number
from skyproof.reproduction.reproduction import Reproduction


def convergence_table(run: Reproduction) -> Table:
    """Gives per attack and seed what it hid half-way and at the end, on scenes of its own world."""
    rows: list[dict[str, Any]] = []
    for name, record in run.records.items():
        found = record.convergence
        if found is None:
            continue
        rows.append(
            {
                "attack": name,
                "half_steps": found.steps[0],
                "steps": found.steps[1],
                "scenes": found.scenes,
                "hidden_half_way": 100 * found.hidden[0],
                "hidden": 100 * found.hidden[1],
                "added": 100 * (found.hidden[1] - found.hidden[0]),
                "converged": found.converged,
            }
        )
    return Table("convergence", rows)


def convergence_section(table: Table) -> list[Block]:
    """Says how many have converged, and shows the others."""
    if not table.rows:
        return []
    others = [row for row in table.rows if not row["converged"]]
    text = (
        f"In {len(table.rows) - len(others)} of {len(table.rows)} attacks the second half of the "
        f"steps hid at most 2 points more, on {table.rows[0]['scenes']} scenes of the attack’s own "
        "world that no step saw. More steps may make the others stronger."
    )
    heading = Heading("Convergence", 3)
    if not others:
        return [heading, text]
    cells = [
        [
            row["attack"],
            str(row["half_steps"]),
            number(row["hidden_half_way"]),
            str(row["steps"]),
            number(row["hidden"]),
        ]
        for row in sorted(others, key=lambda row: -row["added"])
    ]
    return [heading, text, Grid(["not converged", "steps", "EASR", "steps", "EASR"], cells)]
