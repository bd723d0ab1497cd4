"""Colour, projection and mesh mathematics against formulas worked by hand."""

import math

import pytest
import torch

from skyproof.geometry.colour import linear_to_srgb, srgb_to_linear
from skyproof.geometry.meshes import mesh_edges, vertex_normals
from skyproof.geometry.projection import project, rotate_about_vertical
from skyproof.scenes.scene import Camera, Sun
from tests.render.bodies import rounded_box, sphere_template


def seen_by(points, tilt_deg, azimuth_deg, gsd_m=0.125, size_px=100):
    camera = Camera(math.radians(tilt_deg), math.radians(azimuth_deg), gsd_m, size_px)
    direction = torch.tensor([camera.direction], dtype=torch.float64)
    return project(torch.tensor([points], dtype=torch.float64), direction, gsd_m, size_px)


def test_srgb_and_linear_light_invert_each_other():
    values = torch.linspace(0, 1, 1001, dtype=torch.float64)
    torch.testing.assert_close(linear_to_srgb(srgb_to_linear(values)), values, atol=1e-7, rtol=0)


def test_srgb_has_the_standards_values():
    # IEC 61966-2-1: the straight piece near black, and middle grey.
    assert srgb_to_linear(torch.tensor(0.04)).item() == pytest.approx(0.04 / 12.92, rel=1e-6)
    assert srgb_to_linear(torch.tensor(0.5)).item() == pytest.approx(0.21404, abs=1e-5)
    assert linear_to_srgb(torch.tensor([-1.0, 2.0])).tolist() == pytest.approx([0.0, 1.0])


def test_colour_gradients_are_right_and_finite_at_black():
    values = torch.tensor([0.001, 0.02, 0.3, 0.9], dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(srgb_to_linear, values)
    assert torch.autograd.gradcheck(linear_to_srgb, values)
    black = torch.zeros(3, requires_grad=True)
    (linear_to_srgb(black) + srgb_to_linear(black)).sum().backward()
    assert torch.isfinite(black.grad).all()


def test_east_is_right_and_north_is_up():
    place, _ = seen_by([[0, 0, 0], [1, 0, 0], [0, 1, 0]], tilt_deg=0, azimuth_deg=0)
    assert place[0].tolist() == [[50, 50], [58, 50], [50, 42]]


@pytest.mark.parametrize("tilt_deg", [0, 7, 20])
@pytest.mark.parametrize("azimuth_deg", [0, 100, 250])
def test_ground_points_stay_where_they_are_whatever_the_tilt(tilt_deg, azimuth_deg):
    points = [[0, 0, 0], [3.3, -2.1, 0], [-5, 1, 0]]
    leaning, upright = seen_by(points, tilt_deg, azimuth_deg)[0], seen_by(points, 0, 0)[0]
    torch.testing.assert_close(leaning, upright, atol=1e-9, rtol=0)


@pytest.mark.parametrize(
    ("azimuth_deg", "away"), [(0, (-1, 0)), (90, (0, 1)), (180, (1, 0)), (270, (0, -1))]
)
def test_height_leans_away_from_the_camera_by_height_times_the_tangent_of_the_tilt(
    azimuth_deg, away
):
    # A camera in the east (0 degrees) sees a roof displaced to the west, which is left in the
    # image.
    place, _ = seen_by([[0, 0, 1.6]], tilt_deg=20, azimuth_deg=azimuth_deg)
    lean_px = 1.6 * math.tan(math.radians(20)) / 0.125
    expected = [50 + away[0] * lean_px, 50 + away[1] * lean_px]
    assert place[0, 0].tolist() == pytest.approx(expected, abs=1e-9)


def test_what_is_nearer_to_the_camera_has_the_smaller_depth():
    _, depth = seen_by([[0, 0, 0], [0, 0, 1], [2, 0, 0], [-2, 0, 0]], tilt_deg=15, azimuth_deg=0)
    ground, roof, east, west = depth[0].tolist()
    assert roof < ground
    assert east < ground < west
    assert ground - roof == pytest.approx(math.cos(math.radians(15)))


def test_camera_and_sun_point_at_their_azimuth_and_height():
    assert Camera(math.radians(20), math.radians(90), 0.1, 8).direction == pytest.approx(
        (0, math.sin(math.radians(20)), math.cos(math.radians(20)))
    )
    assert Sun(math.pi, math.radians(30)).direction == pytest.approx(
        (-math.cos(math.pi / 6), 0, 0.5)
    )


def test_turning_goes_from_east_to_north():
    turned = rotate_about_vertical(
        torch.tensor([[[1.0, 0.0, 5.0]], [[0.0, 1.0, 5.0]]]), torch.tensor([math.pi / 2] * 2)
    )
    torch.testing.assert_close(
        turned, torch.tensor([[[0.0, 1.0, 5.0]], [[-1.0, 0.0, 5.0]]]), atol=1e-6, rtol=0
    )


def test_normals_of_a_sphere_point_away_from_its_middle():
    sphere = rounded_box(2.0, 2.0, 2.0, power=1.0).double()
    outward = torch.nn.functional.normalize(sphere - torch.tensor([0.0, 0.0, 1.0]), dim=-1)
    normals = vertex_normals(sphere, sphere_template().faces)
    assert (normals * outward).sum(-1).min() > 0.999
    torch.testing.assert_close(
        normals.norm(dim=-1), torch.ones(1, normals.shape[1], dtype=torch.float64)
    )


def test_every_edge_of_a_closed_mesh_is_found_once_with_its_two_faces():
    faces = sphere_template(4, 6).faces
    edges, edge_faces = mesh_edges(faces)
    assert len(edges) == len(faces) * 3 // 2
    assert len({tuple(sorted(edge)) for edge in edges.tolist()}) == len(edges)
    for (start, end), (first, second) in zip(edges.tolist(), edge_faces.tolist(), strict=True):
        forward, backward = faces[first].tolist(), faces[second].tolist()
        assert forward[(forward.index(start) + 1) % 3] == end
        assert backward[(backward.index(end) + 1) % 3] == start


def test_an_open_mesh_is_refused():
    with pytest.raises(ValueError, match="closed mesh"):
        mesh_edges(sphere_template(4, 6).faces[1:])
