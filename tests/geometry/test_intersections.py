"""Meshes that run through themselves, against cases counted by hand and an oracle; volume."""

import itertools

import numpy as np
import pytest
import torch

from skyproof.geometry.meshes import enclosed_volume_m3, self_intersections

# A cube [0, 1]^3, every side cut along a diagonal, counter-clockwise from outside.
CORNERS = torch.tensor(list(itertools.product((0.0, 1.0), repeat=3)))
CUBE = torch.tensor(
    [
        *([0, 1, 3], [0, 3, 2], [4, 6, 7], [4, 7, 5], [0, 4, 5], [0, 5, 1]),
        *([2, 3, 7], [2, 7, 6], [0, 2, 6], [0, 6, 4], [1, 5, 7], [1, 7, 3]),
    ]
)


def pair(first, second):
    """Two triangles without common vertices."""
    return torch.tensor([*first, *second], dtype=torch.float32), torch.tensor(
        [[0, 1, 2], [3, 4, 5]]
    )


FLOOR = [(0, 0, 0), (4, 0, 0), (0, 4, 0)]


@pytest.mark.parametrize(
    ("second", "count"),
    [
        ([(1, 1, -1), (1, 1, 1), (9, 9, 9)], 1),
        ([(1, 1, 1), (1, 1, 3), (9, 9, 9)], 0),
        ([(1, 1, 0), (1, 1, 3), (2, 1, 3)], 0),
        ([(-1, 1, -1), (-1, 1, 1), (5, 1, 0.25)], 1),
        ([(2, 0, 0), (9, -1, 1), (9, -1, -1)], 0),
        ([(1, 1, 0), (2, 1, 0), (1, 2, 0)], 0),
        ([(3, 3, -1), (3, 3, 1), (9, 9, 0)], 0),
        ([(1, 1, 0.001), (2, 1, -0.001), (1, 9, 5)], 1),
    ],
    ids=[
        "pierced",
        "above",
        "corner on it",
        "right across",
        "corner to edge",
        "flat on it",
        "past it",
        "barely",
    ],
)
def test_two_triangles(second, count):
    assert self_intersections(*pair(FLOOR, second)) == count
    assert self_intersections(*pair(second, FLOOR)) == count
    assert self_intersections(*pair(FLOOR[::-1], second)) == count


def test_neighbours_do_not_count_even_when_folded_through_each_other():
    # They share vertex 0; the second one's far edge goes through the first.
    points = torch.tensor([*FLOOR, (1, 1, -1), (1, 1, 1)], dtype=torch.float32)
    assert self_intersections(points, torch.tensor([[0, 1, 2], [0, 3, 4]])) == 0
    apart = torch.cat((points, torch.tensor([[0.1, 0.1, 0.0]])))
    assert self_intersections(apart, torch.tensor([[0, 1, 2], [5, 3, 4]])) == 1


def test_a_closed_mesh_touches_itself_everywhere_and_crosses_nowhere():
    assert self_intersections(CORNERS, CUBE) == 0


def two_cubes(shift):
    return torch.cat((CORNERS, CORNERS + torch.tensor(shift))), torch.cat((CUBE, CUBE + 8))


def brute_force(points, faces):
    """All pairs without a common vertex, by clipping the line of both planes to both triangles."""
    points, found = np.asarray(points, dtype=np.float64), 0
    for first, second in itertools.combinations(np.asarray(faces).tolist(), 2):
        if set(first) & set(second):
            continue
        a, b = points[first], points[second]
        normal_a, normal_b = np.cross(a[1] - a[0], a[2] - a[0]), np.cross(b[1] - b[0], b[2] - b[0])
        line = np.cross(normal_a, normal_b)
        spans = []
        for triangle, normal, origin in ((a, normal_b, b[0]), (b, normal_a, a[0])):
            height = (triangle - origin) @ normal
            crossings = [
                (p + (q - p) * hp / (hp - hq)) @ line
                for (p, hp), (q, hq) in itertools.combinations(
                    list(zip(triangle, height, strict=True)), 2
                )
                if hp * hq < 0
            ]
            spans.append((min(crossings, default=1.0), max(crossings, default=-1.0)))
        (low_a, high_a), (low_b, high_b) = spans
        found += low_a < high_a and low_b < high_b and max(low_a, low_b) < min(high_a, high_b)
    return found


def test_two_cubes_through_each_other():
    # The sides cross along a closed line of six segments; the diagonals cut some of these in two.
    points, faces = two_cubes((0.37, 0.41, 0.29))
    count = self_intersections(points, faces)
    assert count == brute_force(points, faces)
    assert 6 <= count <= 12 + 6
    assert self_intersections(*two_cubes((1.5, 0.0, 0.0))) == 0


def test_a_beam_through_a_plate_counts_all_its_sides():
    # A square beam, its 8 side triangles through one large triangle, its 4 end triangles clear of
    # it.
    beam = CORNERS * torch.tensor([0.2, 0.2, 2.0]) + torch.tensor([1.013, 1.007, -1.0])
    points = torch.cat((beam, torch.tensor(FLOOR, dtype=torch.float32)))
    assert self_intersections(points, torch.cat((CUBE, torch.tensor([[8, 9, 10]])))) == 8


def test_random_triangles_agree_with_the_oracle():
    generator = torch.Generator().manual_seed(4)
    points = torch.rand(60, 3, generator=generator)
    faces = torch.stack([torch.randperm(60, generator=generator)[:3] for _ in range(60)])
    count = brute_force(points, faces)
    assert count > 200
    assert self_intersections(points, faces) == count
    # Where a scene lies, and how large it is, does not matter.
    assert self_intersections(points.double() * 1e-3 + 2, faces) == count
    assert self_intersections(points.double() * 1e3, faces) == count


def test_a_mesh_without_faces_has_no_intersections():
    assert self_intersections(CORNERS, torch.zeros(0, 3, dtype=torch.long)) == 0


def test_the_volume_of_boxes_wherever_they_stand():
    # Far away float32 has few digits left for sums that are not taken around the middle.
    boxes = torch.stack(
        (CORNERS, CORNERS * torch.tensor([4.0, 2.0, 1.5]) + torch.tensor([9e3, -7e3, 3e3]))
    )
    assert enclosed_volume_m3(boxes, CUBE).tolist() == pytest.approx([1.0, 12.0], rel=1e-5)
    assert enclosed_volume_m3(boxes, CUBE.flip(1)).tolist() == pytest.approx(
        [-1.0, -12.0], rel=1e-5
    )


def test_the_volume_of_a_ball_from_its_rings():
    # Each slice between two rings is a frustum of a regular polygon: area * (r1^2 + r1 r2 + r2^2) *
    # h / 3.
    rings, columns = 20, 24
    polar = np.linspace(0, np.pi, rings + 1)[1:-1]
    around = 2 * np.pi * np.arange(columns) / columns
    points = [
        (np.sin(p) * np.cos(a), np.sin(p) * np.sin(a), np.cos(p)) for p in polar for a in around
    ]
    points += [(0.0, 0.0, 1.0), (0.0, 0.0, -1.0)]
    faces = []
    for c in range(columns):
        n, last = (c + 1) % columns, (rings - 2) * columns
        faces += [(len(points) - 2, c, n), (len(points) - 1, last + n, last + c)]
        for r in range(0, last, columns):
            faces += [(r + c, r + columns + c, r + columns + n), (r + c, r + columns + n, r + n)]
    radius, height = np.sin(np.r_[0, polar, np.pi]), np.cos(np.r_[0, polar, np.pi])
    polygon = columns / 2 * np.sin(2 * np.pi / columns)
    r1, r2 = radius[:-1], radius[1:]
    wanted = (polygon * (r1**2 + r1 * r2 + r2**2) * -np.diff(height) / 3).sum()
    volume = enclosed_volume_m3(torch.tensor(points)[None], torch.tensor(faces))
    assert float(volume) == pytest.approx(wanted, rel=1e-9)
    assert 0.93 < float(volume) / (4 / 3 * np.pi) < 1
