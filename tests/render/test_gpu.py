"""One code path for CPU and GPU: the same pictures and gradients on both."""

import dataclasses

import pytest
import torch

from skyproof.render.renderer import TorchRenderer
from tests.render.bodies import PlainGround, scene, vehicles

pytestmark = [
    pytest.mark.gpu,
    pytest.mark.skipif(not torch.cuda.is_available(), reason="no CUDA device"),
]


def draw(device):
    batch = vehicles(2, seed=3).to(device)
    texture = batch.texture.clone().requires_grad_()
    vertices = batch.vertices.clone().requires_grad_()
    worn = dataclasses.replace(batch, texture=texture, vertices=vertices)
    image = TorchRenderer(PlainGround(0.4))(
        [scene((0.3, 0.2, 30.0), (-3.0, 3.0, 100.0))], worn
    ).image
    image.square().sum().backward()
    return image.detach().cpu(), texture.grad.cpu(), vertices.grad.cpu()


def test_the_gpu_draws_what_the_cpu_draws():
    on_cpu, on_gpu = draw("cpu"), draw("cuda")
    torch.testing.assert_close(on_gpu[0], on_cpu[0], atol=2e-3, rtol=0)
    for ours, theirs in zip(on_gpu[1:], on_cpu[1:], strict=True):
        assert (
            torch.nn.functional.cosine_similarity(ours.flatten(), theirs.flatten(), dim=0) > 0.999
        )
