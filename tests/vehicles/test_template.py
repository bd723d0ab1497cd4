"""The template is a closed sphere whose mirror is a flip of the UV map."""

from collections import Counter

import torch

from skyproof.vehicles.template import COLUMNS, RINGS, make_template

TEMPLATE = make_template()


def _edges(triangles: torch.Tensor) -> Counter[tuple[int, int]]:
    return Counter((int(t[i]), int(t[(i + 1) % 3])) for t in triangles for i in range(3))


def test_sizes() -> None:
    assert TEMPLATE.faces.shape == (1984, 3)
    assert TEMPLATE.vertex_uvs.shape == (994, 2)
    assert TEMPLATE.uvs.shape == (31 * 33 + 64, 2)


def test_a_device_has_one_copy_by_which_buffers_know_it() -> None:
    assert TEMPLATE.to("meta").faces is TEMPLATE.to("meta").faces
    assert TEMPLATE.to("cpu").faces is TEMPLATE.faces


def test_every_edge_is_used_once_in_each_direction() -> None:
    edges = _edges(TEMPLATE.faces)
    assert set(edges.values()) == {1}
    assert all((b, a) in edges for a, b in edges)


def test_euler_characteristic_is_two() -> None:
    assert len(TEMPLATE.mirror) - len(_edges(TEMPLATE.faces)) // 2 + len(TEMPLATE.faces) == 2
    assert TEMPLATE.faces.unique().tolist() == list(range(994))


def test_mirror_is_an_involution_and_flips_u() -> None:
    mirror, uv = TEMPLATE.mirror, TEMPLATE.vertex_uvs
    assert torch.equal(mirror[mirror], torch.arange(994))
    flipped = torch.stack([(1 - uv[:, 0]) % 1, uv[:, 1]], dim=1)
    distance = (uv[mirror] - flipped).abs()
    assert torch.minimum(distance, (1 - distance).abs()).max() < 1e-6
    fixed = (mirror == torch.arange(994)).sum()
    assert fixed == 2 * RINGS + 2  # the two columns on the mid-plane, and the poles


def test_mirrored_triangles_are_triangles() -> None:
    faces = {tuple(sorted(face)) for face in TEMPLATE.faces.tolist()}
    assert {tuple(sorted(face)) for face in TEMPLATE.mirror[TEMPLATE.faces].tolist()} == faces


def test_uvs_are_in_range_and_all_triangles_turn_the_same_way() -> None:
    assert TEMPLATE.uvs.min() == 0
    assert TEMPLATE.uvs.max() == 1
    a, b, c = TEMPLATE.uvs[TEMPLATE.face_uvs].unbind(1)
    area = (b - a)[:, 0] * (c - a)[:, 1] - (b - a)[:, 1] * (c - a)[:, 0]
    assert (area < 0).all()
    # Only the saw teeth beside the poles are left out of the unit square.
    assert abs(float(-area.sum() / 2) - (1 - 1 / 32)) < 1e-5


def test_face_uvs_agree_with_vertex_uvs_up_to_the_seam() -> None:
    ring = TEMPLATE.faces < RINGS * COLUMNS
    difference = (TEMPLATE.uvs[TEMPLATE.face_uvs] - TEMPLATE.vertex_uvs[TEMPLATE.faces])[ring]
    assert difference[:, 1].abs().max() == 0
    assert set(difference[:, 0].tolist()) == {
        0.0,
        1.0,
    }  # 1 where the seam's vertices, at u = 0, are read at u = 1
