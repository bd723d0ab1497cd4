"""The report's last parts: every row of the results, and every setting of the run."""

import json
from collections.abc import Mapping
from typing import Any

from skyproof.results.result import LENIENT_MATCH, MAIN_MATCH, Result
from skyproof.results.results import Results
from skyproof.words import renderer_name


def full_tables(results: Results) -> list[tuple[str, list[Result]]]:
    """Groups the rows by match criterion and renderer, with headings; the main criterion first."""
    criteria = {
        MAIN_MATCH: "found = centre within 1.0 m",
        "iou_50": "found = boxes overlap by IoU ≥ 0.5",
        LENIENT_MATCH: "found = centre within 1.0 m or inside the vehicle’s box",
    }
    tables = []
    for match, meaning in criteria.items():
        for renderer in results.renderers:
            name = renderer_name(renderer)
            alone = len(results.renderers) == 1
            whose = f"Renderer {renderer}" if alone else name[0].upper() + name[1:]
            rows = [row for row in results.rows if (row.match, row.renderer) == (match, renderer)]
            if rows:
                tables.append((f"{whose}, {meaning}", rows))
    return tables


def flat_settings(value: Any, prefix: str = "") -> list[tuple[str, str]]:
    """Settings as dotted names and values."""
    if isinstance(value, Mapping):
        return [
            pair
            for key, inner in value.items()
            for pair in flat_settings(inner, f"{prefix}.{key}" if prefix else str(key))
        ]
    if isinstance(value, list):
        plain = all(not isinstance(item, list | dict) for item in value)
        return [(prefix, ", ".join(map(str, value)) if plain else json.dumps(value))]
    return [(prefix, str(value))]
