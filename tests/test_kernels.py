"""Kernels beside torch: where they are compiled, and what a user sees of that."""

import dataclasses
import os
import re
import subprocess
import sys

import pytest
import torch
import warp as wp

from skyproof import kernels
from skyproof.errors import ConfigurationError
from skyproof.geometry import triangles
from skyproof.geometry.rasterise import rasterise
from skyproof.kernels import struct
from skyproof.render import composite, layers, linear_texture
from skyproof.render.kernels import canvas, shadow, surface, surface_gradients, texture
from skyproof.render.kernels.canvas import ImageLayers
from skyproof.render.renderer import TorchRenderer
from tests.render.bodies import PlainGround, scene, vehicles

DRAW = """
import torch
from skyproof.geometry.rasterise import rasterise, visible_faces
corners = torch.tensor([[[0.0, 0.0], [0.0, 8.0], [8.0, 0.0]]])
seen = rasterise(corners, torch.zeros(1, 3), torch.tensor([[0, 1, 2]]), 8)
again = rasterise(corners, torch.zeros(1, 3), torch.tensor([[0, 1, 2]]), 8)
print(int((visible_faces(seen) >= 0).sum()), int((visible_faces(again) >= 0).sum()))
"""


def draw(**changes):
    """Draws a triangle in a process of its own."""
    given = {key: value for key, value in os.environ.items() if not key.startswith("WARP_")}
    return subprocess.run(
        [sys.executable, "-c", DRAW],
        capture_output=True,
        text=True,
        env=given | changes,
        timeout=120,
    )


def test_compiling_is_told_once_and_nothing_else_is(tmp_path):
    first = draw(WARP_CACHE_PATH=str(tmp_path))
    told, *drawn = first.stdout.splitlines()
    assert "compiling the renderer, once per machine" in told
    assert drawn == ["36 36"]
    second = draw(WARP_CACHE_PATH=str(tmp_path))
    assert second.stdout.splitlines() == ["36 36"]
    assert first.stderr == second.stderr == ""


def test_where_no_folder_can_be_made_the_renderer_is_compiled_for_one_run(tmp_path):
    # Not even root makes a folder below a file.
    (tmp_path / "file").write_text("")
    done = draw(WARP_CACHE_PATH=str(tmp_path / "file"), TMPDIR=str(tmp_path))
    told, drawn = done.stdout.splitlines()
    assert "compiling the renderer, for this run alone" in told
    assert f"{tmp_path / 'file'}" in told
    assert drawn == "36 36"
    assert done.stderr == ""
    # Nothing stays.
    assert [each.name for each in tmp_path.iterdir()] == ["file"]


def test_errors_of_others_still_reach_the_terminal():
    loud = "import skyproof.kernels as a, os\nwith a._without_the_drivers_line():\n"
    loud += "    os.write(2, b'Could not find or load the NVIDIA CUDA driver\\nreal error\\n')\n"
    done = subprocess.run([sys.executable, "-c", loud], capture_output=True, text=True, check=True)
    assert done.stderr == "real error\n"


def test_a_device_without_kernels_is_refused():
    corners, depth = torch.zeros(1, 3, 2, device="meta"), torch.zeros(1, 3, device="meta")
    faces = torch.zeros(1, 3, dtype=torch.long, device="meta")
    with pytest.raises(ConfigurationError, match=r"got meta; update the driver, or give --device"):
        rasterise(corners, depth, faces, 8)


@pytest.mark.parametrize("module", [triangles, texture, canvas, shadow, surface, surface_gradients])
def test_kernels_compile_for_cuda(module, tmp_path):
    # The compiler comes with Warp and needs no device.
    wp.compile_aot_module(module, arch=75, use_ptx=True, module_dir=str(tmp_path))
    (written,) = tmp_path.glob("*.ptx")
    own = [name for name, each in vars(module).items() if isinstance(each, wp.Kernel)]
    compiled = re.findall(r"\.entry (\w+)_cuda_kernel_forward", written.read_text())
    assert own
    assert all(any(name in each for each in compiled) for name in own)


def test_a_thread_for_each_pixel_draws_what_a_thread_for_each_row_draws(monkeypatch):
    """As on CUDA, where rows have as many threads as pixels."""

    def drawn():
        batch = vehicles(2, seed=3)
        texture, vertices = (
            each.clone().requires_grad_() for each in (batch.texture, batch.vertices)
        )
        batch = dataclasses.replace(batch, texture=texture, vertices=vertices)
        where = [scene((0.3, 0.2, 30.0), (-3.0, 3.0, 100.0))]
        image = TorchRenderer(PlainGround(0.4))(where, batch).image
        image.square().sum().backward()
        return image.detach(), texture.grad, vertices.grad

    threads = []

    def by_pixel(kernel, dim, *arguments):
        threads.append(dim[2])
        kernels.launch(kernel, dim[:3], *arguments, dim[2])

    by_row = drawn()
    for module in (layers, composite, linear_texture):
        monkeypatch.setattr(module, "rows", by_pixel)
    for one, other in zip(by_row, drawn(), strict=True):
        assert torch.equal(one, other)
    assert len(threads) > 10
    assert min(threads) > 20


def test_tensors_on_two_devices_are_refused():
    with pytest.raises(ValueError, match="one device"):
        struct(ImageLayers, first=torch.zeros(1), vehicles=torch.zeros(1, device="meta"))
