"""What samples of vehicles show: their place on a face, its normal, texture and light."""

import warp as wp

from skyproof.geometry.triangles import NOTHING, cross2, depth_of, face_of
from skyproof.render.kernels.light import SurfaceLight, diffuse_light, mirrored_light, radiance
from skyproof.render.kernels.texture import LEVELS, Pyramid, beginning
from skyproof.render.materials import CAMOUFLAGE

# In metres. A surface this far behind the sun's depth of a sample still counts as lit.
_BEHIND_M = 0.05
# Keeps the direction of a vanishing normal finite.
_TINY = 1e-24


@wp.struct
class Mesh:
    """Placed vehicles, and what camera and sun see of them.

    `screen` and `sun_screen` are vertices in samples of the windows, `keys` and `sun_keys` those of
    `rasterise`. `sun_places` are column, row and depth in the sun's view of vertices that are
    taken a little off the surface along their normals.
    """

    faces: wp.array(dtype=wp.vec3i)
    uvs: wp.array2d(dtype=wp.vec2)
    normals: wp.array2d(dtype=wp.vec3)
    screen: wp.array2d(dtype=wp.vec2)
    depth: wp.array2d(dtype=float)
    keys: wp.array3d(dtype=wp.int64)
    levels: wp.array2d(dtype=int)
    sun_screen: wp.array2d(dtype=wp.vec2)
    sun_keys: wp.array3d(dtype=wp.int64)
    sun_places: wp.array2d(dtype=wp.vec3)
    self_shadows: bool


@wp.struct
class Paint:
    """The paint of vehicles: reflectance (`LinearTexture`), and each texel's part and gloss.

    `gloss` holds a part's reflectance at normal incidence, and the exponent of its glint.
    """

    pyramid: Pyramid
    parts: wp.array3d(dtype=wp.uint8)
    masks: wp.array3d(dtype=wp.bool)
    masked: bool
    repainted: bool
    gloss: wp.array(dtype=wp.vec2)
    lights: wp.array(dtype=SurfaceLight)


@wp.struct
class Bilinear:
    """Four texels and the shares of the second column and row."""

    places: wp.vec4i
    across: float
    down: float
    side: float


@wp.struct
class SurfaceSample:
    """What a point of a face shows to the camera, without its light."""

    normal: wp.vec3
    length: float
    sunlit: float
    gloss: wp.vec2
    texels: Bilinear


@wp.kernel(enable_backward=False)
def texture_levels(mesh: Mesh, side: float, levels: wp.array2d(dtype=int)):
    """Finds each triangle's pyramid level: one texel per sample, in its most squeezed direction."""
    vehicle, face = wp.tid()
    corner = mesh.faces[face]
    a = mesh.screen[vehicle, corner[0]]
    across = mesh.screen[vehicle, corner[1]] - a
    down = mesh.screen[vehicle, corner[2]] - a
    area = cross2(across, down)
    # Backs are never seen.
    if area < 0.0:
        u = mesh.uvs[face, 0]
        texel_across = (mesh.uvs[face, 1] - u) * side
        texel_down = (mesh.uvs[face, 2] - u) * side
        per_x = (texel_across * down[1] - texel_down * across[1]) / area
        per_y = (texel_down * across[0] - texel_across * down[0]) / area
        longest = wp.sqrt(wp.max(wp.dot(per_x, per_x), wp.dot(per_y, per_y)))
        levels[vehicle, face] = int(wp.rint(wp.log2(wp.clamp(longest, 1.0, 1048576.0))))


@wp.func
def weights_at(mesh: Mesh, vehicle: int, face: int, x: int, y: int):
    """Barycentric weights of a triangle's three corners at the middle of a sample."""
    corner = mesh.faces[face]
    a = mesh.screen[vehicle, corner[0]]
    to_b = mesh.screen[vehicle, corner[1]] - a
    to_c = mesh.screen[vehicle, corner[2]] - a
    to_point = wp.vec2(float(x) + 0.5, float(y) + 0.5) - a
    area = cross2(to_c, to_b)
    second = cross2(to_c, to_point) / area
    third = cross2(to_point, to_b) / area
    return wp.vec3(1.0 - second - third, second, third)


@wp.func
def uv_at(mesh: Mesh, face: int, weights: wp.vec3):
    """Texture coordinates (u, v)."""
    total = wp.vec2()
    for each in range(3):
        total += mesh.uvs[face, each] * weights[each]
    return total


@wp.func
def mean_of(values: wp.array2d(dtype=wp.vec3), vehicle: int, corner: wp.vec3i, weights: wp.vec3):
    """The weighted mean of values at three corners."""
    total = wp.vec3()
    for each in range(3):
        total += values[vehicle, corner[each]] * weights[each]
    return total


@wp.func
def sunlit_at(mesh: Mesh, vehicle: int, corner: wp.vec3i, weights: wp.vec3):
    """Returns 1, or 0 if a part of the vehicle hides the sun, by a shadow map (Williams 1978)."""
    if not mesh.self_shadows:
        return 1.0
    place = mean_of(mesh.sun_places, vehicle, corner, weights)
    most = mesh.sun_keys.shape[1] - 1
    x = wp.clamp(int(wp.floor(place[0])), 0, most)
    y = wp.clamp(int(wp.floor(place[1])), 0, most)
    key = mesh.sun_keys[vehicle, y, x]
    if key == NOTHING or depth_of(key) > place[2] - _BEHIND_M:
        return 1.0
    return 0.0


@wp.func
def texels_around(pyramid: Pyramid, vehicle: int, uv: wp.vec2, level: int):
    """Bilinear place at (u, v) of a pyramid's level (section S4.3), circular in u, clamped in v.

    Sides are powers of two, so that `&` can give the remainder.
    """
    side = pyramid.side >> wp.clamp(level, pyramid.finest, LEVELS - 1)
    base = beginning(pyramid, side, vehicle)
    x = uv[0] * float(side) - 0.5
    y = uv[1] * float(side) - 0.5
    left = wp.floor(x)
    top = wp.floor(y)
    column = int(left) & (side - 1)
    next_column = (int(left) + 1) & (side - 1)
    row = base + wp.clamp(int(top), 0, side - 1) * side
    next_row = base + wp.clamp(int(top) + 1, 0, side - 1) * side
    found = Bilinear()
    found.places = wp.vec4i(
        row + column, row + next_column, next_row + column, next_row + next_column
    )
    found.across = x - left
    found.down = y - top
    found.side = float(side)
    return found


@wp.func
def albedo_of(pyramid: Pyramid, at: Bilinear):
    """Reflectance of each channel."""
    upper = wp.lerp(pyramid.texels[at.places[0]], pyramid.texels[at.places[1]], at.across)
    lower = wp.lerp(pyramid.texels[at.places[2]], pyramid.texels[at.places[3]], at.across)
    return wp.lerp(upper, lower, at.down)


@wp.func
def gloss_at(paint: Paint, vehicle: int, uv: wp.vec2):
    """Gloss of the part at (u, v), or of its camouflage: paint on glass is paint."""
    if paint.repainted:
        return paint.gloss[CAMOUFLAGE]
    wide = paint.parts.shape[2]
    column = int(uv[0] * float(wide)) % wide
    row = wp.clamp(int(uv[1] * float(wide)), 0, wide - 1)
    if paint.masked and paint.masks[vehicle, row, column]:
        return paint.gloss[CAMOUFLAGE]
    return paint.gloss[int(paint.parts[vehicle, row, column])]


@wp.func
def sample_at(mesh: Mesh, paint: Paint, vehicle: int, face: int, weights: wp.vec3):
    """What a point of a face shows."""
    corner = mesh.faces[face]
    uv = uv_at(mesh, face, weights)
    mean = mean_of(mesh.normals, vehicle, corner, weights)
    sample = SurfaceSample()
    sample.length = wp.sqrt(wp.dot(mean, mean) + _TINY)
    sample.normal = mean / sample.length
    sample.sunlit = sunlit_at(mesh, vehicle, corner, weights)
    sample.gloss = gloss_at(paint, vehicle, uv)
    sample.texels = texels_around(paint.pyramid, vehicle, uv, mesh.levels[vehicle, face])
    return sample


@wp.func
def sample_colour(mesh: Mesh, paint: Paint, vehicle: int, face: int, weights: wp.vec3):
    """Light that a point of a face sends to the camera."""
    seen = sample_at(mesh, paint, vehicle, face, weights)
    albedo = albedo_of(paint.pyramid, seen.texels)
    return radiance(seen.normal, albedo, seen.sunlit, seen.gloss, paint.lights[vehicle])


@wp.kernel(enable_backward=False)
def shade_pixels(
    mesh: Mesh,
    paint: Paint,
    factor: int,
    layers: wp.array3d(dtype=wp.vec4),
    keep: bool,
    reached: wp.array3d(dtype=wp.vec3),
    parts: int,
):
    """Averages samples to pixels (section S2.2): colour times coverage, and coverage.

    It keeps the light that reaches each sample's paint for the gradient of textures.
    """
    vehicle, row, part = wp.tid()
    light = paint.lights[vehicle]
    share = 1.0 / float(factor * factor)
    for column in range(part, layers.shape[2], parts):
        colour = wp.vec3()
        covered = wp.int32(0)
        for y in range(row * factor, (row + 1) * factor):
            for x in range(column * factor, (column + 1) * factor):
                key = mesh.keys[vehicle, y, x]
                if key != NOTHING:
                    face = face_of(key)
                    weights = weights_at(mesh, vehicle, face, x, y)
                    seen = sample_at(mesh, paint, vehicle, face, weights)
                    diffuse = diffuse_light(seen.normal, seen.sunlit, seen.gloss, light)
                    colour += wp.cw_mul(albedo_of(paint.pyramid, seen.texels), diffuse)
                    colour += mirrored_light(seen.normal, seen.sunlit, seen.gloss, light)
                    covered += 1
                    if keep:
                        reached[vehicle, y, x] = diffuse
        layers[vehicle, row, column] = wp.vec4(
            colour[0] * share, colour[1] * share, colour[2] * share, float(covered) * share
        )
