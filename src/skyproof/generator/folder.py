"""A generator of vehicles in its folder: `generator.json` and `generator.safetensors`."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

from msgspec import Meta

from skyproof.documents import read_document
from skyproof.errors import StoredFileError
from skyproof.files import write_json
from skyproof.generator.adversarial import AdversarialGenerator
from skyproof.generator.layered import LayeredGenerator
from skyproof.generator.settings import Method
from skyproof.ranges import Name
from skyproof.storage import read_tensors, write_tensors

FORMAT_VERSION = 1

_REMEDY = "copy the whole folder again, or learn the vehicles again"


@dataclass(frozen=True)
class _Description:
    """The content of `generator.json`; body types are those of a layered generator's vehicles."""

    format: int
    method: Method
    body_types: Annotated[tuple[Name, ...], Meta(max_length=1_000_000)]
    record: dict[str, Any]


def save_generator(
    folder: Path, generator: LayeredGenerator | AdversarialGenerator, record: dict[str, Any]
) -> None:
    """Writes a generator; `generator.json` comes last."""
    write_tensors(folder / "generator.safetensors", generator.tensors())
    types = generator.body_types if isinstance(generator, LayeredGenerator) else ()
    description = {"format": FORMAT_VERSION, "method": generator.method, "body_types": list(types)}
    write_json(folder / "generator.json", description | {"record": record})


def load_generator(folder: str | Path) -> LayeredGenerator | AdversarialGenerator:
    """Reads what `save_generator` wrote.

    Raises:
        StoredFileError: the folder is missing, damaged or of another version.
    """
    folder = Path(folder)
    description = _described(folder)
    path = folder / "generator.safetensors"
    tensors, _ = read_tensors(path, _REMEDY)
    try:
        if description.method == "layered":
            return LayeredGenerator.of(description.body_types, tensors)
        return AdversarialGenerator.of(tensors)
    except (KeyError, RuntimeError, TypeError, ValueError) as error:
        raise StoredFileError(f"{path} holds no such generator; {_REMEDY}.") from error


def read_generator_record(folder: str | Path) -> dict[str, Any]:
    """Reads how a generator was learnt."""
    return _described(Path(folder)).record


def _described(folder: Path) -> _Description:
    path = folder / "generator.json"
    description: _Description = read_document(path, _Description, _REMEDY, version=FORMAT_VERSION)
    return description
