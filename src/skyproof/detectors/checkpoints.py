"""Opens checkpoint files of other programs without running any code in them.

NOTICE: `torch.save` writes a checkpoint as a pickle, and opening a pickle in the usual way runs any
code its author put into it. Here an inert stand-in replaces every class and function that a file
names, except tensors and plain containers, and the rest is read as data: nothing in the file runs,
and its author's libraries are not needed.
"""

import re
import warnings
import zipfile
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import torch
from safetensors.torch import load_file
from torch import Tensor

from skyproof.detectors.blueprint import Kind
from skyproof.errors import ConfigurationError, StoredFileError

# Places of an averaged network: if there is one, it is the one in use.
_AVERAGED = re.compile(r"(?<![a-z])(ema|swa)(?![a-z])|averag", re.IGNORECASE)
# The prefix of all tensor names of a network that is wrapped for several devices.
_WRAPPER = "module."
# The prefix of the tensor names of a part that is compiled.
_COMPILED = re.compile(r"(^|(?<=\.))_orig_mod\.")
# Counters, which some programs leave out, and others add.
_COUNTERS = ("num_batches_tracked", "n_averaged")
_MOST_MODULES = 100_000
_LONGEST_NAME = 2000
# Half precision doubles in size, and layers may share weights.
_MOST_WIDENED = 8


@dataclass(frozen=True)
class Checkpoint:
    """A checkpoint file, whose code is never run, and the facts needed to read it.

    The kind is "torchvision", "ultralytics" or "transformers", whose path is model.safetensors in a
    folder of `save_pretrained`, or a file of RF-DETR's trainer. Vehicle classes are names, but
    label numbers for torchvision (COCO: 3 car, 6 bus, 8 truck), which also needs `architecture`.
    `gsd_m` is the resolution that the detector was made for; None means that of the images.
    """

    path: Path
    kind: Kind
    vehicle_classes: Sequence[str]
    architecture: str | None = None
    gsd_m: float | None = None


class ReadNetwork(NamedTuple):
    """The network of a checkpoint: see `Blueprint`; vehicle classes are positions."""

    architecture: str | dict[str, Any]
    classes: list[str]
    vehicle_classes: list[int]
    norm_eps: float | None = None
    side_px: int | None = None


class StandIn:
    """An object of a foreign class, named by `origin`: its attributes, without behaviour."""

    origin: str = ""

    def __new__(cls, *arguments: Any, **named: Any) -> "StandIn":
        return object.__new__(cls)

    def __setstate__(self, state: Any) -> None:
        if isinstance(state, dict):
            self.__dict__.update(state)


def read_checkpoint(path: Path) -> Any:
    """Reads a file of safetensors or of `torch.save`; foreign objects become `StandIn`."""
    if not path.is_file():
        raise StoredFileError(f"{path} is missing; give a checkpoint file.")
    try:
        if path.suffix == ".safetensors":
            return load_file(path)
        _refuse_packed(path)
        # The format from before 2020 lists no names, but its unpickler refuses foreign ones.
        listed = torch.serialization.get_unsafe_globals_in_checkpoint
        names = listed(str(path)) if zipfile.is_zipfile(path) else []
        stand_ins = [
            (type(name.rpartition(".")[2], (StandIn,), {"origin": name}), name) for name in names
        ]
        with (
            torch.serialization.safe_globals(stand_ins),  # type: ignore[arg-type]
            # Torch warns of kinds of tensors that are refused afterwards.
            warnings.catch_warnings(action="ignore"),
        ):
            return torch.load(path, map_location="cpu", weights_only=True)
    except Exception as error:
        # A damaged file can raise any exception, and torch's message may advise running it.
        raise StoredFileError(
            f"{path} is not a checkpoint that can be read: {_what_came(path)}; give a file with "
            "weights, as torch.save or safetensors write it. Or export the detector to ONNX, which "
            "skyproof assess tests as a black box, or give sp.assess a function (examples/recipes)."
        ) from error


def networks_in(content: Any) -> dict[str, Any]:
    """Finds the largest state dicts or stored networks, averaged ones first, by their places.

    A place is a path of keys, such as "ema.module"; it is empty for the whole content.
    """
    found: dict[str, tuple[int, Any]] = {}
    waiting = [("", content)]
    seen = set[int]()
    while waiting:
        place, part = waiting.pop(0)
        if id(part) in seen or len(place) > _LONGEST_NAME:
            continue
        seen.add(id(part))
        names = [name for name, _ in _tensors_of(part) if not name.endswith(_COUNTERS)]
        if names:
            found[place] = len(names), part
        if isinstance(part, Mapping):
            below = [(f"{place}.{name}".lstrip("."), value) for name, value in part.items()]
            waiting += [each for each in below if isinstance(each[1], Mapping | StandIn)]
    most = max((count for count, _ in found.values()), default=0)
    largest = [place for place, (count, _) in found.items() if count == most]
    return {place: found[place][1] for place in averaged_first(largest)}


def averaged_first(places: Iterable[str]) -> list[str]:
    """Sorts places, or prefixes of names, so that those of averaged networks come first."""
    return sorted(places, key=lambda place: not _AVERAGED.search(place))


def state_of(network: Any) -> dict[str, Tensor]:
    """Parameters and buffers in float32; refuses tensors that claim more than their file holds."""
    found = dict(_tensors_of(network))
    for name, value in found.items():
        what = _other_than_dense(value)
        if what:
            raise StoredFileError(
                f"The checkpoint's tensor {name[:100]} is {what}, but plain dense tensors are "
                "expected; give the weights as they were trained."
            )
        # A few stored bytes can pose as a tensor of any size.
        if value.numel() * value.element_size() > value.untyped_storage().nbytes():
            raise StoredFileError(
                f"The checkpoint's tensor {name[:100]} claims the shape {list(value.shape)[:8]}, "
                "more than its file holds; give a file as torch.save writes it."
            )
    # Many names can claim the same bytes, and each would be widened to floats.
    storages = [value.untyped_storage() for value in found.values()]
    held = sum({each.data_ptr(): each.nbytes() for each in storages}.values())
    if sum(max(4, value.element_size()) * value.numel() for value in found.values()) > (
        _MOST_WIDENED * held + 2**20
    ):
        raise StoredFileError(
            f"The checkpoint's {len(found):,} tensors share {held:,} bytes and claim many times as "
            "much; give a file as torch.save writes it."
        )
    found.pop("n_averaged", None)
    found = {_COMPILED.sub("", name): value for name, value in found.items()}
    while found and all(name.startswith(_WRAPPER) for name in found):
        found = {name.removeprefix(_WRAPPER): value for name, value in found.items()}
    # Ultralytics stores half precision.
    return {
        name: value.detach().float() if value.is_floating_point() else value
        for name, value in found.items()
    }


def parts_of(network: StandIn) -> Iterator[tuple[StandIn, str]]:
    """Yields a stored network and all its parts, each with the prefix of its tensors' names."""
    waiting = [(network, "")]
    walked = 0
    while waiting:
        module, prefix = waiting.pop()
        walked += 1
        if walked > _MOST_MODULES or len(prefix) > _LONGEST_NAME:
            raise StoredFileError(
                f"The checkpoint's network has more than {_MOST_MODULES:,} parts, or holds itself; "
                "give the file of a detector."
            )
        yield module, prefix
        children = [
            (child, f"{prefix}{name}.")
            for name, child in _named(module, "_modules")
            if isinstance(child, StandIn)
        ]
        # The order of a state dict: a part with everything below it, then the next.
        waiting += reversed(children)


def _other_than_dense(tensor: Tensor) -> str:
    """Describes a tensor that does not hold plain numbers in memory."""
    if tensor.is_nested or tensor.layout is not torch.strided:
        return "nested" if tensor.is_nested else "sparse"
    if tensor.is_quantized:
        return "quantised"
    return "without its numbers" if tensor.device.type != "cpu" else ""


def _tensors_of(network: Any) -> Iterator[tuple[str, Tensor]]:
    """Yields the tensors of a state dict, or of a stored network by their state-dict names."""
    if isinstance(network, Mapping):
        for name, value in network.items():
            if isinstance(name, str) and isinstance(value, Tensor):
                yield name, value
    for module, prefix in parts_of(network) if isinstance(network, StandIn) else ():
        fleeting = vars(module).get("_non_persistent_buffers_set") or ()
        for kind in ("_parameters", "_buffers"):
            for name, value in _named(module, kind):
                if isinstance(value, Tensor) and not (kind == "_buffers" and name in fleeting):
                    yield prefix + name, value


def _named(module: StandIn, kind: str) -> list[tuple[str, Any]]:
    held = vars(module).get(kind)
    items = held.items() if isinstance(held, Mapping) else ()
    return [(name, value) for name, value in items if isinstance(name, str)]


def _refuse_packed(path: Path) -> None:
    """Refuses an archive that unpacks to more than its own size: torch.save never compresses."""
    if zipfile.is_zipfile(path):
        with zipfile.ZipFile(path) as archive:
            if sum(entry.file_size for entry in archive.infolist()) > path.stat().st_size:
                raise ValueError("packed")


def _what_came(path: Path) -> str:
    """Describes in a few words a file that cannot be read as a checkpoint."""
    if path.suffix == ".safetensors":
        return "it is no safetensors file, or damaged"
    if path.suffix.lower() == ".onnx":
        return "it is an ONNX file, which skyproof assess takes as it is"
    try:
        with path.open("rb") as file:
            begin = file.read(2)
        if not zipfile.is_zipfile(path):
            # Pickles of protocol 2 and later begin like this.
            if begin[:1] == b"\x80" or begin == b"PK":
                return "it is damaged, or a pickle that is more than tensors and plain values"
            return "it is no file of torch.save"
        with zipfile.ZipFile(path) as archive:
            names = {name.rpartition("/")[2] for name in archive.namelist()}
            packed = any(entry.compress_type for entry in archive.infolist())
    except (OSError, zipfile.BadZipFile, ValueError, NotImplementedError):
        return "it is damaged"
    if "constants.pkl" in names:
        return "it is a compiled program (TorchScript)"
    if packed:
        return "it is a packed archive, and torch.save packs nothing"
    if "data.pkl" in names:
        return "it is damaged, or names what no checkpoint needs"
    return "it is an archive of something else"


def class_positions(vehicles: Sequence[str], classes: list[str]) -> list[int]:
    """Returns where vehicle classes stand among a network's classes; refuses unknown names."""
    missing = [name for name in vehicles if name not in classes]
    if missing or not vehicles:
        raise ConfigurationError(
            f"--vehicle-classes expects names out of {', '.join(classes)}; got "
            f"{', '.join(missing) or 'none'}."
        )
    # Several classes may have the same name, and a name may be given twice.
    found = (index for one in vehicles for index, name in enumerate(classes) if name == one)
    return [*dict.fromkeys(found)]
