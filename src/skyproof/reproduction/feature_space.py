"""Classes of boxes among a detector's features: how far apart they are, and pictures of them."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int

from skyproof.results.statistics.intervals import Interval, cluster_interval, resample

_FOLDS = 5
_SEED = 0
_PERPLEXITY = 30.0
# t-SNE's neighbours hardly change beyond, and it is several times as fast (its authors' advice).
_COMPONENTS = 50


@dataclass(frozen=True)
class Shown:
    """One class of what is shown, in numbers; silhouette and classes are of all features.

    Attributes:
        boxes: how many.
        silhouette: mean silhouette of its boxes among all classes, from -1 (they lie among others)
            to 1 (they lie close together and far from all others).
        nearest_own: share of its boxes whose nearest class mean is its own.
        nearer_ground: share of its boxes that are nearer to the mean of the ground than to that of
            original vehicles.
        along: where its mean lies on the way from the mean of original vehicles (0) to that of the
            ground (1); None for these two.
        aside: how far its mean lies off that way, in lengths of the way; None for these two.
    """

    boxes: int
    silhouette: float
    nearest_own: Interval
    nearer_ground: Interval
    along: Interval | None
    aside: float | None


@dataclass(frozen=True)
class Embedding:
    """One detector's features of several classes, in numbers and in two dimensions.

    Attributes:
        classes: the classes' names.
        class_of: per box the index of its class.
        shown: per class its numbers.
        silhouette: mean over the classes.
        nearest_own: mean over the classes of the share of boxes whose nearest mean is their own.
        pca: `[N, 2]` the first two principal components.
        pca_share: what share of the variance these two have.
        tsne: `[N, 2]` t-SNE's plane.
    """

    classes: Sequence[str]
    class_of: Int[np.ndarray, " N"]
    shown: Sequence[Shown]
    silhouette: float
    nearest_own: float
    pca: Float[np.ndarray, "N 2"]
    pca_share: float
    tsne: Float[np.ndarray, "N 2"]


def embed(
    vectors: Mapping[str, Float[np.ndarray, "_ C"]], tiles: Mapping[str, Sequence[str]]
) -> Embedding:
    """Measures and draws the features of several classes, ground and original vehicles first.

    Every feature is scaled to variance 1. Class means are those of other tiles: boxes are held out
    tile by tile in five parts, so that neighbours on one tile, and one vehicle with two
    camouflages, are never on both sides.

    Args:
        vectors: by class one vector per box; "ground" and "original" first.
        tiles: by class the background tile of each box; two or more in all.
    """
    from sklearn.decomposition import PCA
    from sklearn.manifold import TSNE
    from sklearn.metrics import silhouette_samples
    from sklearn.preprocessing import StandardScaler

    classes = list(vectors)
    class_of = np.repeat(np.arange(len(classes)), [len(own) for own in vectors.values()])
    features = np.concatenate(list(vectors.values()))
    tile_of = np.concatenate([np.asarray(tiles[name], dtype=object) for name in classes])
    scaled = StandardScaler().fit_transform(features)

    # Numbers, in all dimensions.
    silhouettes = silhouette_samples(scaled, class_of)
    nearest = _nearest_means(features, class_of, tile_of)
    ends = _nearest_means(features, class_of, tile_of, among=2)
    means = np.stack([scaled[class_of == number].mean(axis=0) for number in range(len(classes))])
    way = means[0] - means[1]
    length = float(way @ way)
    along = (scaled - means[1]) @ way / length
    shown = []
    for index in range(len(classes)):
        own = class_of == index
        # The two ends of the way are where they are by definition.
        place = _mean_by_tile(along[own], tile_of[own]) if index > 1 else None
        off = means[index] - means[1] - along[own].mean() * way
        shown.append(
            Shown(
                boxes=int(own.sum()),
                silhouette=float(silhouettes[own].mean()),
                nearest_own=_share_by_tile(nearest[own] == index, tile_of[own]),
                nearer_ground=_share_by_tile(ends[own] == 0, tile_of[own]),
                along=place,
                aside=None if place is None else float(np.linalg.norm(off)) / length**0.5,
            )
        )

    # Pictures, in two.
    components = PCA(min(_COMPONENTS, *scaled.shape), random_state=_SEED).fit(scaled)
    reduced = components.transform(scaled)
    perplexity = min(_PERPLEXITY, (len(scaled) - 1) / 3)
    plane = TSNE(init="pca", perplexity=perplexity, random_state=_SEED).fit_transform(reduced)
    return Embedding(
        classes=classes,
        class_of=class_of,
        shown=shown,
        silhouette=float(np.mean([each.silhouette for each in shown])),
        nearest_own=float(np.mean([each.nearest_own.estimate for each in shown])),
        pca=reduced[:, :2],
        pca_share=float(components.explained_variance_ratio_[:2].sum()),
        tsne=np.asarray(plane, dtype=np.float64),
    )


def _nearest_means(
    features: Float[np.ndarray, "N C"],
    class_of: Int[np.ndarray, " N"],
    tile_of: np.ndarray,
    *,
    among: int | None = None,
) -> Int[np.ndarray, " N"]:
    """Gives each box's nearest class mean, means and scale being those of other tiles.

    Args:
        features: as they are.
        class_of: the boxes' own classes.
        tile_of: their tiles.
        among: only the first so many classes have a mean; all where None.
    """
    from sklearn.model_selection import GroupKFold
    from sklearn.neighbors import NearestCentroid
    from sklearn.pipeline import make_pipeline
    from sklearn.preprocessing import StandardScaler

    nearest = np.full(len(features), -1)
    folds = GroupKFold(min(_FOLDS, len(set(tile_of))))
    for learnt, judged in folds.split(features, class_of, tile_of):
        kept = learnt if among is None else learnt[class_of[learnt] < among]
        model = make_pipeline(StandardScaler(), NearestCentroid())
        nearest[judged] = model.fit(features[kept], class_of[kept]).predict(features[judged])
    return nearest


def _share_by_tile(hits: Bool[np.ndarray, " N"], tile_of: np.ndarray) -> Interval:
    return _mean_by_tile(hits.astype(np.float64), tile_of, limits=(0.0, 1.0))


def _mean_by_tile(
    values: Float[np.ndarray, " N"],
    tile_of: np.ndarray,
    *,
    limits: tuple[float, float] = (-np.inf, np.inf),
) -> Interval:
    """Gives a mean over boxes with its 95 % interval over tiles, class means being as they are."""
    names, tile = np.unique(tile_of.astype(str), return_inverse=True)
    sums = np.zeros((1, len(names), 3))
    np.add.at(sums[0, :, 0], tile, values)
    np.add.at(sums[0, :, 1], tile, 1.0)
    weights = resample(len(names), generator=np.random.default_rng(_SEED))
    return cluster_interval(sums, _mean, weights, limits=limits)


def _mean(sums: Float[np.ndarray, "*shape 1 3"]) -> Float[np.ndarray, "*shape"]:
    total = sums[..., 0, 0]
    count = sums[..., 0, 1]
    return np.divide(total, count, out=np.full_like(total, np.nan), where=count > 0)
