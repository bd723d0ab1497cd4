"""Wrapping a small textured car whose outline and colours are known by hand, and using it."""

import json
import os
from functools import lru_cache
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import pytest
import torch
from PIL import Image
from scipy.spatial import ConvexHull
from trimesh.visual.material import SimpleMaterial

from skyproof.camouflage.make import make_camouflage
from skyproof.geometry.meshes import enclosed_volume_m3, self_intersections
from skyproof.main import run
from skyproof.render.materials import material_labels
from skyproof.render.portrait import close_up
from skyproof.reproduction.practicality import measure_shape, measure_texture
from skyproof.vehicles.fleet import Fleet, FleetSettings, mix_fleets, sample_fleet
from skyproof.vehicles.template import make_template
from skyproof.vehicles.texels import texel_metric, texel_regions
from skyproof.vehicles.vehicle import Part
from skyproof.vehicles.wrapping.wrap import WrappedVehicle, wrap_mesh
from tests.vehicles.model_car import (
    HEIGHT_M,
    LENGTH_M,
    PAINTS,
    WHEEL_M,
    WHEEL_X_M,
    WIDTH_M,
    car,
    write_obj,
)

# Half a turn about z, then z to the side: length along -y, so nothing of the frame is right by
# chance.
TURN = np.array([[0.0, 1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
TEMPLATE = make_template()
BROWNISH = (118, 108, 96)


@lru_cache
def wrapped() -> WrappedVehicle:
    """The car in inches, lying along -y, its triangles wound inside out."""
    with TemporaryDirectory() as folder:
        path = write_obj(Path(folder), car(TURN, 0.0254, inverted=True))
        return wrap_mesh(path, scale=0.0254)


@lru_cache
def fleet() -> Fleet:
    one = wrapped()
    return Fleet(
        None, TEMPLATE, ("car-1000",), one.vertices[None], one.texture[None], one.parts[None]
    )


def test_it_stands_in_the_vehicle_frame() -> None:
    vertices = wrapped().vertices
    low, high = vertices.amin(0), vertices.amax(0)
    assert (high - low).tolist() == pytest.approx([LENGTH_M, WIDTH_M, HEIGHT_M], abs=0.03)
    assert float(low[2]) == 0.0
    assert ((high + low) / 2)[:2].abs().max() < 0.02
    # The bonnet is in front: at the nose the roof line is lower than at the tail's end of the
    # cabin.
    roof = vertices[16 : 31 * 32 : 32]
    assert roof[roof[:, 0] > 1.0, 2].max() < 0.95
    assert roof[(roof[:, 0] > -1.5) & (roof[:, 0] < 0.0), 2].min() > 1.4


def test_its_outline_from_above_is_the_cars() -> None:
    """The car's outline is a rectangle; the vertices' hull is all the wrapped one can cover."""
    points = wrapped().vertices[:, :2].double().numpy()
    inside = np.clip(points, [-LENGTH_M / 2, -WIDTH_M / 2], [LENGTH_M / 2, WIDTH_M / 2])
    common, own = ConvexHull(inside).volume, ConvexHull(points).volume
    iou = common / (LENGTH_M * WIDTH_M + own - common)
    assert iou > 0.97
    assert wrapped().report["iou_above"] == pytest.approx(iou, abs=0.01)


def test_it_is_a_sound_template() -> None:
    vertices = wrapped().vertices
    assert self_intersections(vertices, TEMPLATE.faces) == wrapped().report["crossings"] == 0
    # Outward faces; body, cabin and wheels by hand: 5.1 + 2.0 m3, and what the skin closes round
    # the wheels.
    assert 6.5 < float(enclosed_volume_m3(vertices[None], TEMPLATE.faces)[0]) < 8.0
    mirrored = vertices[TEMPLATE.mirror] * torch.tensor([1.0, -1.0, 1.0])
    assert (mirrored - vertices).abs().max() < 0.03
    for x in WHEEL_X_M:
        near = (vertices[:, 0] - x).abs() < WHEEL_M
        assert vertices[near, 2].min() < 0.05


def test_every_quarter_keeps_its_paint() -> None:
    texture, parts = wrapped().texture, wrapped().parts
    for name, rows, columns in (
        ("front left", slice(60, 130), slice(100, 250)),
        ("front right", slice(60, 130), slice(262, 412)),
        ("rear left", slice(440, 490), slice(100, 250)),
        ("rear right", slice(440, 490), slice(262, 412)),
    ):
        body = parts[rows, columns] == Part.BODY
        assert body.float().mean() > 0.6, name
        paint = texture[:, rows, columns][:, body].float().median(1).values
        assert paint.tolist() == pytest.approx(PAINTS[name], abs=3), name


def test_parts_are_where_the_car_has_them() -> None:
    parts = wrapped().parts
    share = {part: float((parts == part).float().mean()) for part in Part}
    assert (
        share[Part.LIGHT] == share[Part.BUMPER] == share[Part.TRIM] == 0.0
    )  # nothing tells of them
    assert share[Part.GLASS] > 0.05
    assert share[Part.WHEEL] > 0.01
    # The roof is paint amid glass; the middle of the floor is underside; bonnet and tail are paint.
    middle = parts[:, 256]
    glass = (middle == Part.GLASS).nonzero()[:, 0]
    assert 130 < int(glass.min()) < 260
    assert (middle[(glass.min() + glass.max()) // 2] == Part.BODY).item()
    assert (parts[100:400, :8] == Part.UNDERSIDE).all()
    wheels = (parts == Part.WHEEL).nonzero()[:, 0]
    assert {int(row) // 128 for row in wheels} <= {0, 1, 2, 3}
    assert not ((wheels > 230) & (wheels < 280)).any()
    assert wrapped().report["parts_by"]["name"] > 0.1


@lru_cache
def unnamed(stripe: bool = False) -> WrappedVehicle:
    """The car in white, with windows of a brownish grey, by materials whose names say nothing."""
    scene = car()
    paint = np.full((64, 64, 3), 230, np.uint8)
    if stripe:
        # Along the left side, from the sill up.
        paint[:1] = BROWNISH
    for name, colour in (
        ("body", paint),
        ("roof", paint),
        ("cabin", BROWNISH),
        ("wheels", (20,) * 3),
    ):
        pixels = np.broadcast_to(np.array(colour, np.uint8), (64, 64, 3))
        visual = scene.geometry[name].visual
        visual.material = SimpleMaterial(image=Image.fromarray(pixels), name=f"material_{name[0]}")
    with TemporaryDirectory() as folder:
        return wrap_mesh(write_obj(Path(folder), scene))


def test_windows_of_any_grey_are_found_by_place_and_shape() -> None:
    named = wrapped().parts == Part.GLASS
    found = unnamed().parts == Part.GLASS
    assert (found & named).sum() / (found | named).sum() > 0.8


def test_a_stripe_in_the_colour_of_windows_stays_paint() -> None:
    plain = unnamed().parts == Part.GLASS
    striped = unnamed(stripe=True).parts == Part.GLASS
    # It covers the left side from the sill to the windows, which it touches.
    away = unnamed(stripe=True).texture[:, :, 40:140].float()
    away = away - torch.tensor(BROWNISH)[:, None, None]
    assert (away.abs().amax(0) < 25).float().mean() > 0.2
    assert (plain & ~striped).sum() < 0.02 * plain.sum()
    # Of the stripe only what reaches up to them.
    assert (striped & ~plain).sum() < 0.2 * plain.sum()


def test_measures_and_notes_are_reported() -> None:
    report = wrapped().report
    assert report["iou_above"] > 0.98
    assert report["iou_side"] > 0.97
    assert 0.0 <= report["median_m"] < 0.01
    assert (
        report["median_m"] <= report["p95_m"] <= report["hausdorff_m"] < 0.7
    )  # inside the wheel arches
    assert report["forward"] == "-y"
    assert report["nose"].startswith("bonnet")
    assert any("inwards" in note for note in report["notes"])
    json.dumps(report)


def test_every_camouflage_applies_to_it() -> None:
    vehicles = fleet().batch(["car-1000"])
    plain = close_up(vehicles, gsd_m=0.05, side_m=6.0)
    for name in ("T-U", "T-Ma", "S-O@0.3", "R-S-O@0.3"):
        camouflage = make_camouflage(name, generator=torch.Generator().manual_seed(0))
        worn = camouflage(vehicles)
        picture = close_up(worn, gsd_m=0.05, side_m=6.0)
        assert picture.shape == plain.shape
        assert (picture != plain).any(), name
        assert material_labels(worn).shape == (1, 512, 512)
        if name == "T-Ma":
            assert torch.equal(worn.overlay.mask, vehicles.parts == Part.BODY)
            (measured,) = measure_texture(
                vehicles, torch.zeros(3, 512, 512), worn.overlay.mask, None
            )
            assert 5.0 < measured["painted_area_m2"] < 20.0
        if name == "R-S-O@0.3":
            measure_shape(vehicles, worn)
            # The middle of the underside stays, the faces of the bumpers aside.
            assert torch.equal(worn.vertices[0, 96:896:32], vehicles.vertices[0, 96:896:32])
    regions = texel_regions(vehicles)
    assert all(regions[name].any() for name in ("roof", "bonnet", "sides", "glass", "underside"))
    assert 0.005 < texel_metric(vehicles)[0][regions["roof"]].median() < 0.02


def test_fleets_mix_and_come_back(tmp_path: Path) -> None:
    drawn = sample_fleet(FleetSettings(count=2), generator=torch.Generator().manual_seed(0))
    one = Fleet(
        **{**vars(fleet()), "sources": {"car-1000": {"mesh": "car.obj", "licence": "ours"}}}
    )
    mixed = mix_fleets([drawn, one])
    mixed.save(tmp_path / "mixed")
    back = Fleet.load(tmp_path / "mixed")
    assert back.ids == (*drawn.ids, "car-1000")
    assert back.settings is None
    assert back.sources == {"car-1000": {"mesh": "car.obj", "licence": "ours"}}
    assert torch.equal(back.batch(["car-1000"]).vertices, one.vertices)
    assert torch.equal(back.batch(drawn.ids[:1]).texture, drawn.textures[:1])


def test_fleets_written_before_wrapping_are_read(tmp_path: Path) -> None:
    drawn = sample_fleet(FleetSettings(count=1), generator=torch.Generator().manual_seed(0))
    drawn.save(tmp_path / "old")
    described = json.loads((tmp_path / "old/fleet.json").read_text())
    del described["sources"]
    (tmp_path / "old/fleet.json").write_text(json.dumps(described))
    assert Fleet.load(tmp_path / "old").settings == drawn.settings


def test_the_commands(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    mesh = write_obj(tmp_path / "mesh")
    out = tmp_path / "wrapped"
    options = ["--wrapping.names", "Model Car", "--wrapping.licence", "ours"]
    assert run(["vehicles", str(mesh), "--out", str(out), *options]) == 0
    assert sorted(path.name for path in out.iterdir()) == [
        "fleet.json",
        "fleet.safetensors",
        "turntable.png",
        "wrap.json",
    ]
    report = json.loads((out / "wrap.json").read_text())["model-car-1000"]
    assert report["licence"] == "ours"
    assert report["iou_above"] > 0.97
    assert "0.99" in capsys.readouterr().out
    with Image.open(out / "turntable.png") as sheet:
        assert sheet.width > 2000
    assert run(["vehicles", str(out), str(out), "--out", str(tmp_path / "twice")]) == 2
    assert "model-car-1000" in capsys.readouterr().err
    assert not (tmp_path / "twice").exists()
    assert run(["vehicles", str(out), "--out", str(out)]) == 2
    strict = ["vehicles", str(mesh), "--out", str(tmp_path / "strict")]
    assert run([*strict, "--wrapping.minimum-iou", "0.9999"]) == 2
    assert "IoU" in capsys.readouterr().err
    assert not (tmp_path / "strict").exists()


@pytest.mark.data
def test_real_vehicles_keep_their_outline() -> None:
    data = os.environ.get("SKYPROOF_DATA")
    if not data:
        pytest.skip("SKYPROOF_DATA names no folder")
    meshes = Path(data) / "vehicles/gazebo_vehicles"
    report = wrap_mesh(meshes / "hatchback/meshes/hatchback.obj", scale=0.0254).report
    assert report["iou_above"] > 0.985
    assert report["crossings"] == 0
