"""Camouflages: what they change, their finish, and their folder."""

import json

import numpy as np
import pytest
import torch
from PIL import Image
from safetensors.torch import load_file, save_file

from skyproof.camouflage.folder import load_camouflage, save_camouflage
from skyproof.camouflage.name import CamouflageName
from skyproof.camouflage.texture import UniversalTexture
from skyproof.errors import StoredFileError
from tests.render.bodies import vehicles


def texture(name="T-U", seed=0):
    return UniversalTexture(
        CamouflageName.parse(name), generator=torch.Generator().manual_seed(seed)
    )


def stored(folder, seed=0):
    camouflage = texture(seed=seed)
    camouflage.finalise()
    save_camouflage(folder, camouflage, {"note": "made in a test"})
    return camouflage


def test_one_map_replaces_every_texture_and_nothing_else():
    batch, camouflage = vehicles(3), texture()
    changed = camouflage(batch)
    assert changed.texture.shape == (1, 3, 512, 512)
    assert torch.equal(changed.texture[0], camouflage.cells)
    assert changed.vertices is batch.vertices
    assert changed.parts is batch.parts
    assert changed.ids == batch.ids


def test_the_map_can_be_learnt():
    camouflage = texture()
    camouflage(vehicles()).texture.sum().backward()
    assert torch.equal(camouflage.cells.grad, torch.ones(3, 512, 512))


def test_a_random_control_is_where_the_attack_with_its_seed_starts():
    # R-U and T-U from one seed are the same map, uniform in [0, 1] (section S4.2).
    control, start = texture("R-U-0", seed=7), texture("T-U", seed=7)
    assert torch.equal(control.cells, start.cells)
    assert not torch.equal(control.cells, texture("R-U-1", seed=8).cells)
    assert control.cells.min() >= 0
    assert control.cells.max() <= 1
    assert float(control.cells.detach().mean()) == pytest.approx(0.5, abs=0.005)
    assert float(control.cells.detach().var()) == pytest.approx(1 / 12, abs=0.001)


def test_drawing_a_map_leaves_the_global_generator_alone():
    before = torch.random.get_rng_state()
    texture()
    assert torch.equal(before, torch.random.get_rng_state())


def test_projection_clips_colours_and_keeps_those_inside():
    camouflage = texture()
    with torch.no_grad():
        camouflage.cells[0] += 2.0
        camouflage.cells[1] -= 2.0
    inside = camouflage.cells[2].clone()
    camouflage.project_()
    assert (camouflage.cells[0] == 1).all()
    assert (camouflage.cells[1] == 0).all()
    assert torch.equal(camouflage.cells[2], inside)


def test_finished_colours_have_eight_bits_and_are_the_nearest():
    camouflage = texture()
    before = camouflage.cells.detach().clone()
    camouflage.finalise()
    levels = camouflage.cells.detach() * 255
    assert torch.equal(levels.round() / 255, camouflage.cells.detach())
    assert (levels - before * 255).abs().max() <= 0.5 + 1e-4
    once = camouflage.cells.detach().clone()
    camouflage.finalise()
    assert torch.equal(once, camouflage.cells)


def test_a_stored_camouflage_reads_back_bit_for_bit_and_its_png_shows_it(tmp_path):
    saved = stored(tmp_path / "one")
    loaded = load_camouflage(tmp_path / "one")
    assert isinstance(loaded, UniversalTexture)
    assert str(loaded.name) == "T-U"
    assert torch.equal(loaded.cells, saved.cells)
    assert not loaded.cells.requires_grad
    with Image.open(tmp_path / "one" / "texture.png") as image:
        pixels = torch.from_numpy(np.array(image)).permute(2, 0, 1)
    assert torch.equal(pixels.float() / 255, saved.cells.detach())
    assert json.loads((tmp_path / "one" / "camouflage.json").read_text())["record"] == {
        "note": "made in a test"
    }
    assert {path.name for path in (tmp_path / "one").iterdir()} == {
        "camouflage.json",
        "camouflage.safetensors",
        "texture.png",
    }


def cut(path):
    path.write_bytes(path.read_bytes()[:200])


def rewritten(**fields):
    return lambda path: path.write_text(json.dumps({**json.loads(path.read_text()), **fields}))


@pytest.mark.parametrize(
    ("name", "spoil"),
    [
        ("camouflage.json", lambda path: path.unlink()),
        ("camouflage.json", lambda path: path.write_text("{")),
        ("camouflage.json", lambda path: path.write_text("[1]")),
        ("camouflage.json", rewritten(format=99)),
        ("camouflage.json", rewritten(camouflage={"kind": "Invisibility", "name": "T-U"})),
        ("camouflage.json", rewritten(camouflage={"kind": "UniversalTexture"})),
        ("camouflage.safetensors", lambda path: path.unlink()),
        ("camouflage.safetensors", cut),
        ("camouflage.safetensors", lambda path: path.write_bytes(b"")),
    ],
    ids=[
        "missing",
        "not-json",
        "a-list",
        "other-version",
        "other-kind",
        "no-name",
        "no-map",
        "cut-map",
        "empty-map",
    ],
)
def test_damage_is_one_error_that_names_the_file(tmp_path, name, spoil):
    stored(tmp_path / "one")
    spoil(tmp_path / "one" / name)
    with pytest.raises(StoredFileError, match=name.replace(".", r"\.")):
        load_camouflage(tmp_path / "one")


def test_the_first_misfit_of_the_tensors_is_named(tmp_path):
    stored(tmp_path / "one")
    path = tmp_path / "one" / "camouflage.safetensors"
    good = load_file(path)
    (wanted,) = good
    shape = list(good[wanted].shape)
    for tensors, said in (
        ({wanted: torch.zeros(3, 8, 8)}, f"{wanted} has the shape [3, 8, 8], expected {shape}"),
        ({}, f"it lacks {wanted}"),
        ({**good, "more": torch.zeros(1)}, "it holds 'more' too"),
    ):
        save_file(tensors, path)
        with pytest.raises(StoredFileError) as caught:
            load_camouflage(tmp_path / "one")
        assert f"{path} does not fit camouflage.json ({said}); copy" in str(caught.value)


def test_a_missing_folder_is_one_error_that_names_it(tmp_path):
    with pytest.raises(StoredFileError, match="nowhere"):
        load_camouflage(tmp_path / "nowhere")


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"name": "T-U_../../x"}, "name: expected a plain name"),
        ({"name": "T-Blue"}, "Unknown texture constraints"),
        ({"blocks": 10**9}, "blocks: expected a whole number <= 512"),
        ({"blocks": 5, "name": "T-Pix"}, "divides the map"),
        ({"colours": 10**9}, "colours: expected a whole number <= 256"),
        ({"colours": 5}, "expects free colours, got 5"),
        ({"name": "T-Fc"}, "expects fixed colours, got None"),
        (
            {
                "kind": "Combination",
                "turn_steps": None,
                "shape": {"kind": "DisplacementMap", "name": "S-O@0.1", "frozen_parts": True},
                "texture": {"kind": "Combination", "name": "T-U"},
            },
            "texture.kind",
        ),
    ],
    ids=str,
)
def test_a_hostile_description_is_one_sentence(tmp_path, change, said):
    stored(tmp_path / "one")
    path = tmp_path / "one" / "camouflage.json"
    document = json.loads(path.read_text())
    document["camouflage"] |= change
    path.write_text(json.dumps(document))
    with pytest.raises(StoredFileError, match=said) as caught:
        load_camouflage(tmp_path / "one")
    assert "\n" not in str(caught.value)
