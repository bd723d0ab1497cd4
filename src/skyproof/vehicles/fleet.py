"""Keeps many vehicles on one template, drawn or wrapped, and hands them out in batches."""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, field
from functools import cached_property
from pathlib import Path

import torch
from jaxtyping import Float, UInt8
from torch import Tensor

from skyproof.errors import ConfigurationError, StoredFileError
from skyproof.files import finished_folder, read_json, write_json
from skyproof.storage import read_tensors, write_tensors
from skyproof.vehicles.bodies import BODY_RANGES, sample_dimensions
from skyproof.vehicles.painting import paint_vehicle
from skyproof.vehicles.surface import build_body
from skyproof.vehicles.template import make_template
from skyproof.vehicles.vehicle import Template, VehicleBatch

__all__ = ["Fleet", "FleetSettings", "mix_fleets", "sample_fleet"]

_FORMAT_VERSION = 1


def _default_weights() -> dict[str, float]:
    # Our choice, no statistic: mostly passenger cars, one pickup or van in seven.
    return {
        "saloon": 0.18,
        "hatchback": 0.28,
        "estate": 0.14,
        "suv": 0.26,
        "pickup": 0.04,
        "van": 0.10,
    }


@dataclass(frozen=True)
class FleetSettings:
    """What a fleet consists of.

    Attributes:
        count: number of vehicles.
        weights: relative frequency of each body type; a type left out does not occur.
        first_number: number of the first vehicle, so that two fleets can have different ids.
    """

    count: int = 60
    weights: dict[str, float] = field(default_factory=_default_weights)
    first_number: int = 0

    def __post_init__(self) -> None:
        if self.count < 1:
            raise ConfigurationError(f"A fleet needs at least 1 vehicle, not {self.count}.")
        unknown = sorted(set(self.weights) - set(BODY_RANGES))
        if unknown:
            raise ConfigurationError(
                f"Unknown body types {unknown}; choose from {', '.join(sorted(BODY_RANGES))}."
            )
        if not self.weights or min(self.weights.values()) < 0 or sum(self.weights.values()) <= 0:
            raise ConfigurationError(
                "Body type weights must not be negative, and at least one must be above 0."
            )


@dataclass(frozen=True)
class Fleet:
    """Vehicles by id.

    Attributes:
        settings: what it was drawn from; None if some of it was wrapped or mixed.
        template: the shared mesh.
        ids: "<body type>-<number>", e.g. "saloon-0017": the body type is what stands before the
            last hyphen.
        vertices: `[N, V, 3]` metres, vehicle axes.
        textures: `[N, 3, 512, 512]` sRGB as bytes.
        parts: `[N, 512, 512]` values of `Part`.
        sources: for each wrapped vehicle its mesh file and licence; drawn ones have none.
    """

    settings: FleetSettings | None
    template: Template
    ids: tuple[str, ...]
    vertices: Float[Tensor, "N V 3"]
    textures: UInt8[Tensor, "N 3 512 512"]
    parts: UInt8[Tensor, "N 512 512"]
    sources: dict[str, dict[str, str]] = field(default_factory=dict)

    def __len__(self) -> int:
        return len(self.ids)

    def batch(self, ids: Sequence[str]) -> VehicleBatch:
        """Returns the named vehicles in the order given; an id may occur more than once.

        Raises:
            ConfigurationError: an id that is not in this fleet.
        """
        rows = torch.tensor([self._row(vehicle_id) for vehicle_id in ids], dtype=torch.int64)
        # Whole maps are copied, for which `index_select` is several times faster than indexing.
        vertices, textures, parts = (
            values.index_select(0, rows) for values in (self.vertices, self.textures, self.parts)
        )
        return VehicleBatch(self.template, vertices, textures, parts, tuple(ids))

    def size_m(self, vehicle_id: str) -> tuple[float, float, float]:
        """Returns length, width (without mirrors) and height in metres."""
        vertices = self.vertices[self._row(vehicle_id)]
        length, width, height = (vertices.amax(0) - vertices.amin(0)).tolist()
        return length, width, height

    @cached_property
    def sizes_m(self) -> dict[str, tuple[float, float, float]]:
        """Returns `size_m` of every vehicle by id, as sampling scenes needs them."""
        return {name: self.size_m(name) for name in self.ids}

    def save(self, folder: Path) -> None:
        """Writes `fleet.json` and `fleet.safetensors` into a new folder, whole or not at all.

        Raises:
            RunFolderError: the folder exists already, or the disk cannot take it.
        """
        with finished_folder(Path(folder)) as partial:
            self.write_into(partial)

    def write_into(self, folder: Path) -> None:
        """Writes the same two files into a folder that is being made."""
        tensors = {"vertices": self.vertices, "textures": self.textures, "parts": self.parts}
        write_tensors(folder / "fleet.safetensors", tensors)
        description = {
            "format": _FORMAT_VERSION,
            "ids": list(self.ids),
            "settings": self.settings and asdict(self.settings),
            "sources": self.sources,
        }
        write_json(folder / "fleet.json", description)

    @staticmethod
    def load(folder: Path) -> Fleet:
        """Reads what `save` wrote.

        Raises:
            StoredFileError: the folder is missing, damaged or of another format version.
        """
        folder = Path(folder)
        description = read_json(folder / "fleet.json")
        version = description.get("format") if isinstance(description, dict) else None
        if version != _FORMAT_VERSION:
            raise StoredFileError(
                f"{folder} holds fleet format {json.dumps(version)}, this version reads "
                f"{_FORMAT_VERSION}; make the fleet again."
            )
        tensors, _ = read_tensors(folder / "fleet.safetensors", "make the fleet again")
        try:
            ids = tuple(str(vehicle_id) for vehicle_id in description["ids"])
            drawn_from = description["settings"]
            fleet = Fleet(
                None if drawn_from is None else FleetSettings(**drawn_from),
                make_template(),
                ids,
                tensors["vertices"],
                tensors["textures"],
                tensors["parts"],
                # Fleets written before vehicles could be wrapped have none.
                dict(description.get("sources", {})),
            )
            fleet._check_shapes()
        except Exception as error:  # whatever a damaged file provokes means damage
            raise StoredFileError(
                f"{folder} holds a damaged fleet ({error}); make the fleet again."
            ) from error
        return fleet

    def _row(self, vehicle_id: str) -> int:
        try:
            return self.ids.index(vehicle_id)
        except ValueError:
            raise ConfigurationError(
                f"No vehicle {vehicle_id!r} in this fleet of {len(self)} ({self.ids[0]} ... "
                f"{self.ids[-1]})."
            ) from None

    def _check_shapes(self) -> None:
        count = len(self.ids)
        wanted = {
            "vertices": ((count, len(self.template.mirror), 3), torch.float32),
            "textures": ((count, 3, 512, 512), torch.uint8),
            "parts": ((count, 512, 512), torch.uint8),
        }
        for name, (shape, dtype) in wanted.items():
            tensor = getattr(self, name)
            if tuple(tensor.shape) != shape or tensor.dtype != dtype:
                raise ValueError(
                    f"{name} is {tensor.dtype} {tuple(tensor.shape)}, expected {dtype} {shape}"
                )


def sample_fleet(
    settings: FleetSettings,
    *,
    generator: torch.Generator,
    progress: Callable[[int, int], None] | None = None,
) -> Fleet:
    """Draws a fleet: body types by weight, then dimensions, paint and trim of each vehicle.

    Args:
        settings: how many, and of which types.
        generator: CPU generator; the same state gives the same fleet, byte for byte.
        progress: called with (vehicles done, vehicles in all).
    """
    types = list(settings.weights)
    weights = torch.tensor([settings.weights[name] for name in types], dtype=torch.float64)
    chosen = torch.multinomial(
        weights, settings.count, replacement=True, generator=generator
    ).tolist()
    ids, vertices, textures, parts = [], [], [], []
    for number, choice in enumerate(chosen, start=settings.first_number):
        body = build_body(sample_dimensions(types[choice], generator=generator))
        texture, labels = paint_vehicle(body, types[choice], generator=generator)
        ids.append(f"{types[choice]}-{number:04d}")
        vertices.append(body.vertices)
        textures.append(texture)
        parts.append(labels)
        if progress is not None:
            progress(len(ids), settings.count)
    return Fleet(
        settings,
        make_template(),
        tuple(ids),
        torch.stack(vertices),
        torch.stack(textures),
        torch.stack(parts),
    )


def mix_fleets(fleets: Sequence[Fleet]) -> Fleet:
    """Returns all vehicles of several fleets as one, in the order given.

    Raises:
        ConfigurationError: no fleet, or an id in two of them.
    """
    if not fleets:
        raise ConfigurationError("Mixing needs at least one fleet; give fleet folders.")
    ids = tuple(name for fleet in fleets for name in fleet.ids)
    twice = [name for name, count in Counter(ids).items() if count > 1]
    if twice:
        raise ConfigurationError(
            f"{len(twice)} vehicle ids occur more than once, the first is {twice[0]}; make one of "
            "the fleets with another first number."
        )
    return Fleet(
        None,
        fleets[0].template,
        ids,
        torch.cat([fleet.vertices for fleet in fleets]),
        torch.cat([fleet.textures for fleet in fleets]),
        torch.cat([fleet.parts for fleet in fleets]),
        {name: source for fleet in fleets for name, source in fleet.sources.items()},
    )
