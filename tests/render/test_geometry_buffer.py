"""What scenes share whatever their vehicles wear is worked out once, and changes no picture."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import pytest
import torch
import warp as wp

from skyproof.camouflage.make import make_camouflage
from skyproof.camouflage.paint import plain_paint
from skyproof.render import renderer as module
from skyproof.render.frames import Frames
from skyproof.render.renderer import GeometryBuffers, TorchRenderer
from skyproof.scenes.scene import Scene
from skyproof.scenes.weather import Weather
from skyproof.vehicles.fleet import FleetSettings, sample_fleet
from skyproof.vehicles.vehicle import VehicleBatch
from tests.render.bodies import PlainGround, scene

PALETTE = torch.tensor([[0.2, 0.2, 0.2], [0.4, 0.5, 0.3], [0.6, 0.5, 0.4]])


@pytest.fixture(scope="module")
def scenes() -> list[Scene]:
    """Two pictures, one of them in the rain, with three vehicles that hide each other."""
    first = scene((0.0, 0.0, 20.0), (1.5, 1.0, 110.0), size_px=64, seed=3)
    second = scene((-1.0, 0.5, 130.0), size_px=64, name="s1")
    return [first, dataclasses.replace(second, weather=Weather("rain", wetness=0.8, overcast=0.6))]


@pytest.fixture(scope="module")
def vehicles() -> VehicleBatch:
    fleet = sample_fleet(FleetSettings(count=2), generator=torch.Generator().manual_seed(0))
    first, second = fleet.ids
    return fleet.batch([first, second, first])


def coats(vehicles: VehicleBatch) -> list[VehicleBatch]:
    """The vehicles as they are, in a texture, in paint on panels alone, in blocks, and in a shape.

    The first comes again at the end.
    """
    draw = torch.Generator().manual_seed(1)
    names = ("R-U", "R-PixFcMa", "R-S-O@0.4")
    drawn = [make_camouflage(name, generator=draw, palette=PALETTE) for name in names]
    worn = [coat(vehicles) for coat in (*drawn, plain_paint((200, 30, 30), masked=True))]
    return [vehicles, *worn, vehicles]


def assert_equal(one: Frames, other: Frames) -> None:
    for field in dataclasses.fields(Frames):
        first, second = getattr(one, field.name), getattr(other, field.name)
        assert (first is None) == (second is None)
        assert first is None or torch.equal(first, second), field.name


@torch.no_grad()
@pytest.mark.parametrize("masks", [False, True])
def test_pictures_are_those_of_a_renderer_that_has_drawn_nothing(scenes, vehicles, masks):
    kept = TorchRenderer(PlainGround(None))
    for worn in coats(vehicles):
        fresh = TorchRenderer(PlainGround(None))
        assert_equal(kept(scenes, worn, masks=masks), fresh(scenes, worn, masks=masks))


def counted(monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """How many vehicles were looked at, each time that it was done."""
    looked: list[int] = []
    genuine = module.see_bodies

    def see(*arguments: object) -> object:
        looked.append(len(arguments[0].scene))
        return genuine(*arguments)

    monkeypatch.setattr(module, "see_bodies", see)
    return looked


@torch.no_grad()
def test_bodies_are_looked_at_once_for_all_textures(monkeypatch, scenes, vehicles):
    looked = counted(monkeypatch)
    renderer = TorchRenderer(PlainGround())
    for worn in coats(vehicles):
        renderer(scenes, worn)
    # The shape is another body, and takes the place of the first.
    assert looked == [3, 3, 3]


@torch.no_grad()
def test_equal_scenes_that_are_others_are_looked_at_anew(monkeypatch, scenes, vehicles):
    looked = counted(monkeypatch)
    renderer = TorchRenderer(PlainGround())
    renderer(scenes, vehicles)
    renderer([dataclasses.replace(each) for each in scenes], vehicles)
    renderer(scenes[::-1], vehicles)
    assert looked == [3, 3, 3]


def test_steps_of_an_attack_keep_nothing(monkeypatch, scenes, vehicles):
    looked = counted(monkeypatch)
    renderer = TorchRenderer(PlainGround())
    for _ in range(2):
        moved = dataclasses.replace(vehicles, vertices=vehicles.vertices.clone().requires_grad_())
        renderer(scenes, moved).image.sum().backward()
        assert moved.vertices.grad.abs().sum() > 0
    assert looked == [3, 3]


@torch.no_grad()
def test_a_picture_may_be_written_over(scenes, vehicles):
    renderer = TorchRenderer(PlainGround())
    first = renderer(scenes, vehicles).image
    expected = first.clone()
    first.zero_()
    assert torch.equal(renderer(scenes, vehicles).image, expected)


def storages(value: object) -> dict[int, int]:
    """The bytes of all memory that lies behind something, by address."""
    if isinstance(value, torch.Tensor):
        storage = value.untyped_storage()
        return {storage.data_ptr(): storage.nbytes()}
    if isinstance(value, wp.array):
        return {value.ptr: value.capacity}
    inner = value if isinstance(value, tuple) else vars(value).values()
    ours = type(value).__module__.startswith(("skyproof", "warp._src.codegen"))
    found: dict[int, int] = {}
    for each in inner if ours or isinstance(value, tuple) else ():
        if isinstance(each, torch.Tensor | tuple | wp.array) or hasattr(each, "__dict__"):
            found |= storages(each)
    return found


@torch.no_grad()
def test_a_buffer_takes_about_as_much_memory_as_it_says(scenes, vehicles):
    buffer = TorchRenderer(PlainGround())._look(scenes, vehicles)
    # Ground and bodies, which are most of it; what the sun saw is not kept.
    assert buffer.memory_bytes == pytest.approx(sum(storages(buffer).values()), rel=0.25)


@torch.no_grad()
@pytest.mark.parametrize(("room", "again"), [(1.0, 0), (0.8, 2), (0.0, 4)])
def test_with_little_room_the_first_of_each_turn_are_kept(
    monkeypatch, scenes, vehicles, room, again
):
    turn: Sequence[Scene] = [dataclasses.replace(scenes[1], seed=seed) for seed in range(4)]
    one = vehicles.row(0)
    each_bytes = TorchRenderer(PlainGround())._look(turn[:1], one).memory_bytes
    monkeypatch.setattr(GeometryBuffers, "most_bytes", int(room * 4 * each_bytes))
    renderer = TorchRenderer(PlainGround())
    for each in turn:
        renderer([each], one)
    looked = counted(monkeypatch)
    for each in turn:
        renderer([each], one)
    assert len(looked) == again
