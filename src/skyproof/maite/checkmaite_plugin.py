"""Camouflages as a capability of checkmaite, which only this file imports, by an entry point."""

from collections.abc import Iterator
from typing import Any

import maite.protocols.object_detection as od
from checkmaite.core.capability_core import (
    Capability,
    CapabilityConfigBase,
    CapabilityOutputsBase,
    CapabilityRunBase,
    Number,
)
from checkmaite.core.report import InlineTextReport
from pydantic import Field

from skyproof.maite.datasets import batches
from skyproof.maite.metric import HiddenVehicles
from skyproof.ranges import Match

_Row = dict[str, float | int | None]


class SkyproofCamouflageConfig(CapabilityConfigBase):
    """How vehicles count as found."""

    threshold: float | None = Field(
        default=None,
        ge=0,
        le=1,
        description="Score from which on a detection counts; what the model's metadata say where "
        "it is unset.",
    )
    labels: tuple[int, ...] = Field(
        default=(0,), description="The model's classes that are vehicles."
    )
    match: Match = Field(
        default="centre_1m", description="How a detection and a vehicle are paired."
    )
    batch_size: int = Field(default=8, ge=1, description="Images that the model is shown at once.")


class SkyproofCamouflageOutputs(CapabilityOutputsBase):
    """The result of `HiddenVehicles.compute` for each camouflaged dataset, by its id."""

    hidden: dict[str, _Row]


class SkyproofCamouflageRun(CapabilityRunBase[SkyproofCamouflageConfig, SkyproofCamouflageOutputs]):
    """The results of one run."""

    config: SkyproofCamouflageConfig
    outputs: SkyproofCamouflageOutputs

    def collect_md_report(self, threshold: float) -> InlineTextReport:
        """Writes a table of hidden vehicles; `threshold` is the least share still to be found."""
        about = (
            "# Camouflage\n\nShare of the vehicles found before that the model "
            f"{self.model_metadata[0]['id']} finds no more (ASR), and the same less those found "
            "only since (EASR), with their 95 % intervals over places and vehicles. The limit is "
            f"met where the whole interval of ASR leaves at least {threshold:.0%} found.\n\n"
        )
        interval = "95 % interval"
        headers = ("Dataset", "ASR", interval, "EASR", interval, "Found before", "Limit")
        rows = [
            (name, *_rates(row), row["found_before"], _met(row, threshold))
            for name, row in self.outputs.hidden.items()
        ]
        lines = [headers, ("--",) * len(headers), *rows]
        table = "\n".join("| " + " | ".join(map(_cell, line)) + " |" for line in lines)
        return InlineTextReport(
            media_type="text/markdown",
            content=f"{about}{table}\n",
            filename="skyproof_camouflage.md",
        )


class SkyproofCamouflage(
    Capability[SkyproofCamouflageOutputs, od.Dataset, od.Model, od.Metric, SkyproofCamouflageConfig]
):
    """Measures the vehicles that camouflages hide from a model, in matched pairs.

    It takes one model and datasets of the same images: the first without camouflage, each of the
    others with one, as `skyproof render --camouflage` writes them and `VehicleDataset` opens them.
    """

    _RUN_TYPE = SkyproofCamouflageRun

    @classmethod
    def _create_config(cls) -> SkyproofCamouflageConfig:
        return SkyproofCamouflageConfig()

    @property
    def supports_datasets(self) -> Number:
        """One without camouflage, and at least one with it."""
        return Number.MANY

    @property
    def supports_models(self) -> Number:
        """One."""
        return Number.ONE

    @property
    def supports_metrics(self) -> Number:
        """None: it brings its own."""
        return Number.ZERO

    def _run(
        self,
        models: list[od.Model],
        datasets: list[od.Dataset],
        metrics: list[od.Metric],
        config: SkyproofCamouflageConfig,
        use_prediction_and_evaluation_cache: bool,
    ) -> SkyproofCamouflageOutputs:
        (model,) = models
        original, *camouflaged = datasets
        if not camouflaged:
            raise TypeError(
                "SkyproofCamouflage compares images without and with a camouflage, got one dataset "
                "alone; give the camouflaged ones after it."
            )
        metric = HiddenVehicles(
            model,
            original,
            threshold=config.threshold,
            labels=config.labels,
            match=config.match,
            batch_size=config.batch_size,
        )
        hidden: dict[str, dict[str, Any]] = {}
        for dataset in camouflaged:
            metric.reset()
            for images, targets, metadata in batches(dataset, config.batch_size):
                metric.update(model(images), targets, metadata)
            hidden[dataset.metadata["id"]] = metric.compute()
        return SkyproofCamouflageOutputs(hidden=hidden)


def exports() -> dict[str, Any]:
    """Returns the additions to checkmaite's own capabilities."""
    return {
        "__plugin_api_version__": "1.0.0",
        "SkyproofCamouflage": SkyproofCamouflage,
        "SkyproofCamouflageConfig": SkyproofCamouflageConfig,
        "SkyproofCamouflageOutputs": SkyproofCamouflageOutputs,
    }


def _cell(value: object) -> str:
    return str(value).replace("|", "\\|").replace("\n", " ")


def _percent(value: float | None) -> str:
    return "not known" if value is None else f"{100 * value:.0f} %"


def _rates(row: _Row) -> Iterator[str]:
    """Yields ASR and EASR, each with its interval."""
    for key in ("asr", "easr"):
        yield _percent(row[key])
        yield f"{_percent(row[f'{key}_low'])} to {_percent(row[f'{key}_high'])}"


def _met(row: _Row, threshold: float) -> str:
    low, high = row["asr_low"], row["asr_high"]
    if low is None or high is None:
        return "not known"
    if 1 - high >= threshold:
        return "met"
    return "missed" if 1 - low < threshold else "open"
