"""Textures as the light that they reflect, as pyramids of halved sizes, and their gradients.

A pyramid is one row of texels: level after level, texture by texture, row by row.
"""

import warp as wp

LEVELS = 7
"""Number of levels of a pyramid; the full map is level 0."""
TABLE = 1024
"""Pieces of the tables for sRGB."""


@wp.struct
class Cloth:
    """Textures as they come: shown ones in [0, 1], or one of them over vehicles' own bytes.

    `painted` says that there are shown ones, `masked` that they lie over others.
    """

    shown: wp.array4d(dtype=float)
    own: wp.array4d(dtype=wp.uint8)
    masks: wp.array3d(dtype=wp.bool)
    painted: bool
    masked: bool
    reflected: wp.array(dtype=wp.vec2)
    slopes: wp.array(dtype=wp.vec2)
    of_bytes: wp.array(dtype=float)


@wp.struct
class Pyramid:
    """Reflectance of textures of one side; its levels begin with the finest that is read."""

    texels: wp.array(dtype=wp.vec3)
    textures: int
    finest: int
    side: int


@wp.func
def beginning(pyramid: Pyramid, side: int, texture: int):
    """The first texel of a texture at the level of this side; one may serve all vehicles."""
    finest = pyramid.side >> pyramid.finest
    # Texels of finer levels: a geometric series.
    base = (finest * finest - side * side) / 3 * 4 * pyramid.textures
    return wp.where(pyramid.textures > 1, base + texture * side * side, base)


@wp.func
def from_table(table: wp.array(dtype=wp.vec2), srgb: float):
    """Evaluates a function of an sRGB value by its pieces, which hold a value and its increase."""
    place = srgb * float(TABLE)
    low = wp.clamp(int(place), 0, TABLE - 1)
    piece = table[low]
    return piece[0] + piece[1] * (place - float(low))


@wp.func
def texel_at(cloth: Cloth, index: int, y: int, x: int):
    """Returns the reflectance of a texel of the full map."""
    over = cloth.painted
    if cloth.masked:
        over = cloth.masks[index, y, x]
    layer = wp.where(cloth.masked, 0, index)
    texel = wp.vec3()
    for channel in range(3):
        if over:
            texel[channel] = from_table(cloth.reflected, cloth.shown[layer, channel, y, x])
        else:
            texel[channel] = cloth.of_bytes[int(cloth.own[index, channel, y, x])]
    return texel


@wp.kernel(enable_backward=False)
def fill(cloth: Cloth, side: int, texels: wp.array3d(dtype=wp.vec3), parts: int):
    """Fills the finest level, whose texels are means of `side` x `side` of the full map."""
    index, row, part = wp.tid()
    share = 1.0 / float(side * side)
    for column in range(part, texels.shape[2], parts):
        if side == 1:
            texels[index, row, column] = texel_at(cloth, index, row, column)
            continue
        total = wp.vec3()
        for y in range(row * side, (row + 1) * side, 2):
            for x in range(column * side, (column + 1) * side, 2):
                total += texel_at(cloth, index, y, x) + texel_at(cloth, index, y, x + 1)
                total += texel_at(cloth, index, y + 1, x) + texel_at(cloth, index, y + 1, x + 1)
        texels[index, row, column] = total * share


@wp.func
def from_all_levels(gradients: Pyramid, texture: int, row: int, column: int):
    """Returns the gradient of a texel of the finest level, with the shares of coarser levels."""
    total = wp.vec3()
    share = wp.float32(1.0)
    side = gradients.side >> gradients.finest
    begin = wp.int32(0)
    for level in range(LEVELS - gradients.finest):
        line = texture * side + (row >> level)
        total += gradients.texels[begin + line * side + (column >> level)] * share
        begin += gradients.textures * side * side
        side = side >> 1
        share = share * 0.25
    return total


@wp.kernel(enable_backward=False)
def fill_back(cloth: Cloth, gradients: Pyramid, to_shown: wp.array4d(dtype=float), parts: int):
    """Adds the gradient of shown textures; under masks, that of all vehicles."""
    layer, row, part = wp.tid()
    side = 1 << gradients.finest
    share = 1.0 / float(side * side)
    first = wp.where(cloth.masked, 0, layer)
    last = wp.where(cloth.masked, gradients.textures, layer + 1)
    for column in range(part, to_shown.shape[3] >> gradients.finest, parts):
        for index in range(first, last):
            value = from_all_levels(gradients, index, row, column) * share
            # Texels that no camera sees have no gradient.
            if value[0] == 0.0 and value[1] == 0.0 and value[2] == 0.0:
                continue
            for y in range(row * side, (row + 1) * side):
                for x in range(column * side, (column + 1) * side):
                    if not cloth.masked or cloth.masks[index, y, x]:
                        for channel in range(3):
                            slope = from_table(cloth.slopes, cloth.shown[layer, channel, y, x])
                            to_shown[layer, channel, y, x] += value[channel] * slope
