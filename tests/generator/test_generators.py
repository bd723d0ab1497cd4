"""What generators make of fits: whole vehicles, each its own, the same for the same seed."""

from __future__ import annotations

import json
import math
from pathlib import Path

import pytest
import torch

from skyproof.errors import StoredFileError
from skyproof.generator.adversarial import LATENT, AdversarialGenerator
from skyproof.generator.adversarial_training import learn_adversarially
from skyproof.generator.fits import FittedVehicles
from skyproof.generator.fleet import sample_learnt_fleet
from skyproof.generator.folder import load_generator, save_generator
from skyproof.generator.layered import LayeredGenerator
from skyproof.generator.maps import half_grid, part_map, texture_map, vertices_of
from skyproof.generator.settings import AdversarialSettings
from skyproof.geometry.colour import srgb_to_cielab
from skyproof.storage import read_tensors, write_tensors
from skyproof.vehicles.fleet import Fleet, FleetSettings
from skyproof.vehicles.settings import PaintVariety
from skyproof.vehicles.vehicle import Part

ON_GPU = [
    pytest.mark.gpu,
    pytest.mark.skipif(not torch.cuda.is_available(), reason="no CUDA device"),
]
SHORT = AdversarialSettings(steps=6, batch_size=4)


@pytest.fixture(scope="module")
def layered(fitted: FittedVehicles) -> LayeredGenerator:
    return LayeredGenerator.learn(fitted)


@pytest.fixture(scope="module")
def adversarial(
    fitted: FittedVehicles, tmp_path_factory: pytest.TempPathFactory
) -> AdversarialGenerator:
    return learn_adversarially(fitted, SHORT, tmp_path_factory.mktemp("gan"))


def fleet_of(
    generator: LayeredGenerator | AdversarialGenerator, count: int = 12, seed: int = 3
) -> Fleet:
    settings = FleetSettings(count, first_number=40)
    return sample_learnt_fleet(generator, settings, generator=torch.Generator().manual_seed(seed))


@pytest.mark.parametrize("method", ["layered", "gan"])
def test_a_learnt_fleet_is_one_like_any_other(
    method: str,
    layered: LayeredGenerator,
    adversarial: AdversarialGenerator,
    tmp_path: Path,
) -> None:
    generator = layered if method == "layered" else adversarial
    fleet = fleet_of(generator)
    assert fleet.ids[0].endswith("-0040")
    fleet.save(tmp_path / "fleet")
    again = Fleet.load(tmp_path / "fleet")
    assert again.sources[fleet.ids[0]] == {"generator": method}
    mirrored = fleet.vertices[:, fleet.template.mirror] * torch.tensor([1.0, -1.0, 1.0])
    assert torch.allclose(mirrored, fleet.vertices, atol=1e-6)
    assert torch.equal(fleet.parts.flip(-1), fleet.parts)
    assert float(fleet.vertices[..., 2].amin(1).abs().max()) < 0.02
    same = fleet_of(generator)
    assert torch.equal(same.textures, fleet.textures)
    assert torch.equal(same.vertices, fleet.vertices)
    assert len({bytes(texture.numpy().tobytes()) for texture in fleet.textures}) == len(fleet)


def test_layered_vehicles_lie_among_the_fitted_ones(
    layered: LayeredGenerator, fitted: FittedVehicles
) -> None:
    fleet = fleet_of(layered, 24)
    for name in set(fitted.body_types):
        lengths = [
            each.length
            for each, kind in zip(fitted.dimensions, fitted.body_types, strict=True)
            if kind == name
        ]
        for vehicle in (each for each in fleet.ids if each.startswith(f"{name}-")):
            length_m, _, _ = fleet.sizes_m[vehicle]
            assert min(lengths) - 0.15 < length_m < max(lengths) + 0.15
    # White, red or black, as those that it learnt from.
    known = srgb_to_cielab(fitted.paint)
    for texture, parts in zip(fleet.textures, fleet.parts, strict=True):
        paint = texture[:, parts == Part.BODY].float().median(1).values / 255
        assert float((known - srgb_to_cielab(paint)).norm(dim=1).min()) < 12


def test_layered_vehicles_are_no_copies(layered: LayeredGenerator, fitted: FittedVehicles) -> None:
    generator = torch.Generator().manual_seed(1)
    spread = layered.latents.std(0).clamp(min=1e-3)
    drawn = torch.stack([layered.sample_latent(generator)[1] for _ in range(40)])
    distances = (drawn[:, None] / spread - layered.latents / spread).norm(dim=-1)
    assert float(distances.min()) > 0.5
    assert len(fitted) == len(layered.latents)


def test_glass_is_darker_than_white_paint_and_where_panes_are(layered: LayeredGenerator) -> None:
    fleet = fleet_of(layered, 24)
    for texture, parts in zip(fleet.textures, fleet.parts, strict=True):
        light = texture.float().mean(0) / 255
        body = float(light[parts == Part.BODY].mean())
        if body > 0.5:
            assert float(light[parts == Part.GLASS].mean()) < 0.5 * body
        assert 0.02 < float((parts == Part.GLASS).float().mean()) < 0.3


@pytest.mark.parametrize("method", ["layered", "gan"])
def test_one_vehicle_turns_into_another_by_small_steps(
    method: str, layered: LayeredGenerator, adversarial: AdversarialGenerator
) -> None:
    draw = torch.Generator().manual_seed(2)
    shares = torch.linspace(0, 1, 9).tolist()
    if method == "layered":
        body, first = layered.sample_latent(draw)
        _, last = layered.sample_latent(draw, body_type=body)
        way = [layered.decode(body, torch.lerp(first, last, share), 7) for share in shares]
    else:
        first, last = torch.randn(2, LATENT, generator=draw)
        turns = [math.pi / 2 * share for share in shares]
        way = [adversarial.decode(math.cos(a) * first + math.sin(a) * last) for a in turns]
    vertices = torch.stack([sample.vertices for sample in way])
    # Rings of a drawn body may jump along it, which changes nothing that is seen.
    sizes = vertices.amax(1) - vertices.amin(1)
    textures = torch.stack([sample.texture.float() for sample in way]).flatten(1)
    for values in (sizes, textures):
        whole = float((values[-1] - values[0]).norm())
        steps = values.diff(dim=0).norm(dim=1)
        assert whole > 0
        assert float(steps.max()) < 0.6 * whole


def test_some_wear_patterns_where_that_is_asked(layered: LayeredGenerator) -> None:
    settings = FleetSettings(10, paints=PaintVariety(0.0, 0.0, 0.0, 0.5), shapes=0.3)
    generator = torch.Generator().manual_seed(0)
    fleet = sample_learnt_fleet(layered, settings, generator=generator)
    marks = list(fleet.sources.values())
    assert sum(mark.get("coat") == "patterned" for mark in marks) == 5
    assert sum(mark.get("shape") == "random" for mark in marks) == 3


def test_maps_become_vehicles_and_back(fitted: FittedVehicles) -> None:
    vertices = fitted.vertices[:1]
    assert torch.allclose(vertices_of(half_grid(vertices)[0]), vertices[0], atol=1e-5)
    parts = part_map(fitted.parts[0])
    texture = texture_map(fitted.albedo[0], fitted.parts[0], parts)
    coarse = torch.nn.functional.avg_pool2d(texture.float() / 255, 8)
    error = (coarse[..., :32] - fitted.albedo[0]).abs().mean(0)
    # Where a texel holds one part alone.
    pure = fitted.parts[0].amax(0) > 0.99
    assert float(error[pure].mean()) < 0.02


def test_a_stopped_training_ends_at_the_same_numbers(
    fitted: FittedVehicles,
    adversarial: AdversarialGenerator,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr("skyproof.generator.adversarial_training._CHECKPOINT_EVERY", 2)
    rows: list[dict[str, object]] = []

    class Stopped(Exception):
        pass

    def stop(row: dict[str, object]) -> None:
        if row["step"] == 3:
            raise Stopped

    with pytest.raises(Stopped):
        learn_adversarially(fitted, SHORT, tmp_path / "gan", on_step=stop)
    again = learn_adversarially(fitted, SHORT, tmp_path / "gan", on_step=rows.append)
    assert [row["step"] for row in rows] == [3, 4, 5, 6]
    expected = adversarial.tensors()
    for name, value in again.tensors().items():
        assert torch.equal(value, expected[name]), name


@pytest.mark.slow
@pytest.mark.parametrize("device", ["cpu", pytest.param("cuda", marks=ON_GPU)])
def test_training_changes_what_is_made(device: str, fitted: FittedVehicles, tmp_path: Path) -> None:
    rows: list[dict[str, float]] = []
    settings = AdversarialSettings(steps=30, batch_size=8)
    made = learn_adversarially(
        fitted, settings, tmp_path / "gan", device=device, on_step=rows.append
    )
    assert made.sample(torch.Generator().manual_seed(0)).texture.device.type == "cpu"
    # The discriminator begins at 2, where it cannot tell; it learns to.
    assert sum(row["judge_loss"] for row in rows[-5:]) / 5 < 1.7


@pytest.mark.parametrize("method", ["layered", "gan"])
def test_a_generator_is_stored_and_read_again(
    method: str,
    layered: LayeredGenerator,
    adversarial: AdversarialGenerator,
    tmp_path: Path,
) -> None:
    generator = layered if method == "layered" else adversarial
    save_generator(tmp_path, generator, {"vehicles": 24})
    again = load_generator(tmp_path)
    for name, tensor in again.tensors().items():
        assert torch.equal(tensor, generator.tensors()[name])
        assert tensor.stride() == generator.tensors()[name].stride()
    assert torch.equal(fleet_of(again, 3).textures, fleet_of(generator, 3).textures)


def test_folders_of_others_are_refused(layered: LayeredGenerator, tmp_path: Path) -> None:
    with pytest.raises(StoredFileError, match=r"generator.json is missing"):
        load_generator(tmp_path)
    save_generator(tmp_path, layered, {})
    path = tmp_path / "generator.json"
    good = json.loads(path.read_text())
    path.write_text(json.dumps({**good, "format": 9}))
    with pytest.raises(StoredFileError, match="has format 9"):
        load_generator(tmp_path)
    for broken in (
        {**good, "method": "gan"},
        {**good, "body_types": good["body_types"][1:]},
        {**good, "body_types": ["tank", *good["body_types"][1:]]},
    ):
        path.write_text(json.dumps(broken))
        with pytest.raises(StoredFileError, match="holds no such generator"):
            load_generator(tmp_path)
    path.write_text(json.dumps(good))
    tensors, _ = read_tensors(tmp_path / "generator.safetensors", "again")
    tensors["latents"][0, 0] = -3.0
    write_tensors(tmp_path / "generator.safetensors", tensors)
    with pytest.raises(StoredFileError, match="holds no such generator"):
        load_generator(tmp_path)
    write_tensors(tmp_path / "generator.safetensors", tensors | {"components": torch.tensor(1.0)})
    with pytest.raises(StoredFileError, match="holds no such generator"):
        load_generator(tmp_path)
