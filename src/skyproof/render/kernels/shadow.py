"""Shadows on the ground: where no sun reaches, and how much of the sky vehicles hide."""

import warp as wp

from skyproof.geometry.triangles import NOTHING

# A box under a Gaussian of this many heights, times this share because its sides give light back,
# is within 0.02 of what path tracing takes from ground beside vehicles under an overcast sky.
_SPREAD = 0.45
_SHARE = 0.85
_SQRT_2 = 1.4142135
# A Gaussian never ends; ground that loses no more than this keeps its light.
_FAINTEST = 2e-3
# Shares of a clear sky's light missing in a cast shadow: far from the vehicle, and more near it.
_FAR_LOSS = 0.2
_NEAR_LOSS = 0.9


@wp.struct
class Shade:
    """A vehicle's shadow on the ground (`shade_rows`).

    `origin` is its window's top-left pixel, `middle` the image's, `gsd` its metres per pixel. `low`
    and `high` are the vehicle's box in metres, in its frame, and `left` the light on its ground.
    """

    origin: wp.vec2
    ground: wp.vec2
    cosine: float
    sine: float
    low: wp.vec2
    high: wp.vec2
    height: float
    sunlit: float
    overcast: float
    left: float
    gsd: float
    middle: float


@wp.func
def error_function(x: float):
    """Returns it to 3e-7, without an exponential (Abramowitz and Stegun 1964, 7.1.28)."""
    z = wp.abs(x)
    high = 0.0001520143 + z * (0.0002765672 + z * 0.0000430638)
    total = 1.0 + z * (0.0705230784 + z * (0.0422820123 + z * (0.0092705272 + z * high)))
    power = total * total
    power = power * power
    power = power * power
    power = power * power
    return wp.sign(x) * (1.0 - 1.0 / power)


@wp.func
def between(place: float, low: float, high: float, scale: float):
    """A box under a Gaussian, along one axis."""
    return 0.5 * (error_function((place - low) * scale) - error_function((place - high) * scale))


@wp.func
def contact_shadow(place: wp.vec2, shade: Shade):
    """Share of the sky's light that a vehicle, as a box, takes from the ground beside it.

    A box under a Gaussian is a product of two smooth steps.
    """
    low, high = shade.low, shade.high
    scale = 1.0 / (shade.height * (_SPREAD * _SQRT_2))
    hidden = between(place[0], low[0], high[0], scale) * between(place[1], low[1], high[1], scale)
    return wp.max(_SHARE * hidden - _FAINTEST, 0.0)


@wp.func
def contact_at(shade: Shade, place: wp.vec2):
    """Returns the contact shadow, which is computed near the vehicle only."""
    # Beyond this reach the Gaussian's tail is fainter than `_FAINTEST`, which is cut off.
    reach = 2.01 * shade.height * (_SPREAD * _SQRT_2)
    if place[0] < shade.low[0] - reach or place[0] > shade.high[0] + reach:
        return 0.0
    if place[1] < shade.low[1] - reach or place[1] > shade.high[1] + reach:
        return 0.0
    return contact_shadow(place, shade)


@wp.func
def losses(cast: float, contact: float, shade: Shade):
    """Shares of sun and sky that a vehicle takes from the ground.

    In the cast shadow a fifth of a clear sky is missing, because the vehicle hides the brighter
    half around the sun, and more towards the vehicle. Beside it in the sun nothing is missing,
    because the bright side gives back what it hides. Both agree with path tracing (docs/cycles.md).
    Without direct sun there is the contact shadow.
    """
    clear = shade.sunlit * (1.0 - shade.overcast)
    sky_lost = clear * cast * (_FAR_LOSS + _NEAR_LOSS * contact) + (1.0 - clear) * contact
    sun_lost = cast * shade.sunlit
    return wp.vec2(wp.min(sun_lost / shade.left, 1.0), wp.min(sky_lost / shade.left, 1.0))


@wp.func
def weighted_losses(cast: float, contact: float, shade: Shade, weight: wp.vec2):
    """Returns one number, of which Warp derives the gradient in both shadows."""
    return wp.dot(weight, losses(cast, contact, shade))


@wp.func
def in_vehicle(shade: Shade, row: int, column: int):
    """The middle of a pixel, in metres along the vehicle's axes."""
    east = (shade.origin[0] + float(column) + 0.5 - shade.middle) * shade.gsd - shade.ground[0]
    north = -(shade.origin[1] + float(row) + 0.5 - shade.middle) * shade.gsd - shade.ground[1]
    return wp.vec2(
        shade.cosine * east + shade.sine * north, shade.cosine * north - shade.sine * east
    )


@wp.kernel(enable_backward=False)
def shadow_pixels(
    keys: wp.array3d(dtype=wp.int64),
    shades: wp.array(dtype=Shade),
    factor: int,
    cast: wp.array3d(dtype=float),
    layers: wp.array3d(dtype=wp.vec2),
    parts: int,
):
    """Averages samples to the share of each pixel that the sun does not reach, and its shadow."""
    vehicle, row, part = wp.tid()
    for column in range(part, layers.shape[2], parts):
        covered = wp.int32(0)
        for y in range(row * factor, (row + 1) * factor):
            for x in range(column * factor, (column + 1) * factor):
                if keys[vehicle, y, x] != NOTHING:
                    covered += 1
        share = float(covered) / float(factor * factor)
        cast[vehicle, row, column] = share
        shade = shades[vehicle]
        place = in_vehicle(shade, row, column)
        contact = contact_at(shade, place)
        layers[vehicle, row, column] = losses(share, contact, shade)


@wp.kernel(enable_backward=False)
def shadows_back(
    shades: wp.array(dtype=Shade),
    cast: wp.array3d(dtype=float),
    gradient: wp.array3d(dtype=wp.vec2),
    to_cast: wp.array3d(dtype=wp.vec4),
    to_box: wp.array2d(dtype=float),
    parts: int,
):
    """Gradient of the cast shadow's coverage and of the box (low x, y, high x, y, height)."""
    vehicle, row, part = wp.tid()
    for column in range(part, gradient.shape[2], parts):
        given = gradient[vehicle, row, column]
        if given[0] == 0.0 and given[1] == 0.0:
            continue
        shade = shades[vehicle]
        share = cast[vehicle, row, column]
        place = in_vehicle(shade, row, column)
        contact = contact_at(shade, place)
        to_share, to_contact, _shade, _given = wp.grad(weighted_losses)(
            share, contact, shade, given
        )
        to_cast[vehicle, row, column] = wp.vec4(0.0, 0.0, 0.0, to_share)
        if contact > 0.0 and to_contact != 0.0:
            _place, box = wp.grad(contact_shadow)(place, shade)
            wp.atomic_add(to_box, vehicle, 0, to_contact * box.low[0])
            wp.atomic_add(to_box, vehicle, 1, to_contact * box.low[1])
            wp.atomic_add(to_box, vehicle, 2, to_contact * box.high[0])
            wp.atomic_add(to_box, vehicle, 3, to_contact * box.high[1])
            wp.atomic_add(to_box, vehicle, 4, to_contact * box.height)


@wp.kernel(enable_backward=True)
def _differentiated(shade: Shade, out: wp.array(dtype=float)):
    """Never run: `wp.grad` silently gives 0 for functions that no such kernel calls."""
    zero = wp.vec2()
    out[0] = weighted_losses(1.0, contact_shadow(zero, shade), shade, zero)
