"""The rasteriser against a slow reference that loops over triangles and samples in plain Python."""

import math

import pytest
import torch

from skyproof.geometry.meshes import at_corners
from skyproof.geometry.projection import project
from skyproof.geometry.rasterise import rasterise, visible_faces
from tests.render.bodies import rounded_box, sphere_template


def face_areas(corners):
    a, b, c = corners
    (ux, uy), (vx, vy) = c - a, b - a
    return ux * vy - uy * vx


def how_many(keys):
    """How many samples see a triangle."""
    return int((visible_faces(keys) >= 0).sum())


def reference(screen, depth, faces, size):
    """Per sample (depth, face, distance to that face's nearest edge), or None; one vehicle."""
    points, depths = screen.double().tolist(), depth.double().tolist()
    seen = [[None] * size for _ in range(size)]
    # Samples that lie on an edge within rounding, whichever face the edge belongs to.
    doubtful = [[False] * size for _ in range(size)]
    for number, corners in enumerate(faces.tolist()):
        (ax, ay), (bx, by), (cx, cy) = (points[corner] for corner in corners)
        area = (cx - ax) * (by - ay) - (cy - ay) * (bx - ax)
        if area <= 1e-12:
            continue
        for row in range(
            max(math.floor(min(ay, by, cy)) - 1, 0), min(math.ceil(max(ay, by, cy)) + 1, size)
        ):
            for column in range(
                max(math.floor(min(ax, bx, cx)) - 1, 0), min(math.ceil(max(ax, bx, cx)) + 1, size)
            ):
                x, y = column + 0.5, row + 0.5
                weights, distances = [], []
                for (sx, sy), (ex, ey) in (
                    ((bx, by), (cx, cy)),
                    ((cx, cy), (ax, ay)),
                    ((ax, ay), (bx, by)),
                ):
                    twice = (x - sx) * (ey - sy) - (y - sy) * (ex - sx)
                    weights.append(twice / area)
                    distances.append(twice / max(math.hypot(ex - sx, ey - sy), 1e-12))
                if min(distances) > -1e-4 and min(abs(distance) for distance in distances) < 1e-4:
                    doubtful[row][column] = True
                if min(weights) < 0:
                    continue
                near = sum(
                    weight * depths[corner] for weight, corner in zip(weights, corners, strict=True)
                )
                if seen[row][column] is None or near < seen[row][column][0]:
                    seen[row][column] = (near, number)
    return seen, doubtful


def compare(screen, depth, faces, size):
    """Asserts that samples see what the reference sees; returns how many it compared, covered."""
    drawn = rasterise(screen, depth, faces, size)
    face = visible_faces(drawn).tolist()
    # A key holds the depth in 0.01 mm, counted from far before the viewer, above 31 bits.
    found = (((drawn >> 31) - (1 << 30)).double() / 1e5).tolist()
    compared = covered = 0
    for number in range(len(screen)):
        seen, doubtful = reference(screen[number], depth[number], faces, size)
        for row in range(size):
            for column in range(size):
                if doubtful[row][column]:
                    continue
                compared += 1
                expected = seen[row][column]
                where = f"vehicle {number}, row {row}, column {column}"
                if expected is None:
                    assert face[number][row][column] == -1, where
                    continue
                covered += 1
                assert face[number][row][column] == expected[1], where
                assert found[number][row][column] == pytest.approx(expected[0], abs=2e-5), where
    return compared, covered


def bumpy_body(rings, columns):
    """A body with hollows, so that front faces hide one another."""
    body = rounded_box(rings=rings, columns=columns, power=1.0)
    centre = body.mean(1, keepdim=True)
    offset = body - centre
    return centre + offset * (
        1 + 0.5 * torch.sin(3.0 * offset[..., :1] + 4.0 * offset[..., 1:2] + 1.0)
    )


def seen_from(body, *, azimuth, tilt, size, per_sample_m):
    direction = [
        math.sin(tilt) * math.cos(azimuth),
        math.sin(tilt) * math.sin(azimuth),
        math.cos(tilt),
    ]
    return project(body, torch.tensor([direction]), per_sample_m, size)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_two_bodies_match_the_reference_also_where_they_leave_the_window(dtype):
    faces = sphere_template(12, 14).faces
    first = seen_from(bumpy_body(12, 14), azimuth=0.4, tilt=1.2, size=64, per_sample_m=0.08)
    second = seen_from(bumpy_body(12, 14), azimuth=2.0, tilt=0.3, size=64, per_sample_m=0.08)
    screen = torch.cat((first[0], second[0] + torch.tensor([22.0, -24.0]))).to(dtype)
    assert screen[1, :, 0].max() > 64, "the second body was meant to reach out on the right"
    assert screen[1, :, 1].min() < 0, "and at the top"
    compared, covered = compare(screen, torch.cat((first[1], second[1])).to(dtype), faces, 64)
    assert compared > 8000
    assert covered > 800


def test_random_triangles_in_front_of_each_other_match_the_reference():
    generator = torch.Generator().manual_seed(5)
    middle = torch.rand(1, 60, 1, 2, generator=generator) * 60 - 6
    corners = middle + torch.randn(1, 60, 3, 2, generator=generator) * 9
    depth = torch.rand(1, 180, generator=generator) * 4 - 2
    compared, covered = compare(
        corners.reshape(1, 180, 2), depth, torch.arange(180).view(60, 3), 48
    )
    assert compared > 2200
    assert covered > 800


def test_slivers_thinner_than_a_sample_match_the_reference():
    generator = torch.Generator().manual_seed(6)
    start = torch.rand(1, 80, 1, 2, generator=generator) * 40
    along = torch.randn(1, 80, 1, 2, generator=generator) * 12
    thin = torch.randn(1, 80, 1, 2, generator=generator) * 0.3
    corners = torch.cat((start, start + along, start + 0.6 * along + thin), dim=2)
    depth = torch.rand(1, 240, generator=generator)
    _, covered = compare(corners.reshape(1, 240, 2), depth, torch.arange(240).view(80, 3), 40)
    assert covered > 50


def test_a_closed_convex_body_has_no_cracks():
    # The outline of a convex body is convex: in each row and column its samples follow one another
    # without a gap.
    template, body = sphere_template(), rounded_box(power=0.9)
    generator = torch.Generator().manual_seed(1)
    draws = torch.rand(12, 4, generator=generator).tolist()
    views = [
        seen_from(body, azimuth=6.28 * a, tilt=0.9 * t, size=150, per_sample_m=0.04)
        for a, t, _, _ in draws
    ]
    shifts = torch.tensor([[x, y] for _, _, x, y in draws])[:, None]
    screen, depth = (
        torch.cat([view[0] for view in views]) + shifts,
        torch.cat([view[1] for view in views]),
    )
    drawn = rasterise(screen, depth, template.faces, 150)
    held = visible_faces(drawn) >= 0
    assert held.flatten(1).sum(1).min() > 2000
    for axis in (1, 2):
        # A run of covered samples starts once.
        starts = held.int().diff(dim=axis).clamp(min=0).sum(axis)
        assert starts.max() == 1
    # What the samples count is what the triangles cover.
    areas = face_areas(at_corners(screen, template.faces)).view(len(screen), -1)
    area = areas.clamp(min=0).sum(1) / 2
    assert held.flatten(1).sum(1) / area == pytest.approx(1.0, abs=0.005)


def test_a_triangle_seen_from_behind_is_not_drawn():
    screen = torch.tensor([[[2.0, 2.0], [2.0, 14.0], [14.0, 2.0]]])
    counter_clockwise = torch.tensor([[0, 1, 2]])
    assert how_many(rasterise(screen, torch.zeros(1, 3), counter_clockwise, 16)) > 50
    assert how_many(rasterise(screen, torch.zeros(1, 3), counter_clockwise.flip(1), 16)) == 0


@pytest.mark.parametrize("nearer", [0, 1])
def test_the_nearer_of_two_triangles_is_seen_whatever_their_order(nearer):
    square = torch.tensor([[2.0, 2.0], [2.0, 14.0], [14.0, 2.0]])
    screen = torch.cat((square, square))[None]
    depth = torch.tensor([[1.0, 1.0, 1.0, 1.0, 1.0, 1.0]])
    depth[0, 3 * nearer : 3 * nearer + 3] = 0.99
    drawn = rasterise(screen, depth, torch.tensor([[0, 1, 2], [3, 4, 5]]), 16)
    assert visible_faces(drawn).unique().tolist() == [-1, nearer]


def test_bodies_outside_their_window_draw_nothing():
    faces = sphere_template(5, 6).faces
    screen, depth = seen_from(
        rounded_box(rings=5, columns=6), azimuth=0.0, tilt=0.2, size=32, per_sample_m=0.2
    )
    for shift in ([100.0, 0.0], [-100.0, 0.0], [0.0, 100.0], [0.0, -100.0]):
        assert how_many(rasterise(screen + torch.tensor(shift), depth, faces, 32)) == 0


def test_two_sided_drawing_does_not_ask_how_triangles_are_wound():
    template, body = sphere_template(9, 10), rounded_box(rings=9, columns=10)
    screen, depth = seen_from(body, azimuth=0.7, tilt=0.6, size=64, per_sample_m=0.08)
    generator = torch.Generator().manual_seed(2)
    turned = torch.rand(len(template.faces), generator=generator) < 0.5
    wound_at_random = torch.where(turned[:, None], template.faces.flip(1), template.faces)
    closed = rasterise(screen, depth, template.faces, 64)
    drawn = rasterise(screen, depth, wound_at_random, 64, two_sided=True)
    # Of a closed body the insides lie behind the outsides; at its outline rounding decides.
    assert how_many(closed) > 300
    assert (visible_faces(drawn) != visible_faces(closed)).sum() <= 2
    assert how_many(rasterise(screen, depth, wound_at_random, 64)) < how_many(closed)


def test_two_sided_triangles_match_the_reference_of_the_same_triangles_turned_round():
    generator = torch.Generator().manual_seed(7)
    middle = torch.rand(1, 40, 1, 2, generator=generator) * 40
    screen = (middle + torch.randn(1, 40, 3, 2, generator=generator) * 9).reshape(1, 120, 2)
    depth = torch.rand(1, 120, generator=generator)
    faces = torch.arange(120).view(40, 3)
    areas = face_areas(at_corners(screen, faces))
    assert 10 < int((areas < 0).sum()) < 30
    outwards = torch.where((areas < 0)[:, None], faces.flip(1), faces)
    compared, covered = compare(screen, depth, outwards, 40)
    assert compared > 1300
    assert covered > 800
    same = rasterise(screen, depth, faces, 40, two_sided=True)
    turned = rasterise(screen, depth, outwards, 40)
    assert torch.equal(visible_faces(same), visible_faces(turned))


def test_more_faces_than_sixteen_bits_count():
    # Tiny triangles in rows, one at every second sample.
    count = 70_000
    number = torch.arange(count)
    place = torch.stack((number % 300, number // 300), dim=1) + 0.5
    corners = place[:, None] + torch.tensor([[-0.3, -0.3], [-0.3, 0.3], [0.4, 0.0]])
    screen, faces = corners.view(1, -1, 2), torch.arange(3 * count).view(-1, 3)
    seen = visible_faces(rasterise(screen, torch.zeros(1, 3 * count), faces, 300)).flatten()
    assert torch.equal(seen[:count], number)
    assert set(seen[count:].tolist()) == {-1}
