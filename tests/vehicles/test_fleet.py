"""Fleets: from a seed, and to disk and back."""

import json
from collections import Counter
from functools import lru_cache
from pathlib import Path

import pytest
import torch
from safetensors.torch import load_file, save_file

from skyproof.errors import ConfigurationError, RunFolderError, StoredFileError
from skyproof.vehicles.fleet import Fleet, FleetSettings, sample_fleet
from skyproof.vehicles.settings import PaintVariety
from skyproof.vehicles.vehicle import Part


@lru_cache
def _fleet(seed: int = 0) -> Fleet:
    return sample_fleet(
        FleetSettings(count=5, first_number=10), generator=torch.Generator().manual_seed(seed)
    )


def _same(one: Fleet, other: Fleet) -> bool:
    tensors = all(
        torch.equal(getattr(one, n), getattr(other, n)) for n in ("vertices", "textures", "parts")
    )
    return tensors and one.ids == other.ids and one.settings == other.settings


def test_the_seed_decides_everything() -> None:
    again = sample_fleet(
        FleetSettings(count=5, first_number=10), generator=torch.Generator().manual_seed(0)
    )
    assert _same(_fleet(), again)
    assert not _same(_fleet(), _fleet(1))


def test_paints_of_a_place_are_worn_in_their_shares() -> None:
    worn = torch.tensor([[0.8, 0.1, 0.1]] * 6 + [[0.1, 0.1, 0.7]] * 2)

    def drawn(count: int, seed: int = 0) -> Fleet:
        generator = torch.Generator().manual_seed(seed)
        return sample_fleet(FleetSettings(count=count), worn=worn, generator=generator)

    fleet = drawn(8)
    bodies = fleet.parts == Part.BODY
    middles = [fleet.textures[n][:, bodies[n]].float().median(dim=1).values / 255 for n in range(8)]
    reds = sum(bool((middle - worn[0]).abs().max() < 0.05) for middle in middles)
    blues = sum(bool((middle - worn[-1]).abs().max() < 0.05) for middle in middles)
    assert (reds, blues) == (6, 2)
    assert {each["paint"] for each in fleet.sources.values()} == {"of a labelled vehicle"}
    assert len(fleet.sources) == 8
    assert _same(fleet, drawn(8))
    assert not torch.equal(fleet.textures, drawn(8, seed=1).textures)


def test_a_coat_in_place_of_the_paint_of_a_place_is_recorded_alone() -> None:
    settings = FleetSettings(count=8, paints=PaintVariety(0.5, 0.0, 0.0, 0.0))
    worn = torch.full((4, 3), 0.5)
    fleet = sample_fleet(settings, worn=worn, generator=torch.Generator().manual_seed(0))
    records = [tuple(each.items()) for each in fleet.sources.values()]
    assert Counter(records) == {
        (("coat", "plain"),): 4,
        (("paint", "of a labelled vehicle"),): 4,
    }


def test_the_global_seed_does_not_matter() -> None:
    before = torch.random.get_rng_state()
    _fleet(2)
    assert torch.equal(before, torch.random.get_rng_state())


def test_ids_carry_body_type_and_number() -> None:
    types, numbers = zip(*(vehicle_id.rsplit("-", 1) for vehicle_id in _fleet().ids), strict=True)
    assert set(types) <= set(FleetSettings().weights)
    assert numbers == ("0010", "0011", "0012", "0013", "0014")


def test_batch_repeats_and_orders() -> None:
    fleet = _fleet()
    batch = fleet.batch([fleet.ids[3], fleet.ids[0], fleet.ids[3]])
    assert batch.ids == (fleet.ids[3], fleet.ids[0], fleet.ids[3])
    assert torch.equal(batch.vertices[0], fleet.vertices[3])
    assert torch.equal(batch.vertices[0], batch.vertices[2])
    assert torch.equal(batch.texture[1], fleet.textures[0])
    with pytest.raises(ConfigurationError, match="No vehicle 'tank-0001'"):
        fleet.batch(["tank-0001"])


def test_size() -> None:
    fleet = _fleet()
    length, width, height = fleet.sizes_m[fleet.ids[1]]
    x, y, z = fleet.vertices[1].unbind(1)
    assert (length, width, height) == pytest.approx(
        (float(x.max() - x.min()), 2 * float(y.max()), float(z.max()))
    )
    assert length > width > height * 0.7


def test_settings_refuse_nonsense() -> None:
    for wrong in (
        {"count": 0},
        {"weights": {"tank": 1.0}},
        {"weights": {"van": -1.0}},
        {"weights": {}},
    ):
        with pytest.raises(ConfigurationError):
            FleetSettings(**wrong)


def test_save_and_load(tmp_path: Path) -> None:
    _fleet().save(tmp_path / "fleet")
    assert _same(_fleet(), Fleet.load(tmp_path / "fleet"))
    assert sorted(p.name for p in tmp_path.rglob("*")) == [
        "fleet",
        "fleet.json",
        "fleet.safetensors",
    ]
    with pytest.raises(RunFolderError, match="exists already"):
        _fleet().save(tmp_path / "fleet")


@pytest.mark.parametrize(
    "damage", ["missing", "no tensors", "cut", "other version", "list", "ids", "not json", "key"]
)
def test_damaged_folders_are_named_in_one_sentence(tmp_path: Path, damage: str) -> None:
    folder = tmp_path / "fleet"
    _fleet().save(folder)
    tensors, description = folder / "fleet.safetensors", folder / "fleet.json"
    content = json.loads(description.read_text())
    if damage == "missing":
        folder = tmp_path / "elsewhere"
    elif damage == "no tensors":
        tensors.unlink()
    elif damage == "cut":
        tensors.write_bytes(tensors.read_bytes()[:5000])
    elif damage == "other version":
        description.write_text(json.dumps(content | {"format": 99}))
    elif damage == "list":
        description.write_text("[]")
    elif damage == "ids":
        description.write_text(json.dumps(content | {"ids": content["ids"][:2]}))
    elif damage == "not json":
        description.write_text("{")
    else:
        del content["settings"]
        description.write_text(json.dumps(content))
    with pytest.raises(StoredFileError, match=folder.name) as caught:
        Fleet.load(folder)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"ids": ["../../x"] * 5}, r"ids\[0\]: expected a plain name"),
        ({"ids": ["a", "b", "c", "d", "a"]}, "the vehicle a is there twice"),
        ({"ids": []}, "ids: expected a list of length >= 1"),
        ({"ids": ["a"]}, "expects vertices of"),
        ({"settings": {"count": 10**9}}, "count expects|settings.count: expected"),
        ({"settings": {"cuont": 5}}, "no field 'cuont'"),
        ({"sources": {"a": 5}}, "sources"),
        ({"format": True}, "format True"),
    ],
    ids=str,
)
def test_a_hostile_description_is_one_sentence(tmp_path: Path, change: dict, said: str) -> None:
    _fleet().save(tmp_path / "fleet")
    path = tmp_path / "fleet" / "fleet.json"
    path.write_text(json.dumps(json.loads(path.read_text()) | change))
    with pytest.raises(StoredFileError, match=said) as caught:
        Fleet.load(tmp_path / "fleet")
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("name", "value", "said"),
    [
        ("vertices", 1e6, "more than 100 m"),
        ("vertices", float("nan"), "not finite"),
        ("parts", 99, "part labels above 6"),
    ],
)
def test_hostile_numbers_of_a_fleet_are_refused(
    tmp_path: Path, name: str, value: float, said: str
) -> None:
    _fleet().save(tmp_path / "fleet")
    path = tmp_path / "fleet" / "fleet.safetensors"
    tensors = load_file(path)
    tensors[name].view(-1)[7] = value
    save_file(tensors, path)
    with pytest.raises(StoredFileError, match=said):
        Fleet.load(tmp_path / "fleet")
