"""Where camouflaged vehicles lie among a detector's features: with the ground, or with vehicles?

Differences from the paper (section S7, figure S8): other detectors than RetinaNet, random and
plainly painted vehicles, and numbers of all features, because pictures in two dimensions mislead.
"""

import itertools
from collections import defaultdict
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int
from matplotlib.lines import Line2D

from skyproof.camouflage.name import CamouflageName
from skyproof.report.figures import BLUE, GREEN, GREY, ORANGE, PURPLE, panels
from skyproof.reproduction.cells import (
    Block,
    Figure,
    TextTable,
    Topic,
    detector_of,
    interval_cells,
    rate,
    value,
)
from skyproof.reproduction.figures import as_files, figure_style
from skyproof.reproduction.reproduction import Reproduction
from skyproof.reproduction.stored import GROUND, Features
from skyproof.results.outcomes import ORIGINAL
from skyproof.results.statistics.intervals import Interval, cluster_interval, resample, share_of
from skyproof.words import detector_name

EVERY = "all"
"""Stands for all classes together, in a detector's last row of the table."""

_FOLDS = 5
_SEED = 0
_PERPLEXITY = 30.0
# With more, t-SNE's neighbours hardly change, and it takes several times as long (its authors).
_COMPONENTS = 50

# Fewest boxes of ground and of each kind of vehicle; fewer show nothing.
_FEWEST = 10


def features_part(run: Reproduction) -> Topic:
    """Returns the numbers by detector and class, the points of the pictures, and what they show."""
    numbers: list[dict[str, Any]] = []
    points: list[dict[str, Any]] = []
    every = {
        (each.detector, _pooled(each.shown)): each
        for each in run.features
        if len(each.vectors) >= _FEWEST
    }
    names = dict.fromkeys(shown for _, shown in every if shown not in (GROUND, ORIGINAL))
    learnt = [name for name in map(CamouflageName.read, names) if not name.random]
    for name, detector in itertools.product(learnt, run.detectors):
        needed = [GROUND, ORIGINAL, str(name)]
        wanted = [*needed, str(name.control), str(name.chosen_controls[0])]
        stored = {kind: every[detector, kind] for kind in wanted if (detector, kind) in every}
        tiles = {tile for each in stored.values() for tile in each.backgrounds}
        if len(tiles) < 2 or any(kind not in stored for kind in needed):
            continue
        place = {"camouflage": str(name), "detector": detector}
        found, plane = embed(stored)
        numbers += [place | row for row in found]
        points += [place | row for row in plane]
    if not numbers:
        return Topic()
    tables = {"embeddings": numbers, "embedding_points": points}
    return Topic.of("What the detectors’ features show", tables, *_blocks(run, numbers, points))


def _pooled(shown: str) -> str:
    return shown if shown in (GROUND, ORIGINAL) else str(CamouflageName.read(shown).pooled)


def embed(classes: Mapping[str, Features]) -> tuple[list[dict[str, Any]], list[dict[str, Any]]]:
    """Measures and draws the features of several classes, ground and original vehicles first.

    Every feature is scaled to variance 1. Class means are those of other tiles, in five parts, so
    that neighbours and one vehicle with two camouflages are never on both sides. Gives a row for
    each class and one for all, and a row for each box with its places by PCA and t-SNE.
    """
    from sklearn.decomposition import PCA
    from sklearn.manifold import TSNE
    from sklearn.metrics import silhouette_samples
    from sklearn.preprocessing import StandardScaler

    stored = list(classes.values())
    class_of = np.repeat(np.arange(len(classes)), [len(own.vectors) for own in stored])
    features = np.concatenate([own.vectors for own in stored])
    tile_of = np.concatenate([np.asarray(own.backgrounds, dtype=object) for own in stored])
    scaled = StandardScaler().fit_transform(features)

    # Numbers, in all dimensions.
    silhouettes = silhouette_samples(scaled, class_of)
    nearest = _nearest_means(features, class_of, tile_of, len(classes))
    ends = _nearest_means(features, class_of, tile_of, 2)
    means = np.stack([scaled[class_of == number].mean(axis=0) for number in range(len(classes))])
    way = means[0] - means[1]
    length = float(way @ way)
    along = (scaled - means[1]) @ way / length
    numbers: list[dict[str, Any]] = []
    for index, shown in enumerate(classes):
        own = class_of == index
        tiles = tile_of[own]
        row: dict[str, Any] = {
            "shown": shown,
            "boxes": int(own.sum()),
            "silhouette": float(silhouettes[own].mean()),
        }
        row |= interval_cells("nearest_own", _share_by_tile(nearest[own] == index, tiles), 100.0)
        row |= interval_cells("nearer_ground", _share_by_tile(ends[own] == 0, tiles), 100.0)
        row["aside"] = None
        # The first two classes are the ends of the way by definition.
        if index > 1:
            off = means[index] - means[1] - along[own].mean() * way
            row["aside"] = float(np.linalg.norm(off)) / length**0.5
            row |= interval_cells("along", _mean_by_tile(along[own], tiles))
        numbers.append(row)

    # Pictures, in two.
    components = PCA(min(_COMPONENTS, *scaled.shape), random_state=_SEED).fit(scaled)
    reduced = components.transform(scaled)
    perplexity = min(_PERPLEXITY, (len(scaled) - 1) / 3)
    tsne = TSNE(init="pca", perplexity=perplexity, random_state=_SEED).fit_transform(reduced)
    together = {
        "shown": EVERY,
        "boxes": len(features),
        "silhouette": float(np.mean([row["silhouette"] for row in numbers])),
        "nearest_own": float(np.mean([row["nearest_own"] for row in numbers])),
        "pca_share": 100 * float(components.explained_variance_ratio_[:2].sum()),
    }
    boxes = [
        {"shown": shown, "scene": scene, "background": tile, "placement": placement}
        for shown, own in classes.items()
        for scene, tile, placement in zip(own.scenes, own.backgrounds, own.placements, strict=True)
    ]
    names = ("pca_1", "pca_2", "tsne_1", "tsne_2")
    planes = np.hstack([reduced[:, :2], tsne.astype(np.float64)]).tolist()
    points = [
        box | dict(zip(names, place, strict=True)) for box, place in zip(boxes, planes, strict=True)
    ]
    return [*numbers, together], points


def _nearest_means(
    features: Float[np.ndarray, "N C"],
    class_of: Int[np.ndarray, " N"],
    tile_of: np.ndarray,
    among: int,
) -> Int[np.ndarray, " N"]:
    """Returns the nearest of the first `among` class means for each box, all of other tiles."""
    from sklearn.model_selection import GroupKFold
    from sklearn.neighbors import NearestCentroid
    from sklearn.pipeline import make_pipeline
    from sklearn.preprocessing import StandardScaler

    nearest = np.full(len(features), -1)
    folds = GroupKFold(min(_FOLDS, len(set(tile_of))))
    for fitted, tested in folds.split(features, class_of, tile_of):
        kept = fitted[class_of[fitted] < among]
        model = make_pipeline(StandardScaler(), NearestCentroid())
        nearest[tested] = model.fit(features[kept], class_of[kept]).predict(features[tested])
    return nearest


def _share_by_tile(hits: Bool[np.ndarray, " N"], tile_of: np.ndarray) -> Interval:
    return _mean_by_tile(hits.astype(np.float64), tile_of, (0.0, 1.0))


def _mean_by_tile(
    values: Float[np.ndarray, " N"],
    tile_of: np.ndarray,
    limits: tuple[float, float] = (-np.inf, np.inf),
) -> Interval:
    """Returns a mean over boxes with its 95 % interval over tiles; class means are held fixed."""
    names, tile = np.unique(tile_of.astype(str), return_inverse=True)
    sums = np.zeros((1, len(names), 3))
    np.add.at(sums[0, :, 0], tile, values)
    np.add.at(sums[0, :, 1], tile, 1.0)
    weights = resample(len(names), generator=np.random.default_rng(_SEED))
    return cluster_interval(
        sums, lambda sums: share_of(sums[..., 0, 0], sums[..., 0, 1]), weights, limits=limits
    )


def _blocks(
    run: Reproduction, rows: Sequence[Mapping[str, Any]], points: Sequence[Mapping[str, Any]]
) -> list[Block]:
    known = {row["detector"] for row in rows}
    silent = [detector_name(each) for each in run.detectors if each not in known]
    return [
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
        f"Of {', '.join(silent)} no features are stored: not every detector shows its own."
        if silent
        else "",
    ]


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


@figure_style("embeddings")
def _figure(
    points: Sequence[Mapping[str, Any]], numbers: Sequence[Mapping[str, Any]]
) -> dict[str, bytes]:
    """Draws one line of two pictures per camouflage and detector."""
    shares = [row["pca_share"] for row in numbers if row["shown"] == EVERY]
    lines = defaultdict(list)
    for row in points:
        lines[row["camouflage"], row["detector"]].append(row)
    several = len({camouflage for camouflage, _ in lines}) > 1
    figure, grid = panels(len(lines), 2, 10.5, 0.7 + 4.3 * len(lines))
    for pair, share, (place, rows) in zip(grid, shares, lines.items(), strict=True):
        camouflage, detector = place
        titles = {"pca": f"PCA ({share:.0f} % of the variance)", "tsne": "t-SNE"}
        for axes, (name, title) in zip(pair, titles.items(), strict=True):
            _scatter(axes, rows, name)
            told = f"{detector_name(detector)}, {title}"
            axes.set_title(f"{camouflage}: {told}" if several else told)
    handles = []
    for shown in dict.fromkeys(row["shown"] for row in points):
        colour, marker = _marker(shown)
        drawn: dict[str, Any] = {"marker": marker, "linestyle": "", "markersize": 7}
        handles.append(Line2D([], [], color=colour, label=shown_name(shown), **drawn))
    figure.legend(handles=handles, loc="outside lower center", ncols=3, fontsize=11)
    return as_files(figure)


def _scatter(axes: Any, rows: Sequence[Any], name: str) -> None:
    """Draws all points in a fixed random order, so that no class lies on top of the others."""
    order = np.random.default_rng(0).permutation(len(rows))
    places = np.array([[row[f"{name}_1"], row[f"{name}_2"]] for row in rows])
    edge = {"markeredgecolor": "white", "markeredgewidth": 0.3}
    for start in range(0, len(order), 40):
        part = order[start : start + 40]
        for shown in dict.fromkeys(rows[index]["shown"] for index in part):
            own = places[[index for index in part if rows[index]["shown"] == shown]]
            colour, marker = _marker(shown)
            axes.plot(*own.T, marker, color=colour, markersize=4.5, alpha=0.75, **edge)
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
