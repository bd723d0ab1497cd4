"""Writes a reproduction's tables, its figure and one page that shows them."""

from __future__ import annotations

from pathlib import Path

from skyproof.files import write_bytes, write_json
from skyproof.paper.page import reproduction_page, shape_table, texture_table
from skyproof.paper.run import read_reproduction
from skyproof.paper.tables import reproduction_tables
from skyproof.report.practicality_figure import easr_against_practicality

__all__ = ["write_reproduction"]


def write_reproduction(run_folder: Path) -> Path:
    """Writes `results.json` and `tables/` into a run folder, from its scores and records alone.

    Returns:
        The page, `tables/README.md`, written last.

    Raises:
        StoredFileError: nothing was scored yet, or a file is damaged.
        ConfigurationError: the scores do not belong together.
        RunFolderError: the disk cannot take it.
    """
    run = read_reproduction(run_folder)
    place = run.folder / "tables"
    tables = reproduction_tables(run)
    write_json(run.folder / "results.json", {"rows": run.rows})
    for name, table in tables.items():
        write_bytes(place / f"{name}.csv", table.csv().encode())
    for name, text in (
        ("textures", texture_table(tables["textures"])),
        ("shape_combined", shape_table(tables["shape_combined"])),
    ):
        write_bytes(place / f"{name}.md", (text + "\n").encode())
    for ending, picture in easr_against_practicality(run).items():
        write_bytes(place / f"easr_vs_pr.{ending}", picture)
    page = place / "README.md"
    write_bytes(page, reproduction_page(run, tables).encode())
    return page
