"""`skyproof vehicles`: fleets, drawn by rules or made of meshes and of other fleets."""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from tyro.conf import Positional, Suppress

from skyproof.console import progress_bar, say
from skyproof.errors import ConfigurationError
from skyproof.files import finished_folder, refuse_existing, write_json
from skyproof.ranges import Fraction, Seed, WholeNumber
from skyproof.scenes.splits import SPLITS
from skyproof.vehicles.settings import CATALOGUE_PAINTS, PaintVariety, VehicleCount, WrapSettings

if TYPE_CHECKING:
    from skyproof.vehicles.fleet import Fleet, FleetSettings
    from skyproof.vehicles.wrapping.wrap import WrappedVehicle

FleetCounts = tuple[VehicleCount, VehicleCount, VehicleCount, VehicleCount]
"""Vehicles of train, validation, attack and test."""

_COLUMNS = {
    "iou_above": "IoU above",
    "iou_side": "IoU side",
    "hausdorff_m": "Hausdorff (m)",
    "median_m": "median (m)",
    "p95_m": "p95 (m)",
    "crossings": "crossings",
}


@dataclass(frozen=True)
class Vehicles:
    """Draws four fleets, one per split, or makes one fleet of meshes and of other fleets.

    Meshes are wrapped onto the shared template with their colours and part labels. wrap.json tells
    how well each fits, and turntable.png shows them.

    Attributes:
        sources: mesh files (OBJ, GLB) to wrap and fleet folders to mix; fleets are drawn without
            any.
        out: folder to write: one fleet, or the fleets train, validation, attack and test.
        counts: number of drawn vehicles per split (train, validation, attack, test).
        seed: seed of drawn vehicles.
        paints: paints of the fleets train and validation; attack and test have catalogue paints.
        shapes: share of the fleets train and validation with a random shape (R-S-O).
        wrapping: how meshes are read.
        first_number: number of the first drawn vehicle, so that fleets can be mixed.
    """

    out: Path
    sources: Positional[tuple[Path, ...]] = ()
    counts: FleetCounts = (128, 32, 32, 32)
    seed: Seed = 0
    paints: Suppress[PaintVariety] = field(default_factory=PaintVariety)
    shapes: Suppress[Fraction] = 0.25
    wrapping: WrapSettings = field(default_factory=WrapSettings)
    first_number: Suppress[WholeNumber] = 0

    def run(self) -> None:
        """Writes all fleets, or nothing."""
        refuse_existing(self.out)
        if self.sources:
            self._combine()
        else:
            self._draw()

    def _draw(self) -> None:
        from skyproof.vehicles.fleet import FleetSettings, sample_fleet

        settings = FleetSettings(
            first_number=self.first_number, paints=self.paints, shapes=self.shapes
        )
        draw_fleets(self.out, self.counts, settings, self.seed, sample_fleet)
        if not any(self.paints.shares.values()):
            say(
                "  note: train and validation have catalogue paints only, so a detector trained "
                "on them may take colour for evidence; see skyproof precheck."
            )

    def _combine(self) -> None:
        from skyproof.vehicles.fleet import Fleet, mix_fleets

        fleets = [Fleet.load(source) for source in self.sources if source.is_dir()]
        meshes = [source for source in self.sources if not source.is_dir()]
        wrapped = self._wrap(meshes) if meshes else {}
        reports = {vehicle_id: vehicle.report for vehicle_id, vehicle in wrapped.items()}
        fleet = mix_fleets([_fleet_of(wrapped), *fleets] if wrapped else fleets)
        if wrapped:
            _say_reports(reports)
            self._refuse_bad_fits(reports)
        with finished_folder(self.out) as folder:
            fleet.write_into(folder)
            if wrapped:
                write_json(folder / "wrap.json", reports)
                _write_turntables(folder / "turntable.png", wrapped, fleet)
        advice = " (look at turntable.png)" if wrapped else ""
        say(f"Fleet of {len(fleet)}: {self.out.resolve()}{advice}")

    def _wrap(self, meshes: list[Path]) -> dict[str, WrappedVehicle]:
        from skyproof.vehicles.wrapping.wrap import wrap_mesh

        how = self.wrapping
        wrapped: dict[str, WrappedVehicle] = {}
        with progress_bar("vehicles") as update:
            for path, name, scale in how.of_meshes(meshes):
                # The name becomes a part of ids and file names.
                plain = re.sub(r"[^a-z0-9]+", "-", name.lower()).strip("-")[:100].strip("-")
                vehicle_id = f"{plain or 'vehicle'}-{how.first_number + len(wrapped):04d}"
                made = wrap_mesh(
                    path, scale=scale, up=how.up, forward=how.forward, paintable=how.paintable
                )
                wrapped[vehicle_id] = replace(made, report=made.report | {"licence": how.licence})
                update(len(wrapped), len(meshes))
        return wrapped

    def _refuse_bad_fits(self, reports: dict[str, dict[str, Any]]) -> None:
        for vehicle_id, report in reports.items():
            if report["iou_above"] < self.wrapping.minimum_iou:
                raise ConfigurationError(
                    f"{vehicle_id} ({report['mesh']}) keeps its outline from above only to IoU "
                    f"{report['iou_above']:.3f}, the least is {self.wrapping.minimum_iou}; check "
                    "--wrapping.up and --wrapping.forward."
                )


def draw_fleets(
    out: Path, counts: FleetCounts, settings: FleetSettings, seed: int, sample: Callable[..., Fleet]
) -> None:
    """Writes the four fleets, or nothing.

    Train and validation have buses and lorries, too; attack and test have catalogue paints and no
    random shapes.
    """
    from skyproof.camouflage.random_controls import wear_random_shapes
    from skyproof.randomness import generator_of
    from skyproof.vehicles.fleet import TRAINING_WEIGHTS

    with finished_folder(out) as folder:
        # Numbering continues from split to split, so that no vehicle is in two of them.
        first_number = settings.first_number
        for split, count in zip(SPLITS, counts, strict=True):
            chosen = replace(settings, count=count, first_number=first_number)
            if split in ("train", "validation"):
                chosen = replace(chosen, weights=TRAINING_WEIGHTS)
            else:
                chosen = replace(chosen, paints=CATALOGUE_PAINTS, shapes=0.0)
            with progress_bar(f"vehicles {split}") as update:
                generator = generator_of(seed, "fleet", split)
                fleet = sample(chosen, generator=generator, progress=update)
            controls = generator_of(seed, "controls", split)
            wear_random_shapes(fleet, generator=controls).save(folder / split)
            first_number += count
    say(f"Fleets of {', '.join(map(str, counts))} vehicles: {out.resolve()}")


def _fleet_of(wrapped: dict[str, WrappedVehicle]) -> Fleet:
    from skyproof.vehicles.fleet import Fleet

    vehicles = {name: (each.vertices, each.texture, each.parts) for name, each in wrapped.items()}
    told = ("mesh", "licence")
    sources = {name: {key: each.report[key] for key in told} for name, each in wrapped.items()}
    return Fleet.of(vehicles, sources)


def _write_turntables(path: Path, wrapped: dict[str, WrappedVehicle], fleet: Fleet) -> None:
    import numpy as np
    from PIL import Image

    from skyproof.render.portrait import turntable_row

    rows = []
    for vehicle_id, vehicle in wrapped.items():
        fit = f"IoU from above {vehicle.report['iou_above']:.3f}"
        caption = f"{vehicle_id}   {_size(vehicle.report)}   {fit}   {vehicle.report['mesh']}"
        rows.append(turntable_row(vehicle.mesh, fleet.batch([vehicle_id]), caption))
    Image.fromarray(np.concatenate(rows)).save(path)


def _size(report: dict[str, Any]) -> str:
    return " x ".join(f"{value:.2f}" for value in report["size_m"]) + " m"


def _say_reports(reports: dict[str, dict[str, Any]]) -> None:
    width = max(len(vehicle_id) for vehicle_id in reports)
    titles = "".join(f"{title:>15}" for title in _COLUMNS.values())
    say(f"{'':{width}}  {'length x width x height':>23}{titles}")
    for vehicle_id, report in reports.items():
        numbers = (f"{report[key]:.3f}".removesuffix(".000") for key in _COLUMNS)
        columns = "".join(f"{number:>15}" for number in numbers)
        say(f"{vehicle_id:{width}}  {_size(report):>23}{columns}")
    for vehicle_id, report in reports.items():
        say(
            f"{vehicle_id}: up {report['up']}, nose {report['forward']} ({report['nose']}), "
            f"{report['scale']:g} m per unit."
        )
        for note in report["notes"]:
            say(f"{vehicle_id}: {note.rstrip('.')}.")
