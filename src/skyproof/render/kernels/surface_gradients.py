"""Gradients of what vehicles show, in their textures, corners and silhouettes.

A moving silhouette covers more or less of a pixel, unseen by sampling. The exact derivative of an
area-sampled picture is the integral, along its silhouettes, of the colour inside less the colour
outside times the edge's outward speed (`silhouettes_back`).
"""

import warp as wp

from skyproof.geometry.triangles import NOTHING, cross2, depth_of, face_of
from skyproof.render.kernels.light import SurfaceLight, weighted_radiance
from skyproof.render.kernels.surface import (
    Bilinear,
    Mesh,
    Paint,
    albedo_of,
    sample_at,
    sample_colour,
    texels_around,
    uv_at,
    weights_at,
)
from skyproof.render.kernels.texture import Pyramid

# Samples. A sample that happens to hit a sliver of width w has a derivative of order 1/w: right on
# average, but a single hit outweighs the whole body. Below this width the derivative is held at
# what this width would give.
_THINNEST = 0.1


@wp.func
def add_texels(to_texels: wp.array(dtype=wp.vec3), at: Bilinear, value: wp.vec3):
    """Adds a value's gradient to the four texels that it was read from."""
    upper = value * (1.0 - at.down)
    lower = value * at.down
    wp.atomic_add(to_texels, at.places[0], upper * (1.0 - at.across))
    wp.atomic_add(to_texels, at.places[1], upper * at.across)
    wp.atomic_add(to_texels, at.places[2], lower * (1.0 - at.across))
    wp.atomic_add(to_texels, at.places[3], lower * at.across)


@wp.kernel(enable_backward=False)
def shade_back_to_texels(
    mesh: Mesh,
    paint: Paint,
    factor: int,
    reached: wp.array3d(dtype=wp.vec3),
    gradient: wp.array3d(dtype=wp.vec4),
    to_texels: wp.array(dtype=wp.vec3),
    parts: int,
):
    """Gradient of the texels: the light that reached each sample, times that of its pixel."""
    vehicle, row, part = wp.tid()
    for column in range(part, gradient.shape[2], parts):
        given = gradient[vehicle, row, column]
        weight = wp.vec3(given[0], given[1], given[2]) / float(factor * factor)
        if wp.dot(weight, weight) != 0.0:
            for y in range(row * factor, (row + 1) * factor):
                for x in range(column * factor, (column + 1) * factor):
                    key = mesh.keys[vehicle, y, x]
                    if key != NOTHING:
                        face = face_of(key)
                        weights = weights_at(mesh, vehicle, face, x, y)
                        uv = uv_at(mesh, face, weights)
                        at = texels_around(paint.pyramid, vehicle, uv, mesh.levels[vehicle, face])
                        add_texels(to_texels, at, wp.cw_mul(weight, reached[vehicle, y, x]))


@wp.func
def point_gradient(mesh: Mesh, vehicle: int, corner: wp.vec3i, to_weights: wp.vec3):
    """Gradient of a point in a triangle from that of its weights, held where it is thin."""
    a = mesh.screen[vehicle, corner[0]]
    to_b = mesh.screen[vehicle, corner[1]] - a
    to_c = mesh.screen[vehicle, corner[2]] - a
    area = cross2(to_c, to_b)
    longest = wp.max(wp.length(to_b), wp.max(wp.length(to_c), wp.length(to_c - to_b)))
    kept = wp.min(area / longest / _THINNEST, 1.0)
    second = wp.vec2(-to_c[1], to_c[0]) * (to_weights[1] - to_weights[0])
    third = wp.vec2(to_b[1], -to_b[0]) * (to_weights[2] - to_weights[0])
    return (second + third) * (kept / area)


@wp.func
def albedo_slopes(pyramid: Pyramid, at: Bilinear):
    """How reflectance changes along u and v."""
    left, right = pyramid.texels[at.places[0]], pyramid.texels[at.places[1]]
    below, opposite = pyramid.texels[at.places[2]], pyramid.texels[at.places[3]]
    per_u = wp.lerp(right - left, opposite - below, at.down)
    return per_u * at.side, wp.lerp(below - left, opposite - right, at.across) * at.side


@wp.func
def add_corners(
    mesh: Mesh,
    paint: Paint,
    vehicle: int,
    face: int,
    weights: wp.vec3,
    weight: wp.vec3,
    to_screen: wp.array2d(dtype=wp.vec2),
    to_normals: wp.array2d(dtype=wp.vec3),
):
    """Adds the gradient of one sample's weighted light to its triangle's corners and normals."""
    corner = mesh.faces[face]
    seen = sample_at(mesh, paint, vehicle, face, weights)
    per_u, per_v = albedo_slopes(paint.pyramid, seen.texels)
    albedo, light = albedo_of(paint.pyramid, seen.texels), paint.lights[vehicle]
    to_normal, to_albedo, _sunlit, _gloss, _light, _weight = wp.grad(weighted_radiance)(
        seen.normal, albedo, seen.sunlit, seen.gloss, light, weight
    )
    to_uv = wp.vec2(wp.dot(to_albedo, per_u), wp.dot(to_albedo, per_v))
    to_mean = (to_normal - seen.normal * wp.dot(seen.normal, to_normal)) / seen.length
    to_weights = wp.vec3()
    for each in range(3):
        to_weights[each] = wp.dot(to_uv, mesh.uvs[face, each])
        to_weights[each] += wp.dot(to_mean, mesh.normals[vehicle, corner[each]])
        wp.atomic_add(to_normals, vehicle, corner[each], to_mean * weights[each])
    to_point = point_gradient(mesh, vehicle, corner, to_weights)
    # A corner that moves by d acts as the point that moves by -weight * d.
    for each in range(3):
        wp.atomic_add(to_screen, vehicle, corner[each], -weights[each] * to_point)


@wp.kernel(enable_backward=False)
def shade_back_to_corners(
    mesh: Mesh,
    paint: Paint,
    factor: int,
    gradient: wp.array3d(dtype=wp.vec4),
    to_screen: wp.array2d(dtype=wp.vec2),
    to_normals: wp.array2d(dtype=wp.vec3),
    parts: int,
):
    """Gradient of the visible triangles' corners and normals, for a fixed set of samples."""
    vehicle, row, part = wp.tid()
    for column in range(part, gradient.shape[2], parts):
        given = gradient[vehicle, row, column]
        weight = wp.vec3(given[0], given[1], given[2]) / float(factor * factor)
        if wp.dot(weight, weight) != 0.0:
            for y in range(row * factor, (row + 1) * factor):
                for x in range(column * factor, (column + 1) * factor):
                    key = mesh.keys[vehicle, y, x]
                    if key != NOTHING:
                        face = face_of(key)
                        at = weights_at(mesh, vehicle, face, x, y)
                        add_corners(mesh, paint, vehicle, face, at, weight, to_screen, to_normals)


@wp.func
def shows_outside(screen: wp.array2d(dtype=wp.vec2), vehicle: int, corner: wp.vec3i):
    """Whether a triangle is seen from outside."""
    a = screen[vehicle, corner[0]]
    return cross2(screen[vehicle, corner[2]] - a, screen[vehicle, corner[1]] - a) > 0.0


@wp.kernel(enable_backward=False)
def silhouettes_back(
    mesh: Mesh,
    paint: Paint,
    screen: wp.array2d(dtype=wp.vec2),
    keys: wp.array3d(dtype=wp.int64),
    shadow: bool,
    edges: wp.array(dtype=wp.vec2i),
    edge_faces: wp.array(dtype=wp.vec2i),
    factor: int,
    gradient: wp.array3d(dtype=wp.vec4),
    to_screen: wp.array2d(dtype=wp.vec2),
):
    """Gradient of moving silhouettes: colour inside less that outside, times the area swept.

    Silhouettes are edges between a face towards the viewer and one that faces away. They are cut
    into pieces at most a sample long, each with a point in its middle. A piece is visible if the
    sample just outside it is farther than the edge, or empty. The colour inside is that of its own
    triangle at the edge, because the nearest sample inside a thin triangle may show something else.
    For a `shadow` only the ground behind an edge counts, not the vehicle's parts behind it.
    """
    vehicle, edge = wp.tid()
    pair = edge_faces[edge]
    forward = shows_outside(screen, vehicle, mesh.faces[pair[0]])
    if forward == shows_outside(screen, vehicle, mesh.faces[pair[1]]):
        return
    # Walking the edge as the front face does (counter-clockwise, y down) keeps it on the left.
    ends = edges[edge]
    start_vertex = wp.where(forward, ends[0], ends[1])
    end_vertex = wp.where(forward, ends[1], ends[0])
    face = wp.where(forward, pair[0], pair[1])
    start = screen[vehicle, start_vertex]
    whole = screen[vehicle, end_vertex] - start
    pieces = wp.max(int(wp.ceil(wp.length(whole))), 1)
    outward = wp.vec2(-whole[1], whole[0]) / float(pieces)
    unit = outward / (wp.length(outward) + 1.0e-12)
    size = keys.shape[1]
    pixels = size / factor
    corner = mesh.faces[face]
    for piece in range(pieces):
        along = (float(piece) + 0.5) / float(pieces)
        point = start + whole * along
        x = int(wp.floor(point[0] + unit[0]))
        y = int(wp.floor(point[1] + unit[1]))
        if x >= 0 and y >= 0 and x < size and y < size:
            key = keys[vehicle, y, x]
            column = wp.clamp(int(wp.floor(point[0] / float(factor))), 0, pixels - 1)
            row = wp.clamp(int(wp.floor(point[1] / float(factor))), 0, pixels - 1)
            given = gradient[vehicle, row, column]
            seen = key == NOTHING
            step = wp.vec4(0.0, 0.0, 0.0, wp.where(seen, 1.0, 0.0))
            if not shadow:
                near = wp.lerp(
                    mesh.depth[vehicle, start_vertex], mesh.depth[vehicle, end_vertex], along
                )
                if not seen:
                    seen = depth_of(key) > near + 1.0e-3
                if seen:
                    weights = wp.vec3()
                    for each in range(3):
                        share = wp.where(corner[each] == end_vertex, along, 0.0)
                        weights[each] = wp.where(corner[each] == start_vertex, 1.0 - along, share)
                    colour = sample_colour(mesh, paint, vehicle, face, weights)
                    if key != NOTHING:
                        behind = face_of(key)
                        there = weights_at(mesh, vehicle, behind, x, y)
                        colour -= sample_colour(mesh, paint, vehicle, behind, there)
                    step = wp.vec4(colour[0], colour[1], colour[2], step[3])
            if seen:
                swept = outward * (wp.dot(given, step) / float(factor * factor))
                wp.atomic_add(to_screen, vehicle, start_vertex, swept * (1.0 - along))
                wp.atomic_add(to_screen, vehicle, end_vertex, swept * along)


@wp.kernel(enable_backward=True)
def _differentiated(light: SurfaceLight, out: wp.array(dtype=float)):
    """Never run: `wp.grad` silently gives 0 for functions that no such kernel calls."""
    some = wp.vec3()
    out[0] = weighted_radiance(some, some, 1.0, wp.vec2(), light, some)
