"""A fleet holds many vehicles on one template, drawn or wrapped, and returns them in batches."""

from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Annotated, cast

import torch
from jaxtyping import Float, UInt8
from msgspec import Meta
from torch import Tensor

from skyproof.documents import read_document
from skyproof.errors import ConfigurationError, StoredFileError
from skyproof.files import finished_folder, write_json
from skyproof.ranges import Fraction, Name, WholeNumber, check_ranges
from skyproof.storage import read_tensors, write_tensors
from skyproof.vehicles.bodies import BODY_RANGES, build_body, sample_dimensions
from skyproof.vehicles.painting import paint_vehicle
from skyproof.vehicles.paints import Coat
from skyproof.vehicles.settings import CATALOGUE_PAINTS, PaintVariety, VehicleCount
from skyproof.vehicles.template import make_template
from skyproof.vehicles.vehicle import TEXTURE_SIZE, Part, Template, VehicleBatch

_FORMAT_VERSION = 1
_USUAL: Coat = "catalogue"
_REMEDY = "copy the whole folder again, or make the fleet again"
_LARGEST_M = 100.0
# Our choice, not a statistic: mostly passenger cars, one pickup or van in seven.
_CAR_WEIGHTS = {"saloon": 0.18, "hatchback": 0.28, "estate": 0.14, "suv": 0.26}
_WEIGHTS = {**_CAR_WEIGHTS, "pickup": 0.04, "van": 0.10}
TRAINING_WEIGHTS = {**_WEIGHTS, "bus": 0.02, "lorry": 0.02}
"""Body types to train with: a detector trained without buses found one of 27 in photographs."""


@dataclass(frozen=True)
class FleetSettings:
    """Settings of a fleet.

    Attributes:
        count: number of vehicles.
        weights: relative frequency of each body type; 0 if left out.
        first_number: number of the first vehicle, so that two fleets can have different ids.
        paints: shares with other paints than real vehicles.
        shapes: share with a random shape. `skyproof.camouflage.random_controls` applies shapes, and
            patterns in every image anew.
    """

    count: VehicleCount = 60
    weights: dict[str, Annotated[float, Meta(ge=0, le=1e6)]] = field(default_factory=_WEIGHTS.copy)
    first_number: WholeNumber = 0
    paints: PaintVariety = CATALOGUE_PAINTS
    shapes: Fraction = 0.0

    def __post_init__(self) -> None:
        check_ranges(self)
        unknown = sorted(set(self.weights) - set(BODY_RANGES))
        if unknown:
            raise ConfigurationError(
                f"Unknown body types {unknown}; choose from {', '.join(sorted(BODY_RANGES))}."
            )
        if not any(self.weights.values()):
            raise ConfigurationError("weights expects at least one body type above 0, got none.")


@dataclass(frozen=True)
class _StoredFleet:
    """The content of `fleet.json`."""

    format: int
    ids: Annotated[tuple[Name, ...], Meta(min_length=1, max_length=100_000)]
    settings: FleetSettings | None
    sources: dict[str, dict[str, Annotated[str, Meta(max_length=10_000)]]] = field(
        default_factory=dict
    )

    def __post_init__(self) -> None:
        twice = [name for name, count in Counter(self.ids).items() if count > 1]
        if twice:
            raise StoredFileError(f"the vehicle {twice[0]} is there twice.")


@dataclass(frozen=True)
class Fleet:
    """Vehicles by id.

    Attributes:
        settings: None if some vehicles were wrapped or mixed.
        ids: "<body type>-<number>", such as "saloon-0017".
        vertices: `[N, V, 3]` metres, vehicle axes.
        textures: `[N, 3, 512, 512]` sRGB as bytes.
        parts: `[N, 512, 512]` values of `Part`.
        sources: by id "mesh" and "licence" of a wrapped vehicle, "generator" of a learnt one,
            "coat" if it is no catalogue paint, "paint" if it is one of a place's, and "shape":
            "random".
    """

    settings: FleetSettings | None
    template: Template
    ids: tuple[str, ...]
    vertices: Float[Tensor, "N V 3"]
    textures: UInt8[Tensor, "N 3 512 512"]
    parts: UInt8[Tensor, "N 512 512"]
    sources: dict[str, dict[str, str]] = field(default_factory=dict)

    @classmethod
    def of(
        cls,
        vehicles: Mapping[str, tuple[Tensor, Tensor, Tensor]],
        sources: dict[str, dict[str, str]],
        settings: FleetSettings | None = None,
    ) -> "Fleet":
        """Makes a fleet of the vertices, texture and parts of each vehicle, by id."""
        vertices, textures, parts = map(torch.stack, zip(*vehicles.values(), strict=True))
        return cls(settings, make_template(), tuple(vehicles), vertices, textures, parts, sources)

    def __len__(self) -> int:
        return len(self.ids)

    def batch(self, ids: Sequence[str]) -> VehicleBatch:
        """Returns the named vehicles in the order given; an id may occur more than once.

        Raises:
            ConfigurationError: an id that is not in this fleet.
        """
        row_of = {vehicle_id: row for row, vehicle_id in enumerate(self.ids)}
        for vehicle_id in ids:
            if vehicle_id not in row_of:
                raise ConfigurationError(
                    f"No vehicle {vehicle_id!r} in a fleet of {len(self)} ({self.ids[0]} ... "
                    f"{self.ids[-1]}); give the fleet that the scenes were sampled with."
                )
        rows = torch.tensor([row_of[vehicle_id] for vehicle_id in ids], dtype=torch.int64)
        # Whole maps are copied, for which `index_select` is several times faster than indexing.
        vertices, textures, parts = (
            values.index_select(0, rows) for values in (self.vertices, self.textures, self.parts)
        )
        return VehicleBatch(self.template, vertices, textures, parts, tuple(ids))

    @cached_property
    def sizes_m(self) -> dict[str, tuple[float, float, float]]:
        """Returns length, width (without mirrors) and height in metres by id."""
        extents = (self.vertices.amax(1) - self.vertices.amin(1)).tolist()
        sizes_m = [(length, width, height) for length, width, height in extents]
        return dict(zip(self.ids, sizes_m, strict=True))

    def save(self, folder: Path) -> None:
        """Writes `fleet.json` and `fleet.safetensors` into a new folder, whole or not at all."""
        with finished_folder(Path(folder)) as partial:
            self.write_into(partial)

    def write_into(self, folder: Path) -> None:
        """Writes the two files of `save` into a folder that is being made."""
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
    def load(folder: str | Path) -> "Fleet":
        """Reads what `save` wrote.

        Raises:
            StoredFileError: the folder is missing, damaged or of another format version.
        """
        folder = Path(folder)
        stored: _StoredFleet = read_document(
            folder / "fleet.json", _StoredFleet, _REMEDY, version=_FORMAT_VERSION
        )
        path = folder / "fleet.safetensors"
        tensors, _ = read_tensors(path, _REMEDY)
        template = make_template()
        _check_tensors(path, tensors, len(stored.ids), len(template.mirror))
        maps = (tensors["vertices"], tensors["textures"], tensors["parts"])
        return Fleet(stored.settings, template, stored.ids, *maps, stored.sources)


def _check_tensors(path: Path, tensors: dict[str, Tensor], count: int, vertices: int) -> None:
    """Refuses tensors that cannot be those of `count` vehicles."""
    map_px = (TEXTURE_SIZE, TEXTURE_SIZE)
    wanted = {
        "vertices": ((count, vertices, 3), torch.float32),
        "textures": ((count, 3, *map_px), torch.uint8),
        "parts": ((count, *map_px), torch.uint8),
    }
    for name, (shape, dtype) in wanted.items():
        tensor = tensors.get(name)
        if tensor is None or tuple(tensor.shape) != shape or tensor.dtype != dtype:
            got = "none" if tensor is None else f"{tensor.dtype} {tuple(tensor.shape)}"
            raise StoredFileError(
                f"{path} expects {name} of {dtype} {shape}, as fleet.json says, got {got}; "
                f"{_REMEDY}."
            )
    if float(tensors["vertices"].abs().amax()) > _LARGEST_M:
        raise StoredFileError(
            f"{path} holds a vehicle that reaches more than {_LARGEST_M:g} m from its middle; "
            f"{_REMEDY}."
        )
    if int(tensors["parts"].amax()) > max(Part):
        raise StoredFileError(f"{path} holds part labels above {int(max(Part))}; {_REMEDY}.")


def sample_fleet(
    settings: FleetSettings,
    *,
    generator: torch.Generator,
    progress: Callable[[int, int], None] = lambda *_: None,
    worn: Float[Tensor, "P 3"] | None = None,
) -> Fleet:
    """Draws a fleet: body types by weight, then dimensions, paint and trim of each vehicle.

    The paints of vehicles at a place (`worn`, sRGB in [0, 1]) replace catalogue paints, in the same
    shares. The same state of the CPU generator gives the same fleet, byte for byte.
    """
    coats = _coats(settings, generator)
    types = list(settings.weights)
    weights = torch.tensor([settings.weights[name] for name in types], dtype=torch.float64)
    chosen = torch.multinomial(weights, settings.count, True, generator=generator).tolist()
    ids = [f"{types[choice]}-{n:04d}" for n, choice in enumerate(chosen, settings.first_number)]
    drawn: dict[str, tuple[Tensor, Tensor, Tensor]] = {}
    paints = [None] * settings.count if worn is None else _paints_of(worn, settings, generator)
    for name, choice, coat, paint in zip(ids, chosen, coats, paints, strict=True):
        body = build_body(sample_dimensions(types[choice], generator=generator))
        maps = paint_vehicle(body, types[choice], coat, paint=paint, generator=generator)
        drawn[name] = (body.vertices, *maps)
        progress(len(drawn), settings.count)
    sources: dict[str, dict[str, str]] = {
        name: {"coat": coat} for name, coat in zip(ids, coats, strict=True) if coat != _USUAL
    }
    for name, coat, paint in zip(ids, coats, paints, strict=True):
        # Every other coat replaces or covers the paint.
        if paint is not None and coat == _USUAL:
            sources[name] = {"paint": "of a labelled vehicle"}
    for index in exact_share(settings.shapes, settings.count, generator):
        sources.setdefault(ids[index], {})["shape"] = "random"
    return Fleet.of(drawn, sources, settings)


def _paints_of(
    worn: Float[Tensor, "P 3"], settings: FleetSettings, generator: torch.Generator
) -> list[Tensor]:
    """Draws paints evenly from dark to light, so that a small fleet has all, in random order."""
    ranked = worn[worn.sum(1).argsort(stable=True)]
    at = torch.arange(settings.count) + torch.rand(settings.count, generator=generator)
    drawn = ranked[(at / settings.count * len(ranked)).long().clamp(max=len(ranked) - 1)]
    return [*drawn[torch.randperm(settings.count, generator=generator)]]


def _coats(settings: FleetSettings, generator: torch.Generator) -> list[Coat]:
    """Says how each vehicle is painted: exact shares, in random order."""
    shares = settings.paints.shares
    coats: list[Coat] = [_USUAL] * settings.count
    # Without variety nothing is drawn, so that fleets with catalogue paints do not change.
    if any(shares.values()):
        order = torch.randperm(settings.count, generator=generator).tolist()
        first = 0.0
        for coat, share in shares.items():
            last = first + share * settings.count
            for index in order[round(first) : round(last)]:
                coats[index] = cast(Coat, coat)
            first = last
    return coats


def exact_share(share: float, count: int, generator: torch.Generator) -> list[int]:
    """Draws an exact share of `count` indices; a share of 0 takes nothing from the generator."""
    if not share:
        return []
    order = torch.randperm(count, generator=generator).tolist()
    return sorted(order[: round(share * count)])


def mix_fleets(fleets: Sequence[Fleet]) -> Fleet:
    """Returns all vehicles of several fleets, whose ids must differ, as one, in the order given."""
    if not fleets:
        raise ConfigurationError("Mixing needs at least one fleet; give fleet folders.")
    ids = tuple(name for fleet in fleets for name in fleet.ids)
    twice = [name for name, count in Counter(ids).items() if count > 1]
    if twice:
        raise ConfigurationError(
            f"{len(twice)} vehicle ids occur more than once, the first is {twice[0]}; give fleets "
            "whose numbers differ (first_number of FleetSettings and WrapSettings)."
        )
    vertices, textures, parts = (
        torch.cat([getattr(fleet, name) for fleet in fleets])
        for name in ("vertices", "textures", "parts")
    )
    sources = {name: source for fleet in fleets for name, source in fleet.sources.items()}
    return Fleet(None, fleets[0].template, ids, vertices, textures, parts, sources)
