"""Kernels of the rasteriser."""

import warp as wp

NOTHING_KEY = (1 << 63) - 1
NOTHING = wp.constant(wp.int64(NOTHING_KEY))
# A key holds the depth in 0.01 mm above these bits, and the face in them.
FACE_BITS = 31
_FACE_BITS = wp.constant(wp.int64(FACE_BITS))
_FACE_MASK = wp.constant(wp.int64((1 << FACE_BITS) - 1))
_DEPTH_ZERO = wp.constant(wp.int64(1 << 30))
_FACING = wp.constant(1e-12)


@wp.func
def cross2(a: wp.vec2, b: wp.vec2):
    return a[0] * b[1] - a[1] * b[0]


@wp.kernel(enable_backward=False)
def draw_triangles(
    screen: wp.array2d(dtype=wp.vec2),
    depth: wp.array2d(dtype=float),
    faces: wp.array(dtype=wp.vec3i),
    two_sided: bool,
    keys: wp.array3d(dtype=wp.int64),
):
    """Lowers each sample's key to the nearest triangle, row by row and sample by sample."""
    vehicle, face = wp.tid()
    size = keys.shape[1]
    corner = faces[face]
    a = screen[vehicle, corner[0]]
    b = screen[vehicle, corner[1]]
    c = screen[vehicle, corner[2]]
    area = cross2(c - a, b - a)
    if area <= _FACING and not (two_sided and area < -_FACING):
        return
    low = wp.min(a, wp.min(b, c))
    high = wp.max(a, wp.max(b, c))
    first = wp.max(int(wp.ceil(low[1] - 0.5)), 0)
    last = wp.min(int(wp.floor(high[1] - 0.5)), size - 1)
    if first > last:
        return
    base = wp.vec2(wp.floor(low[0]), wp.floor(low[1]))
    x_base = int(base[0])
    y_base = int(base[1])
    a = a - base
    b = b - base
    c = c - base
    to_b = b - a
    to_c = c - a
    start = wp.vec2(0.5, 0.5) - a
    inverse = 1.0 / area
    second = wp.vec3(-to_c[1], to_c[0], cross2(to_c, start)) * inverse
    third = wp.vec3(to_b[1], -to_b[0], cross2(start, to_b)) * inverse
    whole = -second - third + wp.vec3(0.0, 0.0, 1.0)
    near = depth[vehicle, corner[0]]
    slope = second * (depth[vehicle, corner[1]] - near) + third * (depth[vehicle, corner[2]] - near)
    # Inverse slopes along x, by which each row finds where it crosses the triangle's sides.
    ends = wp.vec3(1.0 / whole[0], 1.0 / second[0], 1.0 / third[0])
    planes = wp.matrix_from_rows(whole, second, third)
    for y in range(first, last + 1):
        step = float(y - y_base)
        lowest = -1.0e6
        highest = 1.0e6
        for side in range(3):
            plane = planes[side]
            # A tiny tolerance closes the cracks that rounding opens between neighbours.
            rest = plane[1] * step + plane[2] + 1.0e-5
            if plane[0] > 0.0:
                lowest = wp.max(lowest, -rest * ends[side])
            elif plane[0] < 0.0:
                highest = wp.min(highest, -rest * ends[side])
            elif rest < 0.0:
                lowest = 1.0e6
        begin = wp.max(int(wp.ceil(lowest)), -x_base)
        end = wp.min(int(wp.floor(highest)), size - 1 - x_base)
        row_depth = near + slope[2] + slope[1] * step
        for x in range(begin, end + 1):
            deep = row_depth + slope[0] * float(x)
            key = wp.int64(wp.rint(wp.float64(deep) * wp.float64(1.0e5))) + _DEPTH_ZERO
            key = (key << _FACE_BITS) | wp.int64(face)
            wp.atomic_min(keys, vehicle, y, x_base + x, key)


@wp.func
def depth_of(key: wp.int64):
    return wp.float32(wp.float64((key >> _FACE_BITS) - _DEPTH_ZERO) * wp.float64(1.0e-5))


@wp.func
def face_of(key: wp.int64):
    return int(key & _FACE_MASK)
