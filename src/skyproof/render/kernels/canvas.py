"""Vehicles and shadows laid over the photograph, in linear light, as the sensor shows them.

`composite` says how. The functions that show light are those of `SceneLights`, with derivatives.
"""

import warp as wp

from skyproof.render.kernels.texture import from_table
from skyproof.render.lighting import LEAST_ROOM, NEARLY_WHITE

Drawn = wp.types.vector(length=6, dtype=float)
"""Colour and coverage of vehicles, and the shares of sun and sky that the ground loses."""


@wp.struct
class ImageLayers:
    """Vehicles and shadows in their windows, and each image's vehicles, the farthest first."""

    first: wp.array(dtype=int)
    vehicles: wp.array(dtype=int)
    origins: wp.array(dtype=wp.vec2i)
    bodies: wp.array3d(dtype=wp.vec4)
    body_origins: wp.array(dtype=wp.vec2i)
    shadows: wp.array3d(dtype=wp.vec2)
    shadow_origins: wp.array(dtype=wp.vec2i)


@wp.func
def inside(at: wp.vec2i, size: int):
    """Says whether a pixel lies inside a square of this size."""
    return at[0] >= 0 and at[1] >= 0 and at[0] < size and at[1] < size


@wp.func
def layer_at(canvas: ImageLayers, vehicle: int, here: wp.vec2i):
    """Returns what a vehicle and its shadow contribute to a pixel."""
    layer = Drawn()
    at = here - canvas.body_origins[vehicle]
    if inside(at, canvas.bodies.shape[2]):
        body = canvas.bodies[vehicle, at[1], at[0]]
        for channel in range(4):
            layer[channel] = body[channel]
    at = here - canvas.shadow_origins[vehicle]
    if inside(at, canvas.shadows.shape[2]):
        shadow = canvas.shadows[vehicle, at[1], at[0]]
        layer[4] = shadow[0]
        layer[5] = shadow[1]
    return layer


@wp.func
def laid(canvas: ImageLayers, begin: int, end: int, here: wp.vec2i):
    """Lays vehicles over each other, and joins shadows, which darken the ground once."""
    total = Drawn()
    for place in range(begin, end):
        above = layer_at(canvas, canvas.vehicles[place], here)
        for channel in range(4):
            total[channel] = total[channel] * (1.0 - above[3]) + above[channel]
        for channel in range(4, 6):
            total[channel] = total[channel] * (1.0 - above[channel]) + above[channel]
    return total


@wp.kernel(enable_backward=False)
def lay(canvas: ImageLayers, drawn: wp.array3d(dtype=Drawn), parts: int):
    """Lays all vehicles of each image into its window."""
    image, row, part = wp.tid()
    begin, end = canvas.first[image], canvas.first[image + 1]
    for column in range(part, drawn.shape[2], parts):
        here = canvas.origins[image] + wp.vec2i(column, row)
        drawn[image, row, column] = laid(canvas, begin, end, here)


@wp.kernel(enable_backward=False)
def blur(
    weights: wp.array2d(dtype=float),
    offsets: wp.array(dtype=wp.vec2i),
    axis: int,
    given: wp.array3d(dtype=Drawn),
    blurred: wp.array3d(dtype=Drawn),
    parts: int,
):
    """Blurs along rows (0) or columns (1); `offsets` are the result's corner in what is given."""
    image, row, part = wp.tid()
    radius = weights.shape[1] - 1
    for column in range(part, blurred.shape[2], parts):
        total = Drawn()
        if axis == 0:
            middle = column + offsets[image][0]
            for x in range(wp.max(middle - radius, 0), wp.min(middle + radius + 1, given.shape[2])):
                total += given[image, row, x] * weights[image, wp.abs(x - middle)]
        else:
            middle = row + offsets[image][1]
            for y in range(wp.max(middle - radius, 0), wp.min(middle + radius + 1, given.shape[1])):
                total += given[image, y, column] * weights[image, wp.abs(y - middle)]
        blurred[image, row, column] = total


@wp.struct
class Show:
    """How a picture shows light (`SceneLights`)."""

    white: wp.vec3
    black: wp.vec3
    sky: wp.vec3
    shoulder: float
    noise: float


@wp.func
def clipped(value: float):
    """Clips a value to [0, 1]; NaN stays NaN."""
    return wp.where(value < 0.0, 0.0, wp.where(value > 1.0, 1.0, value))


@wp.func
def to_srgb(linear: float):
    """Linear light to sRGB (IEC 61966-2-1), clipped, and the derivative, 0 where it clips."""
    held = clipped(linear)
    shown = wp.vec2(held * 12.92, 12.92)
    if held > 0.0031308:
        root = 1.055 * wp.exp(wp.log(held) * (1.0 / 2.4))
        shown = wp.vec2(root - 0.055, root / (2.4 * held))
    if held != linear:
        shown[1] = 0.0
    return shown


@wp.func
def received(shown: float, black: float, white: float, shoulder: float):
    """The light behind a shown value: the inverse of `shown_value`, never below 0."""
    value = shown
    if shown > shoulder and shoulder < 1.0:
        room = wp.max(1.0 - shoulder, LEAST_ROOM)
        part = wp.min((shown - shoulder) / room, NEARLY_WHITE)
        value = shoulder + room * 0.5 * wp.log((1.0 + part) / (1.0 - part))
    return wp.max((value - black) / (wp.max(white, black + LEAST_ROOM) - black), 0.0)


@wp.func
def shown_value(light: float, black: float, white: float, shoulder: float):
    """The shown value of light, as `SceneLights.shown` returns it, and its derivative."""
    slope = wp.max(white, black + LEAST_ROOM) - black
    value = black + light * slope
    if value > shoulder and shoulder < 1.0:
        room = wp.max(1.0 - shoulder, LEAST_ROOM)
        bend = wp.tanh((value - shoulder) / room)
        value = shoulder + room * bend
        slope = slope * (1.0 - bend * bend)
    return wp.vec2(value, slope)


@wp.func
def kept_light(drawn: Drawn, sky: float):
    """Returns the share of the ground's light that shadows leave."""
    return 1.0 - (1.0 - sky) * drawn[4] - sky * drawn[5]


@wp.struct
class SensorWindows:
    """Windows that are drawn in images, from `corners` on, and what the sensors do there.

    For each pixel and channel it keeps the ground's light, and the slope of the shown value.
    """

    corners: wp.array(dtype=wp.vec2i)
    drawn: wp.array3d(dtype=Drawn)
    shows: wp.array(dtype=Show)
    noise: wp.array4d(dtype=float)
    linear: wp.array(dtype=wp.vec2)
    ground: wp.array3d(dtype=wp.vec3)
    slopes: wp.array3d(dtype=wp.vec3)


@wp.kernel(enable_backward=False)
def finish_pixels(picture: SensorWindows, keep: bool, images: wp.array4d(dtype=float), parts: int):
    """Lays vehicles and shadows over the photographs, which keep their bits elsewhere."""
    image, row, part = wp.tid()
    show = picture.shows[image]
    side = picture.noise.shape[2]
    y = picture.corners[image][1] + row
    for column in range(part, picture.drawn.shape[2], parts):
        drawn = picture.drawn[image, row, column]
        x = picture.corners[image][0] + column
        grounds = wp.vec3()
        slopes = wp.vec3()
        if drawn[3] > 0.0 or drawn[4] > 0.0 or drawn[5] > 0.0:
            for channel in range(3):
                black, white = show.black[channel], show.white[channel]
                before = from_table(picture.linear, images[image, channel, y, x])
                ground = received(before, black, white, show.shoulder)
                light = ground * kept_light(drawn, show.sky[channel]) * (1.0 - drawn[3])
                light += drawn[channel]
                linear = shown_value(light, black, white, show.shoulder)
                srgb = to_srgb(linear[0])
                noise = drawn[3] * show.noise * picture.noise[image, channel, y % side, x % side]
                noisy = srgb[0] + noise
                images[image, channel, y, x] = clipped(noisy)
                if keep and noisy >= 0.0 and noisy <= 1.0:
                    slopes[channel] = linear[1] * srgb[1]
                    grounds[channel] = ground
        if keep:
            picture.ground[image, row, column] = grounds
            picture.slopes[image, row, column] = slopes


@wp.kernel(enable_backward=False)
def finish_pixels_back(
    picture: SensorWindows,
    gradient: wp.array4d(dtype=float),
    to_drawn: wp.array3d(dtype=Drawn),
    parts: int,
):
    """Gradient of what was laid over the photographs."""
    image, row, part = wp.tid()
    y = picture.corners[image][1] + row
    for column in range(part, to_drawn.shape[2], parts):
        drawn = picture.drawn[image, row, column]
        ground = picture.ground[image, row, column]
        slopes = picture.slopes[image, row, column]
        x = picture.corners[image][0] + column
        total = Drawn()
        for channel in range(3):
            sky = picture.shows[image].sky[channel]
            weight = gradient[image, channel, y, x] * slopes[channel]
            lost = weight * ground[channel] * (1.0 - drawn[3])
            total[channel] = weight
            total[3] -= weight * ground[channel] * kept_light(drawn, sky)
            total[4] -= lost * (1.0 - sky)
            total[5] -= lost * sky
        to_drawn[image, row, column] = total


@wp.kernel(enable_backward=False)
def lay_back(
    canvas: ImageLayers,
    to_drawn: wp.array3d(dtype=Drawn),
    to_bodies: wp.array3d(dtype=wp.vec4),
    to_shadows: wp.array3d(dtype=wp.vec2),
    parts: int,
):
    """Hands a canvas's gradient to the vehicles on it, the nearest first."""
    image, row, part = wp.tid()
    begin, end = canvas.first[image], canvas.first[image + 1]
    for column in range(part, to_drawn.shape[2], parts):
        here = canvas.origins[image] + wp.vec2i(column, row)
        to = to_drawn[image, row, column]
        for back in range(end - begin):
            place = end - 1 - back
            vehicle = canvas.vehicles[place]
            above = layer_at(canvas, vehicle, here)
            below = laid(canvas, begin, place, here)
            at = here - canvas.body_origins[vehicle]
            if inside(at, to_bodies.shape[2]):
                body = wp.vec4(to[0], to[1], to[2], to[3])
                body[3] -= to[0] * below[0] + to[1] * below[1] + to[2] * below[2] + to[3] * below[3]
                to_bodies[vehicle, at[1], at[0]] = body
            at = here - canvas.shadow_origins[vehicle]
            if inside(at, to_shadows.shape[2]):
                shadow = wp.vec2(to[4] * (1.0 - below[4]), to[5] * (1.0 - below[5]))
                to_shadows[vehicle, at[1], at[0]] = shadow
            for channel in range(4):
                to[channel] *= 1.0 - above[3]
            for channel in range(4, 6):
                to[channel] *= 1.0 - above[channel]
