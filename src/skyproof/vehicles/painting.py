"""Paints a body's texture and part labels, texel by texel, from each texel's position in space."""

import torch
from jaxtyping import Float, UInt8
from torch import Tensor

from skyproof.vehicles.bodies import Body
from skyproof.vehicles.canvas import Colour, TextureCanvas, between
from skyproof.vehicles.paints import Coat, lay_coat, sample_paint
from skyproof.vehicles.template import TOPOLOGY_BELT
from skyproof.vehicles.vehicle import TEXTURE_SIZE, Part

GLASS_SRGB = (0.060, 0.070, 0.080)
"""Colour of panes, through which hardly anything shows; vehicles have 0.75 to 1.45 times this."""

LARGE = ("bus", "lorry")
"""Body types that are painted as vans, with other roofs."""

_BLACK = (0.06, 0.06, 0.065)
_RUBBER = (0.075, 0.075, 0.075)
_CHROME = (0.62, 0.63, 0.64)
_LAMP = (0.60, 0.62, 0.64)
_TAIL_LAMP = (0.58, 0.04, 0.05)
_PLATE = (0.82, 0.82, 0.78)
_SEAM = 0.45  # what is left of the paint's brightness in a panel gap


def paint_vehicle(
    body: Body,
    body_type: str,
    coat: Coat = "catalogue",
    *,
    paint: Float[Tensor, " 3"] | None = None,
    glass: Float[Tensor, " 3"] | None = None,
    generator: torch.Generator,
) -> tuple[UInt8[Tensor, "3 512 512"], UInt8[Tensor, "512 512"]]:
    """Paints one vehicle's sRGB without light or shadow; its labels are exactly symmetric.

    Paint and glass, sRGB in [0, 1], are drawn if None. The other draws are the same in either case.
    """
    name, body_type = body_type, "van" if body_type in LARGE else body_type
    _, drawn_paint = sample_paint(body_type, generator=generator)
    paint = drawn_paint if paint is None else paint
    chance = torch.rand(12, generator=generator).tolist()
    canvas = TextureCanvas(body, paint)
    if coat in ("plain", "two_tone", "livery"):
        paint = lay_coat(canvas, coat, generator=generator)
    _paint_seams(canvas, body_type)
    _paint_lower_body(canvas, body_type, chance[0])
    _paint_ends(canvas, body_type, paint, chance[1])
    if glass is None:
        glass = torch.tensor(GLASS_SRGB) * (0.75 + 0.7 * chance[2])
    _paint_glass(canvas, body_type, glass, panel_van=chance[3] < 0.7)
    _paint_roof(canvas, body_type, glass, chance[4:9])
    if body.dimensions.bed_depth:
        _paint_bed(canvas, paint if chance[9] < 0.4 else torch.tensor([0.12, 0.12, 0.125]))
    if name in LARGE:
        _paint_large(canvas, name, paint, generator=generator)
    if coat == "plain" and chance[11] < 0.5:
        # So detectors cannot rely on panes and wheels to tell vehicles from things of their colour.
        canvas.colour.copy_(paint.view(3, 1, 1).expand_as(canvas.colour))

    texture, z, parts = (
        torch.cat([half, half.flip(-1)], dim=-1) for half in (canvas.colour, canvas.z, canvas.parts)
    )
    dirty = _dirty(texture, z, chance[10], generator=generator)
    texture = torch.where(parts == Part.GLASS, texture, dirty)
    return (texture.clamp(0.0, 1.0) * 255).round().to(torch.uint8), parts


def _layout(body: Body) -> tuple[float, float, float, float]:
    """Returns the stations of roof front, B pillar, C pillar and roof rear."""
    d = body.dimensions
    front = d.bonnet_length + d.windscreen_run
    rear = d.length - d.deck_length - d.rear_run
    middle = front + 0.50
    return front, middle, min(middle + 0.85, rear + 0.10), rear


def _paint_seams(c: TextureCanvas, body_type: str) -> None:
    """Paints panel gaps: doors, bonnet, boot. Colour only."""
    d = c.body.dimensions
    front, middle, back, _ = _layout(c.body)
    door_front = d.bonnet_length + 0.12
    on_door = c.side & (c.z > d.clearance + 0.14)
    for station in (door_front, middle, back):
        c.shade(on_door & between(c.behind - station, -0.009, 0.009), _SEAM)
    where = on_door & between(c.behind, door_front, back) & between(c.z - d.clearance, 0.14, 0.16)
    c.shade(where, _SEAM)

    bonnet = c.upper & (c.station < d.bonnet_length) & (c.station > 0.16)
    c.shade(bonnet & between(c.y - (c.rail_y - 0.055), -0.008, 0.008), _SEAM)
    c.shade(c.upper & (c.y < c.rail_y - 0.05) & between(c.station, 0.155, 0.172), _SEAM)
    if body_type == "saloon":
        deck = d.length - d.deck_length
        lid = c.upper & between(c.station, deck - 0.02, d.length - 0.05)
        c.shade(lid & between(c.y - (c.rail_y - 0.12), -0.008, 0.008), _SEAM)
        c.shade(lid & (c.y < c.rail_y - 0.12) & between(c.station - deck, -0.02, -0.004), _SEAM)
    if body_type == "van":
        # Roof corrugations and the sliding door's rail.
        roof = c.upper & (c.column > 11.3) & between(c.station, front + 0.1, d.length - 0.2)
        c.shade(roof & (((c.y / 0.17) % 1.0) < 0.2), 0.92)
        where = c.upper & (c.column < 9) & (c.station > back) & between(c.z - c.belt, 0.03, 0.05)
        c.shade(where, 0.6)


def _paint_lower_body(c: TextureCanvas, body_type: str, chance: float) -> None:
    """Paints sills, arches, wheels and underside."""
    d = c.body.dimensions
    rugged = body_type in ("suv", "pickup") and chance < 0.6
    sill = 0.17 if rugged else 0.07
    c.fill(c.side & (c.z < d.clearance + sill), _BLACK, Part.TRIM)
    outer = (c.column > 0.8) & (c.column <= TOPOLOGY_BELT) & (c.y > 0.5)
    c.fill(c.floor, (0.07, 0.07, 0.07), Part.UNDERSIDE)
    radius = d.wheel_radius
    for axle in (d.front_overhang, d.front_overhang + d.wheelbase):
        along, up = c.behind - axle, c.z - radius
        from_hub = torch.hypot(along, up)
        c.fill(c.side & (from_hub < radius + (0.10 if rugged else 0.05)), _BLACK, Part.TRIM)
        where = outer & ((from_hub < radius) | ((c.z < radius) & (along.abs() < 0.9 * radius)))
        c.fill(where, _RUBBER, Part.WHEEL)
        spokes = (torch.atan2(up, along) * (5 / (2 * torch.pi)) % 1.0) < 0.62
        c.fill(c.side & (from_hub < 0.66 * radius) & spokes, (0.50, 0.51, 0.52), Part.WHEEL)


def _paint_ends(c: TextureCanvas, body_type: str, paint: Colour, chance: float) -> None:
    """Paints bumpers, grille, lights and number plates."""
    d = c.body.dimensions
    half = d.width / 2
    above_floor = ~c.floor
    nose, tail = above_floor & (c.behind < 0.46), above_floor & (c.ahead < 0.36)
    low = d.clearance + 0.16
    plain_van = body_type == "van" and chance < 0.6
    bumper = (0.13, 0.13, 0.135) if plain_van else paint
    if body_type == "pickup":
        bumper = _CHROME
    bumper_z = 0.74 * d.nose_height
    bonnet = c.column > TOPOLOGY_BELT + 2
    c.fill(nose & (c.z < bumper_z), bumper, Part.BUMPER)
    c.fill(tail & (c.z < 0.62), bumper, Part.BUMPER)
    c.fill((nose | tail) & (c.z < low), _BLACK, Part.BUMPER)
    c.shade(nose & ~bonnet & between(c.z - bumper_z, -0.008, 0.008), _SEAM)
    c.shade(tail & between(c.z - 0.62, -0.008, 0.008), _SEAM)

    # Grille and plate face forward; lights reach round the corners.
    face = nose & (c.behind < 0.14)
    where = face & (c.y < 0.52 * half) & between(c.z, bumper_z - 0.04, d.nose_height - 0.10)
    c.fill(where, _BLACK, Part.TRIM)
    c.fill(face & (c.y < 0.66 * half) & between(c.z, low, low + 0.11), _BLACK, Part.TRIM)
    c.fill(face & (c.y < 0.26) & between(c.z, bumper_z - 0.16, bumper_z - 0.05), _PLATE, Part.TRIM)
    lamp_top = d.nose_height + 0.01
    lamp = nose & (c.y > 0.58 * half) & between(c.z, lamp_top - 0.18, lamp_top)
    c.fill(lamp, (0.30, 0.31, 0.33), Part.LIGHT)
    where = lamp & between(c.z, lamp_top - 0.14, lamp_top - 0.01) & (c.y > 0.62 * half)
    c.fill(where, _LAMP, Part.LIGHT)

    tall = body_type in ("hatchback", "estate", "suv", "van")
    high = d.deck_height - (0.04 if body_type != "van" else 0.55)
    across = 0.76 if tall else 0.50
    height = {"saloon": 0.17, "pickup": 0.40, "van": 0.42}.get(body_type, 0.30)
    where = above_floor & (c.y > across * half) & between(c.z, high - height, high)
    c.fill(where & (c.ahead < 0.2), _TAIL_LAMP, Part.LIGHT)
    rear_face = tail & (c.ahead < 0.14)
    plate_z = 0.66 if body_type in ("saloon", "suv", "estate", "hatchback") else 0.48
    c.fill(rear_face & (c.y < 0.26) & between(c.z, plate_z, plate_z + 0.11), _PLATE, Part.TRIM)


def _paint_glass(c: TextureCanvas, body_type: str, glass: Tensor, *, panel_van: bool) -> None:
    """Paints windscreen, side windows with their pillars, and rear window."""
    d = c.body.dimensions
    front, middle, back, rear = _layout(c.body)
    foot = d.bonnet_length
    inside = c.upper & (c.y < c.rail_y)
    c.fill(inside & between(c.station, foot - 0.05, foot + 0.07), _BLACK, Part.TRIM)
    where = inside & (c.y < c.rail_y - 0.03) & between(c.station, foot + 0.05, front - 0.01)
    c.fill(where, _BLACK, Part.GLASS)
    where = inside & (c.y < c.rail_y - 0.055) & between(c.station, foot + 0.09, front - 0.04)
    c.fill(where, glass, Part.GLASS)

    # Side windows lie between shoulder and roof rail, bounded by the slopes of windscreen and rear
    # window.
    above_belt = c.upper & (c.column < 13) & (c.z > c.belt + 0.03) & (c.y > c.rail_y - 0.01)
    beyond_roof = {"saloon": 0.20, "hatchback": 0.08, "pickup": -0.10}.get(body_type, -0.02)
    last = rear + beyond_roof
    if body_type == "van":
        last = middle + 0.25 if panel_van else d.length - 0.35
    window_top = torch.minimum(c.rail_z - 0.065, c.belt + 0.62)
    window = above_belt & (c.z < window_top) & between(c.station, foot + 0.22, last)
    where = above_belt & (c.z < window_top + 0.018) & between(c.station, foot + 0.2, last + 0.02)
    c.fill(where, _BLACK, Part.TRIM)
    c.fill(window, glass, Part.GLASS)
    c.fill(window & between(c.station - middle, -0.055, 0.055), _BLACK, Part.TRIM)
    if body_type != "saloon":
        c.fill(window & between(c.station - back, -0.05, 0.05), _BLACK, Part.TRIM)

    if body_type == "van":
        face = (c.ahead < 0.25) & ~c.floor
        c.shade(face & (c.y < 0.012) & between(c.z, 0.6, d.height - 0.12), _SEAM)
        if not panel_van:
            pane = face & between(c.z, c.belt + 0.05, d.belt_height + 0.55)
            c.fill(pane & between(c.y, 0.12, c.rail_y - 0.12), glass, Part.GLASS)
        return
    deck = d.length - d.deck_length
    bottom = d.deck_height + (0.06 if body_type == "pickup" else 0.03)
    pane = inside & (c.y < c.rail_y - 0.05) & between(c.station, rear + 0.03, deck + 0.01)
    pane &= c.z > bottom
    c.fill(pane, _BLACK, Part.GLASS)
    c.fill(pane & (c.y < c.rail_y - 0.08) & (c.station > rear + 0.07), glass * 0.92, Part.GLASS)


def _paint_roof(c: TextureCanvas, body_type: str, glass: Tensor, chance: list[float]) -> None:
    """Paints sunroof, rails, aerial and contrast roof."""
    front, _, _, rear = _layout(c.body)
    roof = c.upper & (c.y < c.rail_y) & between(c.station, front, rear)
    if body_type in ("hatchback", "suv") and chance[0] < 0.08:
        where = c.upper & (c.z > c.rail_z - 0.03) & between(c.station, front - 0.03, rear + 0.05)
        c.fill(where, (0.07, 0.07, 0.075), Part.BODY)
    if body_type in ("estate", "suv") and chance[1] < 0.65:
        rail = _BLACK if chance[2] < 0.55 else _CHROME
        stretch = between(c.station, front + 0.12, rear - 0.05)
        c.fill(roof & stretch & between(c.y - (c.rail_y - 0.07), -0.022, 0.022), rail, Part.TRIM)
    if body_type not in ("van", "pickup") and chance[3] < 0.22:
        length = 0.45 if chance[4] < 0.6 else min(rear - front - 0.45, 1.10)
        pane = roof & (c.y < min(0.38, float(c.body.rail_y[15]) - 0.14))
        pane &= between(c.station - front, 0.14, 0.14 + length)
        c.fill(pane, glass * 0.8, Part.GLASS)
    if body_type != "van":
        where = roof & (c.y < 0.028) & between(c.station, rear - 0.22, rear - 0.06)
        c.fill(where, _BLACK, Part.TRIM)
        # The ditch where roof and side panels meet.
        c.shade(roof & between(c.y - (c.rail_y - 0.025), -0.018, 0.018), _SEAM)


def _paint_bed(c: TextureCanvas, colour: Tensor) -> None:
    """Paints a pickup's ribbed load bed in the colour of its liner or of the vehicle."""
    d = c.body.dimensions
    deck = d.length - d.deck_length
    bed = (c.column > TOPOLOGY_BELT + 1) & between(c.station, deck + 0.07, d.length - 0.085)
    c.fill(bed, colour, Part.TRIM)
    c.shade(bed & (((c.y / 0.12) % 1.0) < 0.3), 0.75)
    gate = (c.column > TOPOLOGY_BELT) & between(c.station, d.length - 0.085, d.length - 0.075)
    c.shade(gate, _SEAM)


def _paint_large(c: TextureCanvas, name: str, paint: Colour, *, generator: torch.Generator) -> None:
    """Paints a lorry's box behind the gap to its cab, or the objects on a bus's roof."""
    d = c.body.dimensions
    draws = torch.rand(6, 4, generator=generator).tolist()
    above = c.upper & (c.column > 12)
    if name == "lorry":
        gap, tone = 1.9 + 0.6 * draws[0][0], 0.15 + 0.8 * draws[0][1]
        box = paint if draws[0][2] < 0.3 else (tone, tone, tone)
        c.fill(~c.floor & (c.z > 0.9) & between(c.behind, gap + 0.3, d.length), box, Part.BODY)
        c.fill(c.upper & between(c.station, gap, gap + 0.3), _BLACK, Part.TRIM)
        return
    for along, length, width, tone in draws[: 2 + int(d.length > 10) + int(4 * draws[5][0])]:
        middle, half = d.length * (0.12 + 0.76 * along), 0.4 + 1.1 * length
        thing = above & (c.y < 0.25 + 0.5 * width) & between(c.station - middle, -half, half)
        c.fill(thing, (0.12 + 0.7 * tone,) * 3, Part.TRIM)
        c.shade(thing & ~between(c.station - middle, 0.07 - half, half - 0.07), _SEAM)
    if d.length > 13:
        bellows = 0.5 * d.length + draws[5][1]
        c.fill(c.upper & between(c.station - bellows, -0.6, 0.6), (0.2, 0.19, 0.18), Part.TRIM)


def _dirty(texture: Tensor, z: Tensor, amount: float, *, generator: torch.Generator) -> Tensor:
    """Adds road dust to the lower body, and faint unevenness everywhere."""
    coarse = torch.randn(1, 1, 34, 34, generator=generator)
    (noise,) = torch.nn.functional.interpolate(coarse, size=TEXTURE_SIZE, mode="bicubic")
    dust = 0.30 * amount**2 * (1 - z / 0.9).clamp(0.0) * (1 + 0.5 * noise)
    share = (dust + 0.012 * noise.abs()).clamp(0.0, 0.5)
    return texture + share * (torch.tensor([0.42, 0.38, 0.32]).view(3, 1, 1) - texture)
