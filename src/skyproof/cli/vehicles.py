"""`skyproof vehicles`: real meshes as vehicles of a fleet, and fleets mixed."""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import torch
import tyro
from PIL import Image

from skyproof.cli.console import progress_bar, say
from skyproof.errors import ConfigurationError
from skyproof.files import finished_folder, refuse_existing, write_json
from skyproof.render.turntable import turntable_row, turntable_sheet
from skyproof.vehicles.fleet import Fleet, mix_fleets
from skyproof.vehicles.template import make_template
from skyproof.vehicles.wrapping.wrap import WrappedVehicle, wrap_mesh

__all__ = ["Mix", "Wrap"]

Axis = Literal["x", "y", "z", "-x", "-y", "-z"]

_COLUMNS = {
    "iou_above": "IoU above",
    "iou_side": "IoU side",
    "hausdorff_m": "Hausdorff (m)",
    "median_m": "median (m)",
    "p95_m": "p95 (m)",
    "crossings": "crossings",
}


@dataclass(frozen=True)
class Wrap:
    """Wraps real meshes onto the shared template, with their colours and part labels: OBJ, GLB or DAE in, a fleet out.

    Attributes:
        meshes: mesh files.
        out: fleet folder to write: fleet.json, fleet.safetensors, wrap.json (how well each fits) and turntable.png.
        scale: metres per unit of the file, one for all or one per mesh; none takes what the file says, else 1.
        up: which axis is up; none takes the format's, or guesses.
        forward: where the nose points; none guesses and says how.
        names: body type of each mesh; none takes the file's name. Ids are <body type>-<number>.
        first_number: number of the first vehicle.
        paintable: picture on the mesh's own UVs, bright where there is paint; none takes the textures' alpha, if any.
        licence: whose the meshes are and under which terms; stored with every vehicle.
        minimum_iou: refuse a vehicle whose outline from above fits worse.
    """

    meshes: tyro.conf.Positional[tuple[Path, ...]]
    out: Path
    scale: tuple[float, ...] = ()
    up: Axis | None = None
    forward: Axis | None = None
    names: tuple[str, ...] = ()
    first_number: int = 1000
    paintable: Path | None = None
    licence: str = "not stated"
    minimum_iou: float = 0.97

    def __post_init__(self) -> None:
        for flag, given, single in (("--scale", self.scale, True), ("--names", self.names, False)):
            if given and len(given) != len(self.meshes) and not (single and len(given) == 1):
                raise ConfigurationError(
                    f"{flag} expects one value per mesh ({len(self.meshes)}), got {len(given)}."
                )
        if any(not 0 < scale < float("inf") for scale in self.scale):
            raise ConfigurationError(
                f"--scale expects metres per unit above 0, got {min(self.scale)}."
            )
        if not self.meshes:
            raise ConfigurationError("No mesh was given; name OBJ, GLB or DAE files.")

    def run(self) -> None:
        """Wraps, measures and writes all of them, or nothing."""
        refuse_existing(self.out)
        scales: tuple[float | None, ...] = self.scale or (None,)
        if len(scales) == 1:
            scales = scales * len(self.meshes)
        names = self.names or tuple(path.stem for path in self.meshes)
        reports: dict[str, dict[str, Any]] = {}
        wrapped: list[WrappedVehicle] = []
        with progress_bar("vehicles") as update:
            for path, name, scale in zip(self.meshes, names, scales, strict=True):
                vehicle = wrap_mesh(
                    path, scale=scale, up=self.up, forward=self.forward, paintable=self.paintable
                )
                vehicle_id = f"{_body_type(name)}-{self.first_number + len(wrapped):04d}"
                reports[vehicle_id] = {**vehicle.report, "licence": self.licence}
                wrapped.append(vehicle)
                update(len(wrapped), len(self.meshes))
        _print_reports(reports)
        for vehicle_id, report in reports.items():
            if report["iou_above"] < self.minimum_iou:
                raise ConfigurationError(
                    f"{vehicle_id} ({report['mesh']}) keeps its outline from above only to IoU "
                    f"{report['iou_above']:.3f}, asked is {self.minimum_iou}; check --up and "
                    "--forward, or lower --minimum-iou."
                )
        fleet = Fleet(
            None,
            make_template(),
            tuple(reports),
            torch.stack([vehicle.vertices for vehicle in wrapped]),
            torch.stack([vehicle.texture for vehicle in wrapped]),
            torch.stack([vehicle.parts for vehicle in wrapped]),
            {
                name: {"mesh": report["mesh"], "licence": self.licence}
                for name, report in reports.items()
            },
        )
        with finished_folder(self.out) as folder:
            fleet.write_into(folder)
            write_json(folder / "wrap.json", reports)
            rows = [
                turntable_row(vehicle.mesh, fleet.batch([name]), _caption(name, reports[name]))
                for name, vehicle in zip(reports, wrapped, strict=True)
            ]
            Image.fromarray(turntable_sheet(rows).permute(1, 2, 0).numpy()).save(
                folder / "turntable.png"
            )
        say(f"Fleet of {len(fleet)}: {self.out.resolve()} (look at turntable.png)")


@dataclass(frozen=True)
class Mix:
    """Puts the vehicles of several fleets, drawn or wrapped, into one.

    Attributes:
        fleets: fleet folders; no id may occur twice.
        out: fleet folder to write.
    """

    fleets: tyro.conf.Positional[tuple[Path, ...]]
    out: Path

    def run(self) -> None:
        """Mixes and writes."""
        refuse_existing(self.out)
        fleet = mix_fleets([Fleet.load(folder) for folder in self.fleets])
        fleet.save(self.out)
        say(f"Fleet of {len(fleet)}: {self.out.resolve()}")


def _body_type(name: str) -> str:
    """A name that can stand in an id and in a file name."""
    return re.sub(r"[^a-z0-9]+", "-", name.lower()).strip("-") or "vehicle"


def _caption(name: str, report: dict[str, Any]) -> str:
    size = " x ".join(f"{value:.2f}" for value in report["size_m"])
    return f"{name}   {size} m   IoU from above {report['iou_above']:.3f}   {report['mesh']}"


def _print_reports(reports: dict[str, dict[str, Any]]) -> None:
    width = max(len(name) for name in reports)
    say(
        f"{'':{width}}  {'length x width x height':>23}"
        + "".join(f"{title:>15}" for title in _COLUMNS.values())
    )
    for name, report in reports.items():
        size = " x ".join(f"{value:.2f}" for value in report["size_m"]) + " m"
        numbers = (f"{report[key]:.3f}".removesuffix(".000") for key in _COLUMNS)
        say(f"{name:{width}}  {size:>23}" + "".join(f"{number:>15}" for number in numbers))
    for name, report in reports.items():
        say(
            f"{name}: up {report['up']}, nose {report['forward']} ({report['nose']}), {report['scale']:g} m per unit."
        )
        for note in report["notes"]:
            say(f"{name}: {note.rstrip('.')}.")
