"""Where camouflaged vehicles lie among a detector's features: with the ground, or with vehicles?

Differences from the paper (section S7, figure S8): every detector that shows its features and not
RetinaNet alone; random and plainly painted vehicles beside the learnt camouflage; and numbers that
are measured on all features, since a picture of two dimensions can show whatever one likes.
"""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib import pyplot as plt
from matplotlib.lines import Line2D

from skyproof.camouflage.name import CamouflageName
from skyproof.report.figures import BLUE, GREEN, GREY, ORANGE, PURPLE, STYLE, as_files
from skyproof.reproduction.cells import (
    Block,
    Figure,
    Heading,
    Table,
    TextTable,
    Topic,
    detector_of,
    interval_cells,
    number,
    rate,
    value,
)
from skyproof.reproduction.feature_space import Embedding, embed
from skyproof.reproduction.reproduction import Reproduction
from skyproof.reproduction.stored_features import GROUND, Features
from skyproof.results.pairs.outcomes import ORIGINAL
from skyproof.words import detector_name

EVERY = "all"
"""Stands for all that is shown together in the table's last row of a detector."""

# Of ground and of each kind of vehicle; below there is nothing to see.
_FEWEST = 10


def features_part(run: Reproduction) -> Topic:
    """Gives the numbers by detector and class, the points of the pictures, and what they show.

    Raises:
        StoredFileError: the table of features is damaged.
    """
    numbers: list[dict[str, Any]] = []
    points: list[dict[str, Any]] = []
    every = run.features
    for name in _learnt(every):
        for detector in run.detectors:
            stored = _classes(every, name, detector)
            if not stored:
                continue
            embedding = embed(
                {shown: each.vectors for shown, each in stored.items()},
                {shown: each.backgrounds for shown, each in stored.items()},
            )
            numbers += _number_rows(str(name), detector, embedding)
            points += _point_rows(str(name), detector, embedding, stored)
    if not numbers:
        return Topic()
    tables = [Table("embeddings", numbers), Table("embedding_points", points)]
    return Topic(tables, _blocks(run, numbers, points))


def _learnt(every: Sequence[Features]) -> list[CamouflageName]:
    names = (
        CamouflageName.read(each.shown).pooled
        for each in every
        if each.shown not in (GROUND, ORIGINAL)
    )
    return list(dict.fromkeys(name for name in names if not name.random))


def _classes(
    every: Sequence[Features], name: CamouflageName, detector: str
) -> Mapping[str, Features]:
    """Gives what is stored of ground, vehicles, a camouflage, its control and the plain paint.

    Nothing where ground, vehicles or the camouflage are missing or too few.
    """
    plain = name.chosen_controls[0]
    wanted = [GROUND, ORIGINAL, str(name), str(name.control), str(plain)]
    found = {
        shown: each
        for each in every
        if each.detector == detector and len(each.vectors) >= _FEWEST
        for shown in [_pooled(each.shown)]
        if shown in wanted
    }
    tiles = {tile for each in found.values() for tile in each.backgrounds}
    if len(tiles) < 2 or any(shown not in found for shown in wanted[:3]):
        return {}
    return {shown: found[shown] for shown in wanted if shown in found}


def _pooled(shown: str) -> str:
    return shown if shown in (GROUND, ORIGINAL) else str(CamouflageName.read(shown).pooled)


def _number_rows(name: str, detector: str, embedding: Embedding) -> list[dict[str, Any]]:
    rows = [
        {
            "camouflage": name,
            "detector": detector,
            "shown": shown,
            "boxes": each.boxes,
            "silhouette": each.silhouette,
            **interval_cells("nearest_own", each.nearest_own, 100.0),
            **interval_cells("nearer_ground", each.nearer_ground, 100.0),
            **({} if each.along is None else interval_cells("along", each.along)),
            "aside": each.aside,
        }
        for shown, each in zip(embedding.classes, embedding.shown, strict=True)
    ]
    together = {
        "camouflage": name,
        "detector": detector,
        "shown": EVERY,
        "boxes": len(embedding.class_of),
        "silhouette": embedding.silhouette,
        "nearest_own": 100 * embedding.nearest_own,
        "pca_share": 100 * embedding.pca_share,
    }
    return [*rows, together]


def _point_rows(
    name: str, detector: str, embedding: Embedding, stored: Mapping[str, Features]
) -> list[dict[str, Any]]:
    told = [
        (scene, tile, placement)
        for each in stored.values()
        for scene, tile, placement in zip(
            each.scenes, each.backgrounds, each.placements, strict=True
        )
    ]
    return [
        {
            "camouflage": name,
            "detector": detector,
            "shown": embedding.classes[index],
            "scene": scene,
            "background": tile,
            "placement": placement,
            "pca_1": float(pca[0]),
            "pca_2": float(pca[1]),
            "tsne_1": float(tsne[0]),
            "tsne_2": float(tsne[1]),
        }
        for index, pca, tsne, (scene, tile, placement) in zip(
            embedding.class_of, embedding.pca, embedding.tsne, told, strict=True
        )
    ]


def _blocks(
    run: Reproduction, rows: Sequence[Mapping[str, Any]], points: Sequence[Mapping[str, Any]]
) -> list[Block]:
    known = {row["detector"] for row in rows}
    silent = [detector_name(each) for each in run.detectors if each not in known]
    parts: list[Block] = [
        Heading("What the detectors’ features show"),
        "Does a camouflage make a vehicle look like ground to a detector? Each point is the mean "
        "of the detector’s feature pyramid over one vehicle’s box, at the level that the detector "
        "gives a box of that size; “ground” are boxes as large, a metre or more from every "
        "vehicle. Boxes of two levels lie in two groups, whatever they show. Both pictures are "
        "drawn of the same points; distances between groups mean little in that of t-SNE, so the "
        "numbers below are of all features, each scaled to variance 1.",
        Figure(
            "embeddings",
            "Features at vehicles and at ground: PCA left, t-SNE right",
            _figure(points, rows),
        ),
        "“Silhouette” is from −1 (a box lies among others) to 1 (its class lies by itself). "
        "“Own class” is the share of boxes, in percent, whose nearest class mean is their own; "
        "“nearer to ground” the share that lies nearer to the mean of the ground than to that of "
        "vehicles as they were, both by means of other background tiles. “Along” says where the "
        "class’s mean lies on the straight way from vehicles as they were (0) to the ground (1), "
        "“aside” how far off that way it lies, in lengths of the way. Brackets hold 95 % "
        "intervals over background tiles.",
        TextTable.of(
            rows,
            [
                ("camouflage", "camouflage"),
                ("detector", detector_of),
                ("shown", lambda row: shown_name(row["shown"])),
                ("boxes", "boxes"),
                ("silhouette", value("silhouette", 2)),
                ("own class, %", rate("nearest_own", 0)),
                ("nearer to ground, %", rate("nearer_ground", 0)),
                ("along", rate("along", 2)),
                ("aside", value("aside", 2)),
            ],
        ),
        *_readings(rows),
    ]
    if silent:
        parts.append(
            f"Of {', '.join(silent)} no features are stored: not every detector shows its own."
        )
    return parts


def _readings(rows: Sequence[Mapping[str, Any]]) -> list[str]:
    """Says per camouflage and detector how near to the ground it comes."""
    said = []
    for row in rows:
        if row["shown"] != row["camouflage"]:
            continue
        said.append(
            f"{detector_name(row['detector'])}: {number(row['nearer_ground'], 0)} % of the "
            f"vehicles with {row['camouflage']} lie nearer to the ground than to vehicles as they "
            f"were, and {number(row['nearest_own'], 0)} % still nearest to others with "
            f"{row['camouflage']}."
        )
    return [" ".join(said)] if said else []


def shown_name(shown: str) -> str:
    """Says what a class is, in words."""
    if shown in (GROUND, EVERY):
        return {GROUND: "ground", EVERY: "mean of classes"}[shown]
    if shown == ORIGINAL:
        return "vehicles as they were"
    name = CamouflageName.read(shown)
    if name.choice == "plain":
        return f"best plain paint ({shown})"
    return f"random ({shown})" if name.random else shown


def _figure(
    points: Sequence[Mapping[str, Any]], numbers: Sequence[Mapping[str, Any]]
) -> dict[str, bytes]:
    """Draws one line of two pictures per camouflage and detector; SVG or PNG by file ending."""
    shares = {
        (row["camouflage"], row["detector"]): row["pca_share"]
        for row in numbers
        if row["shown"] == EVERY
    }
    lines: dict[tuple[str, str], list[Any]] = {}
    for row in points:
        lines.setdefault((row["camouflage"], row["detector"]), []).append(row)
    several = len({camouflage for camouflage, _ in lines}) > 1
    with plt.rc_context(STYLE | {"svg.hashsalt": "embeddings"}):
        figure, grid = plt.subplots(
            len(lines), 2, figsize=(10.5, 0.7 + 4.3 * len(lines)), layout="constrained",
            squeeze=False,
        )  # fmt: skip
        for (left, right), ((camouflage, detector), rows) in zip(grid, lines.items(), strict=True):
            share = f"PCA ({shares[camouflage, detector]:.0f} % of the variance)"
            for axes, name, title in ((left, "pca", share), (right, "tsne", "t-SNE")):
                _scatter(axes, rows, name)
                told = f"{detector_name(detector)}, {title}"
                axes.set_title(
                    f"{camouflage}: {told}" if several else told,
                    loc="left",
                    fontsize=12,
                    fontweight="bold",
                )
        shown = dict.fromkeys(row["shown"] for row in points)
        figure.legend(
            handles=[_handle(each) for each in shown],
            loc="outside lower center",
            ncols=3,
            fontsize=11,
        )
        return as_files(figure)


def _scatter(axes: Any, rows: Sequence[Any], name: str) -> None:
    """Draws all points in a fixed random order, so that no class lies on top of the others."""
    order = np.random.default_rng(0).permutation(len(rows))
    places = np.array([[row[f"{name}_1"], row[f"{name}_2"]] for row in rows])
    for start in range(0, len(order), 40):
        part = order[start : start + 40]
        for shown in dict.fromkeys(rows[index]["shown"] for index in part):
            own = [index for index in part if rows[index]["shown"] == shown]
            colour, marker = _marker(shown)
            axes.plot(
                places[own, 0],
                places[own, 1],
                marker,
                color=colour,
                markersize=4.5,
                alpha=0.75,
                markeredgecolor="white",
                markeredgewidth=0.3,
            )
    axes.set_xlabel("first component" if name == "pca" else "")
    axes.set_ylabel("second component" if name == "pca" else "")
    # Neither plane has a unit that could be read off.
    axes.set_xticks([])
    axes.set_yticks([])


def _marker(shown: str) -> tuple[str, str]:
    """Okabe and Ito's colours, safe for colour-blind readers; markers differ as well."""
    if shown in (GROUND, ORIGINAL):
        return {GROUND: (GREY, "s"), ORIGINAL: (BLUE, "o")}[shown]
    name = CamouflageName.read(shown)
    if name.choice == "plain":
        return GREEN, "v"
    return (PURPLE, "D") if name.random else (ORANGE, "^")


def _handle(shown: str) -> Line2D:
    colour, marker = _marker(shown)
    label = shown_name(shown)
    return Line2D([], [], color=colour, marker=marker, linestyle="", markersize=7, label=label)
