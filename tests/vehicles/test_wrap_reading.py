"""Meshes in several formats, and what is wrong with them: a stated repair or one sentence."""

import json
import math
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh
from PIL import Image
from trimesh.visual import TextureVisuals
from trimesh.visual.material import PBRMaterial

from skyproof.errors import ConfigurationError
from skyproof.main import run
from skyproof.vehicles.vehicle import Part
from skyproof.vehicles.wrapping.meshes import SourceMesh, find_texture
from skyproof.vehicles.wrapping.orientation import _spread, orient
from skyproof.vehicles.wrapping.parts import name_part
from skyproof.vehicles.wrapping.reading import read_mesh
from skyproof.vehicles.wrapping.surface import wrap_surface
from skyproof.vehicles.wrapping.views import look_around, parallel_view
from tests.vehicles.model_car import (
    GLASS,
    HEIGHT_M,
    LENGTH_M,
    PAINTS,
    WIDTH_M,
    car,
    picture,
    write_obj,
)

Y_UP = np.array([[0.0, 1.0, 0.0], [0.0, 0.0, 1.0], [1.0, 0.0, 0.0]])


def colour_at(mesh: SourceMesh, x: float, y: float, z_above: float) -> np.ndarray:
    """Colour in bytes of the highest surface below a point, by brute force over the triangles."""
    best, found = -np.inf, np.full(3, np.nan)
    for face, (a, b, c) in enumerate(mesh.corners):
        across = np.array([b - a, c - a])[:, :2].T
        if abs(np.linalg.det(across)) < 1e-9:
            continue
        u, v = np.linalg.solve(across, np.array([x, y]) - a[:2])
        z = a[2] + u * (b - a)[2] + v * (c - a)[2]
        if min(u, v, 1 - u - v) >= 0 and best < z < z_above:
            best = z
            found = mesh.look(np.array([face]), np.array([[1 - u - v, u, v]]))[0][0] * 255
    return found


def expected_paint(x: float, y: float) -> tuple[int, int, int]:
    return PAINTS[f"{'front' if x > 0 else 'rear'} {'left' if y > 0 else 'right'}"]


def linear_bytes(srgb: tuple[float, ...]) -> list[int]:
    """The bytes of linear light that glTF has for a colour in [0, 1]."""
    light = [c / 12.92 if c <= 0.04045 else ((c + 0.055) / 1.055) ** 2.4 for c in srgb]
    return [round(255 * value) for value in light]


def write_glb(path: Path) -> Path:
    """GLB, whose plain colours are linear."""
    scene = car(Y_UP)
    for geometry in scene.geometry.values():
        if geometry.visual.material.image is None:
            srgb = tuple(value / 255 for value in geometry.visual.material.diffuse[:3].tolist())
            geometry.visual.material.diffuse = [*linear_bytes(srgb), 255]
        else:
            geometry.visual.material.diffuse = [255, 255, 255, 255]
    scene.export(path)
    return path


def files(folder: Path) -> dict[str, Path]:
    return {
        "obj": write_obj(folder / "obj"),
        "glb": write_glb(folder / "car.glb"),
    }


@pytest.mark.parametrize("kind", ["obj", "glb"])
def test_every_format_gives_the_same_car(tmp_path: Path, kind: str) -> None:
    mesh, facts = orient(read_mesh(files(tmp_path)[kind]))
    extent = np.ptp(mesh.corners.reshape(-1, 3), axis=0)
    assert extent.tolist() == pytest.approx([LENGTH_M, WIDTH_M, HEIGHT_M], abs=1e-3)
    assert mesh.corners[..., 2].min() == pytest.approx(0.0)
    assert (facts["up"], facts["forward"]) == (("z", "x") if kind == "obj" else ("y", "z"))
    for x, y in ((2.0, 0.7), (2.0, -0.7), (-2.1, 0.7), (-2.1, -0.7)):
        assert colour_at(mesh, x, y, 1.0) == pytest.approx(expected_paint(x, y), abs=1.5), (x, y)
    # The windscreen.
    # Dark linear colours have few bytes.
    assert colour_at(mesh, 0.6, 0.0, 2.0) == pytest.approx(
        [255 * value for value in GLASS], abs=3.0 if kind == "glb" else 1.5
    )
    assert any("objects were joined" in note for note in mesh.notes)


def test_axes_are_turned_not_mirrored(tmp_path: Path) -> None:
    """Whichever way the car lies, front left stays front left; what is given beats a guess."""
    for turn, up, forward in (
        (np.diag([-1.0, -1.0, 1.0]), "z", "-x"),
        (np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]]), "z", "y"),
        (np.array([[0.0, 1.0, 0.0], [0.0, 0.0, -1.0], [-1.0, 0.0, 0.0]]), "-y", "-z"),
    ):
        assert np.linalg.det(turn) == pytest.approx(1.0)
        path = write_obj(tmp_path / f"{up}{forward}", car(turn))
        guessed = up == "z"
        mesh, facts = orient(
            read_mesh(path), up=None if guessed else up, forward=None if guessed else forward
        )
        assert (facts["up"], facts["forward"]) == (up, forward)
        for x, y in ((2.0, 0.7), (-2.1, 0.7), (-2.1, -0.7)):
            assert colour_at(mesh, x, y, 1.0) == pytest.approx(expected_paint(x, y), abs=1.5)
    with pytest.raises(ConfigurationError, match="one axis"):
        orient(read_mesh(path), up="z", forward="-z")


def test_a_mesh_of_another_size_is_refused_with_a_scale_that_fits(tmp_path: Path) -> None:
    path = write_obj(tmp_path, car(unit=0.0254))
    with pytest.raises(ConfigurationError, match=r"173 x 70\.\d x 59\.\d m") as caught:
        orient(read_mesh(path))
    scale = float(re.search(r"--wrapping.scale ([\d.]+) would", str(caught.value)).group(1))
    assert scale == 0.0254
    orient(read_mesh(path), scale=scale)
    with pytest.raises(ConfigurationError, match="not a vehicle's size"):
        orient(read_mesh(path), scale=0.001)


def test_textures_are_looked_for_by_name(tmp_path: Path) -> None:
    mesh = tmp_path / "models/bus/meshes/bus.obj"
    near, far = (
        tmp_path / "models/bus/materials/textures/Bus.PNG",
        tmp_path / "models/suv/materials/textures/w.png",
    )
    for path in (mesh, near, far):
        path.parent.mkdir(parents=True, exist_ok=True)
        path.touch()
    assert find_texture(mesh, "bus.png") == near
    assert find_texture(mesh, r"C:\work\bus.png") == near
    assert find_texture(mesh, "model://suv/materials/textures/w.png") == far
    assert find_texture(mesh, "w.png") is None
    # Of other models only textures, and none of what lies two folders above any mesh.
    other = tmp_path / "models/suv/private.png"
    other.touch()
    assert find_texture(mesh, "model://suv/private.png") is None
    loose = tmp_path / "models/bus/loose/bus.obj"
    loose.parent.mkdir()
    assert find_texture(loose, "model://suv/materials/textures/w.png") is None


def test_a_missing_texture_and_missing_uvs_are_logged(tmp_path: Path) -> None:
    path = write_obj(tmp_path / "one")
    (path.parent / "paint_body.png").unlink()
    mesh = read_mesh(path)
    assert any("paint_body.png was not found" in note for note in mesh.notes)
    elsewhere = tmp_path / "textures" / "paint_body.png"
    elsewhere.parent.mkdir()
    picture().save(elsewhere)
    assert any(f"{elsewhere} was taken" in note for note in read_mesh(path).notes)
    bare = tmp_path / "bare.obj"
    car().to_geometry().export(bare, include_texture=False, include_normals=False)
    mesh = read_mesh(bare)
    assert all(material.picture is None for material in mesh.materials)
    assert all(material.plain for material in mesh.materials)
    assert np.isfinite(mesh.look(np.array([0]), np.full((1, 3), 1 / 3))[0]).all()


@pytest.mark.parametrize("far", [1e19, 1e30, -1e300, math.inf, math.nan])
def test_coordinates_far_outside_a_picture_are_read_inside_it(tmp_path: Path, far: float) -> None:
    mesh = read_mesh(write_obj(tmp_path / "one"))
    mesh.uvs[0, :, 1] = far
    colours, alpha = mesh.look(np.array([0]), np.full((1, 3), 1 / 3))
    assert colours.shape == (1, 3)
    assert alpha.shape == (1,)


def test_a_missing_material_file_is_noted_and_its_names_are_kept(tmp_path: Path) -> None:
    path = write_obj(tmp_path)
    (tmp_path / "material.mtl").unlink()
    mesh = read_mesh(path)
    assert any("material.mtl was not found" in note for note in mesh.notes)
    # There are UVs, but trimesh's picture in place of a texture is none of the car's.
    assert all(material.plain and material.picture is None for material in mesh.materials)
    assert {name_part(material.name) for material in mesh.materials} == {
        Part.WHEEL,
        Part.GLASS,
        None,
    }


def test_uvs_without_any_material_are_plain(tmp_path: Path) -> None:
    path = write_obj(tmp_path)
    lines = path.read_text().splitlines()
    path.write_text("\n".join(each for each in lines if not each.startswith(("mtllib", "usemtl"))))
    assert all(material.plain for material in read_mesh(path).materials)


@pytest.mark.parametrize(
    ("named", "content", "said"),
    [
        ("paint_body.png", b"no picture", "paint_body.png cannot be read as a picture"),
        ("paint_body.dds", None, "paint_body.dds was not found"),
        ("paint_body", b"no picture", "paint_body cannot be read as a picture"),
    ],
)
def test_a_texture_that_shows_nothing_is_noted(
    tmp_path: Path, named: str, content: bytes | None, said: str
) -> None:
    path = write_obj(tmp_path)
    (tmp_path / "paint_body.png").unlink()
    materials = tmp_path / "material.mtl"
    materials.write_text(materials.read_text().replace("paint_body.png", named))
    if content is not None:
        (tmp_path / named).write_bytes(content)
    assert any(said in note for note in read_mesh(path).notes)


@pytest.mark.parametrize("written", ["d 0.2", "Tr 0.8"])
def test_an_obj_says_opacity_or_transparency(tmp_path: Path, written: str) -> None:
    path = write_obj(tmp_path)
    materials = tmp_path / "material.mtl"
    glass = "newmtl window_glass"
    materials.write_text(materials.read_text().replace(glass, f"{glass}\n{written}"))
    (found,) = (each.opacity for each in read_mesh(path).materials if "glass" in each.name)
    assert found == pytest.approx(0.2)


def test_a_gltf_texture_is_tinted_in_linear_light_and_opaque_unless_said(tmp_path: Path) -> None:
    picture = Image.new("RGBA", (8, 8), (188, 188, 188, 0))
    material = PBRMaterial(baseColorTexture=picture, baseColorFactor=[128, 255, 0, 255])
    mesh = trimesh.creation.box((4.4, 1.8, 1.5))
    mesh.visual = TextureVisuals(uv=np.zeros((8, 2)), material=material)
    for mode, alpha in ((None, 1.0), ("MASK", 0.0)):
        material.alphaMode = mode
        mesh.export(tmp_path / "box.glb")
        seen, alphas = read_mesh(tmp_path / "box.glb").look(np.array([3]), np.full((1, 3), 1 / 3))
        # Half of half of the light is 137.
        assert (seen[0] * 255).tolist() == pytest.approx([137, 188, 0], abs=1.0)
        assert alphas.tolist() == [alpha]


def test_vertex_colours_are_taken(tmp_path: Path) -> None:
    mesh = trimesh.creation.box((4.4, 1.8, 1.5))
    mesh.visual.vertex_colors = np.tile([10, 200, 30, 255], (8, 1))
    mesh.export(tmp_path / "box.ply")
    read = read_mesh(tmp_path / "box.ply")
    assert (read.look(np.array([3]), np.array([[0.2, 0.3, 0.5]]))[0] * 255).tolist() == [
        pytest.approx([10, 200, 30])
    ]


@pytest.mark.parametrize("kind", ["vertices", "material"])
def test_plain_colours_of_gltf_are_linear(tmp_path: Path, kind: str) -> None:
    mesh = trimesh.creation.box((4.4, 1.8, 1.5))
    if kind == "vertices":
        mesh.visual.vertex_colors = np.tile([55, 0, 255, 255], (8, 1))
    else:
        material = PBRMaterial(baseColorFactor=[55, 0, 255, 255])
        mesh.visual = TextureVisuals(uv=np.zeros((8, 2)), material=material)
    mesh.export(tmp_path / "box.glb")
    read = read_mesh(tmp_path / "box.glb")
    seen = read.look(np.array([3]), np.array([[0.2, 0.3, 0.5]]))[0][0] * 255
    # A fifth of the light is half of sRGB.
    assert seen.tolist() == pytest.approx([128, 0, 255], abs=1.0)


@pytest.mark.parametrize(
    "what", ["missing", "text", "points", "empty", "cut", "flat", "no numbers"]
)
def test_what_is_no_mesh_is_named_in_one_sentence(
    tmp_path: Path, what: str, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / {"text": "car.obj", "cut": "car.glb"}.get(what, "car.ply")
    if what == "text":
        path.write_text("hello\n")
    elif what == "points":
        trimesh.PointCloud(np.random.default_rng(0).uniform(size=(20, 3))).export(path)
    elif what == "empty":
        path.touch()
    elif what == "cut":
        car(Y_UP).export(path)
        path.write_bytes(path.read_bytes()[:500])
    elif what == "flat":
        trimesh.Trimesh(np.zeros((3, 3)), [[0, 1, 2]], process=False).export(path)
    elif what == "no numbers":
        nowhere = np.where(np.eye(3), np.nan, 1.0)
        trimesh.Trimesh(nowhere, [[0, 1, 2]], process=False).export(path)
    assert run(["vehicles", str(path), "--out", str(tmp_path / "out")]) == 2
    error = capsys.readouterr().err
    assert error.count("\n") == 1
    assert str(path) in error
    assert "Traceback" not in error
    assert not (tmp_path / "out").exists()


def test_wrong_options_are_named(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    mesh = str(write_obj(tmp_path / "mesh"))
    out = ["--out", str(tmp_path / "out")]
    for words, expected in (
        (["--wrapping.scale", "1", "2"], "--wrapping.scale expects one value per mesh"),
        (["--wrapping.scale", "0"], "above 0"),
        (["--wrapping.names", "a", "b"], "--wrapping.names expects one value per mesh"),
        (["--wrapping.paintable", mesh], "cannot be read as a picture"),
    ):
        assert run(["vehicles", mesh, *out, *words]) == 2
        assert expected in capsys.readouterr().err


def test_inside_out_triangles_are_counted_and_turned(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("skyproof.vehicles.wrapping.views._PIXEL_M", 0.1)
    box = trimesh.creation.box((4.0, 1.8, 1.5))
    corners = np.asarray(box.vertices)[box.faces]
    assert look_around(corners).inverted == 0
    corners[:3] = corners[:3, ::-1]
    seen = look_around(corners)
    assert (seen.inverted, seen.seen) == (3, 12)
    assert ((seen.points * seen.normals).sum(1) > 0).all()  # outward, however they are wound


def test_names_say_parts() -> None:
    said = {
        name: name_part(name)
        for name in ("Wheels3", "Tyre_FL", "Windows", "head_lights", "Hybrid", "BodyPaint")
    }
    assert list(said.values()) == [Part.WHEEL, Part.WHEEL, Part.GLASS, Part.LIGHT, None, None]


def test_the_nearest_triangle_is_seen() -> None:
    """Against a solver per pixel and triangle."""
    corners = np.random.default_rng(0).uniform(-1, 1, (40, 3, 3))
    seen = parallel_view(corners, np.array([-1.0, -1.0]), 0.1, (20, 20))
    for row in range(20):
        for column in range(20):
            place = -1 + 0.1 * (np.array([column, row]) + 0.5)
            depths, weights = np.full(len(corners), np.inf), {}
            for face, (a, b, c) in enumerate(corners):
                u, v = np.linalg.solve(np.array([b - a, c - a])[:, :2].T, place - a[:2])
                if min(u, v, 1 - u - v) >= 0:
                    depths[face] = a[2] + u * (b - a)[2] + v * (c - a)[2]
                    weights[face] = (1 - u - v, u, v)
            expected = int(depths.argmin()) if np.isfinite(depths).any() else -1
            assert seen.face[row, column] == expected
            assert seen.weights[row, column] == pytest.approx(weights.get(expected, (0, 0, 0)))


def test_a_mesh_reads_no_file_outside_its_places(tmp_path: Path) -> None:
    mesh = tmp_path / "models/bus/meshes/bus.obj"
    secret = tmp_path / "home/secret.png"
    for path in (mesh, secret, tmp_path / "home/secret.mtl"):
        path.parent.mkdir(parents=True, exist_ok=True)
        path.touch()
    assert find_texture(mesh, str(secret)) is None
    assert find_texture(mesh, f"file://{secret}") is None
    assert find_texture(mesh, "../../../home/secret.png") is None
    assert find_texture(mesh, "../../../home/secret.mtl") is None
    assert find_texture(mesh, "model://../home/secret.png") is None
    (mesh.parent / "link.png").symlink_to(secret)
    assert find_texture(mesh, "link.png") is None
    assert find_texture(mesh, "a" * 5000) is None
    assert find_texture(mesh, "a\0.png") is None
    # Outside the mesh's folder pictures only.
    beside = tmp_path / "models/bus/textures/other.mtl"
    beside.parent.mkdir()
    beside.touch()
    assert find_texture(mesh, "../textures/other.mtl") is None
    assert find_texture(mesh, "other.mtl") is None


@pytest.mark.parametrize(
    ("name", "content", "said"),
    [
        (
            "car.gltf",
            '{"asset": {"version": "2.0"}, "accessors": [{"count": 1000000000000, '
            '"componentType": 5126, "type": "VEC3"}], "bufferViews": []}',
            r"accessors\[0\]\.count|accessors\[...\]\.count",
        ),
        (
            "car.gltf",
            '{"asset": {"version": "2.0"}, "nodes": [{"mesh": 0}, {"mesh": 0}], "meshes": '
            '[{"primitives": [{"attributes": {"POSITION": 0}}, {"attributes": {"POSITION": 0}}]}], '
            '"accessors": [{"count": 12000000, "componentType": 5126, "type": "VEC3"}]}',
            "unfolds to more than 150,000,000 numbers",
        ),
        ("car.zip", "PK", "none of the meshes that are read"),
        ("car.dae", "<COLLADA/>", "convert it, for instance to GLB"),
        ("car.urdf", "<robot/>", "none of the meshes that are read"),
    ],
)
def test_a_mesh_takes_no_memory_without_end(
    tmp_path: Path, name: str, content: str, said: str
) -> None:
    (tmp_path / name).write_text(content)
    with pytest.raises(ConfigurationError, match=said):
        read_mesh(tmp_path / name)


def test_a_compressed_mesh_is_called_so(tmp_path: Path) -> None:
    path = tmp_path / "small.gltf"
    required = '"extensionsRequired": ["KHR_draco_mesh_compression"]'
    path.write_text(f'{{"asset": {{"version": "2.0"}}, {required}}}')
    with pytest.raises(ConfigurationError, match=r"compressed \(Draco\).*without mesh compression"):
        read_mesh(path)


def test_corners_that_count_back_are_those_that_count_from_the_start(tmp_path: Path) -> None:
    """Two blocks, each with its own corners before its faces, as exporters stream them."""
    box = trimesh.creation.box((4.4, 1.8, 0.7))
    files: dict[str, list[str]] = {"start.obj": [], "back.obj": []}
    for block in range(2):
        for path, lines in files.items():
            lines += [f"v {x} {y} {z + block}" for x, y, z in box.vertices]
            lines += [f"vt {0.1 * place} {block}" for place in range(9)]
            lines += ["vn 0 0 1"]
            for face in box.faces:
                before = (8, 9, 1) if path == "back.obj" else (-8 * block, -9 * block, -block)
                names = ((c + 1, c + 2, 1) for c in face.tolist())
                signs = [
                    "/".join(
                        str(n - b - (path == "back.obj")) for n, b in zip(name, before, strict=True)
                    )
                    for name in names
                ]
                lines.append(" ".join(["f", *signs]))
    meshes = []
    for path, lines in files.items():
        (tmp_path / path).write_text("\r\n".join(lines).replace(" ", " \\\r\n", 1))
        meshes.append(read_mesh(tmp_path / path))
    assert "f -" in (tmp_path / "back.obj").read_text()
    for name in ("corners", "uvs"):
        assert np.array_equal(getattr(meshes[0], name), getattr(meshes[1], name))
    assert np.ptp(meshes[1].corners[..., 2]) == pytest.approx(1.7)
    (tmp_path / "far.obj").write_text("v 0 0 0\nv 1 0 0\nv 0 1 0\nf -1 -2 -4\n")
    with pytest.raises(ConfigurationError, match="a face names -4 of 3"):
        read_mesh(tmp_path / "far.obj")


@pytest.mark.parametrize(
    ("texture", "refused"),
    [
        ({"texCoord": 1}, True),
        ({"extensions": {"KHR_texture_transform": {"scale": [0.5, 0.5]}}}, True),
        ({"extensions": {"KHR_texture_transform": {"texCoord": 1}}}, True),
        ({"extensions": {"KHR_texture_transform": {"offset": [0, 0], "scale": [1, 1]}}}, False),
        ({"texCoord": 1, "extensions": {"KHR_texture_transform": {"texCoord": 0}}}, False),
    ],
)
@pytest.mark.parametrize("used", [True, False])
def test_a_gltf_texture_that_is_moved_is_refused(
    tmp_path: Path, texture: dict[str, Any], refused: bool, used: bool
) -> None:
    path = tmp_path / "car.gltf"
    material = PBRMaterial(baseColorTexture=picture())
    mesh = trimesh.creation.box((4.4, 1.8, 1.5))
    mesh.visual = TextureVisuals(uv=np.zeros((8, 2)), material=material)
    for name, content in trimesh.exchange.gltf.export_gltf(trimesh.Scene(mesh)).items():
        (tmp_path / ("car.gltf" if name == "model.gltf" else name)).write_bytes(content)
    gltf = json.loads(path.read_text())
    changed = json.loads(json.dumps(gltf["materials"][0]))
    changed["pbrMetallicRoughness"]["baseColorTexture"] |= texture
    gltf["materials"].append(changed)
    for part in (part for mesh in gltf["meshes"] for part in mesh["primitives"]):
        part["material"] = int(used)
    path.write_text(json.dumps(gltf))
    if refused and used:
        with pytest.raises(ConfigurationError, match="bake that into its first UVs"):
            read_mesh(path)
    else:
        assert len(read_mesh(path).corners) == 12


def _boxes(*boxes: tuple[tuple[float, float, float], tuple[float, float, float]]) -> np.ndarray:
    """Triangles of boxes, each by its sides and its middle."""
    made = [
        trimesh.creation.box(sides, trimesh.transformations.translation_matrix(middle))
        for sides, middle in boxes
    ]
    mesh = trimesh.util.concatenate(made)
    return np.asarray(mesh.vertices)[mesh.faces]


@pytest.mark.parametrize(
    "corners",
    [
        _boxes(((4.4, 0.02, 0.02), (0, 0, 0.75)), ((0.02, 1.8, 1.5), (0, 0, 0.75))),
        _boxes(((4.4, 0.02, 1.5), (0, -0.9, 0.75)), ((4.4, 0.02, 1.5), (0, 0.9, 0.75))),
        _boxes(((0.5, 0.4, 1.5), (-2.1, -0.7, 0.75)), ((0.5, 0.4, 1.5), (2.1, 0.7, 0.75))),
        _boxes(((0.4, 1.8, 1.2), (1.5, 0, 0.6)), ((2.6, 0.1, 0.1), (0, 0, 0.6))),
    ],
    ids=["bars", "walls", "posts", "beam"],
)
def test_what_has_no_body_is_refused(corners: np.ndarray) -> None:
    with pytest.raises(ConfigurationError, match="has no closed body"):
        wrap_surface(corners)


def test_very_many_triangles_are_looked_at_in_fewer_points(monkeypatch: pytest.MonkeyPatch) -> None:
    corners = np.random.default_rng(0).uniform(size=(10, 3, 3))
    assert len(_spread(corners)) == 780
    monkeypatch.setattr("skyproof.vehicles.wrapping.orientation._MOST_POINTS", 200)
    assert len(_spread(corners)) == 150
