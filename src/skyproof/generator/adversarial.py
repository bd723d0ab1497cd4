"""A generator of vehicles like the paper's: a small textured 3D GAN in UV space.

Source: Pavllo et al., "Convolutional generation of textured 3D meshes" (2020), whose network the
paper trains anew so that it gives a part map, too. Differences: 64 x 64 texels instead of 512 x
512, and unconditional; the part map is an output; the fitted maps are those of our own renderer.
"""

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor, nn

from skyproof.generator.fleet import LearntVehicle
from skyproof.generator.maps import part_map, texture_map, vertices_of
from skyproof.vehicles.template import COLUMNS, RINGS
from skyproof.vehicles.vehicle import Part

LATENT = 32
PARTS = len(Part)
_GRID = (RINGS + 2, COLUMNS // 2 + 1)
_LARGEST_M = 20.0


class _Block(nn.Module):
    """Doubles the size, then applies two convolutions beside a shortcut."""

    def __init__(self, channels_in: int, channels_out: int) -> None:
        super().__init__()
        self.first = nn.Conv2d(channels_in, channels_out, 3)
        self.second = nn.Conv2d(channels_out, channels_out, 3)
        self.short = nn.Conv2d(channels_in, channels_out, 1)
        self.norms = nn.ModuleList([nn.GroupNorm(8, channels_in), nn.GroupNorm(8, channels_out)])

    def forward(self, maps: Tensor) -> Tensor:
        large = F.interpolate(F.leaky_relu(self.norms[0](maps), 0.2), scale_factor=2)
        changed = F.leaky_relu(self.norms[1](self.first(_mirrored(large))), 0.2)
        changed = self.second(_mirrored(changed))
        return changed + self.short(F.interpolate(maps, scale_factor=2))


def _mirrored(half: Tensor) -> Tensor:
    """Pads a left half at the sides by its reflection; values at nose and tail are repeated."""
    sides = torch.cat((half[..., :1], half, half[..., -1:]), dim=-1)
    return F.pad(sides, (0, 0, 1, 1), mode="replicate")


class Network(nn.Module):
    """Maps latent vectors to left halves: albedo, shares of parts, and displacement."""

    mean: Tensor
    spread: Tensor

    def __init__(self, mean: Tensor, spread: Tensor) -> None:
        super().__init__()
        self.start = nn.Linear(LATENT, 128 * 8 * 4)
        self.blocks = nn.Sequential(_Block(128, 96), _Block(96, 64), _Block(64, 48))
        self.norm = nn.GroupNorm(8, 48)
        self.head = nn.Conv2d(48, 3 + PARTS + 3, 3)
        self.register_buffer("mean", mean)
        self.register_buffer("spread", spread)

    def forward(self, latent: Float[Tensor, "N 32"]) -> tuple[Tensor, Tensor, Tensor]:
        """Returns albedo in [0, 1], shares that sum to 1, and displacement in its own units."""
        maps = self.blocks(self.start(latent).view(-1, 128, 8, 4))
        out = self.head(_mirrored(F.leaky_relu(self.norm(maps), 0.2)))
        albedo, parts, moved = out.split((3, PARTS, 3), dim=1)
        return torch.sigmoid(albedo), torch.softmax(2 * parts, dim=1), moved

    def grid(self, moved: Float[Tensor, "N 3 64 32"]) -> Float[Tensor, "N 3 33 17"]:
        """Returns the surface that a displacement leads to, in metres."""
        coarse = F.interpolate(moved, size=_GRID, mode="bilinear", align_corners=True)
        return self.mean + self.spread * coarse


class AdversarialGenerator:
    """Vehicles that a trained network makes of random numbers."""

    method = "gan"

    def __init__(self, network: Network) -> None:
        self.network = network.eval()

    @torch.no_grad()
    def decode(self, latent: Float[Tensor, " 32"]) -> LearntVehicle:
        """Makes the vehicle that a latent vector stands for."""
        albedo, shares, moved = self.network(latent[None])
        parts = part_map(shares[0])
        vertices = vertices_of(self.network.grid(moved)[0])
        # It stands on the ground.
        vertices[:, 2] -= vertices[:, 2].min()
        return LearntVehicle("learnt", vertices, texture_map(albedo[0], shares[0], parts), parts)

    def sample(self, generator: torch.Generator) -> LearntVehicle:
        """Makes a vehicle."""
        return self.decode(torch.randn(LATENT, generator=generator))

    def tensors(self) -> dict[str, Tensor]:
        """Returns all that was learnt, for a file."""
        return dict(self.network.state_dict())

    @classmethod
    def of(cls, tensors: dict[str, Tensor]) -> "AdversarialGenerator":
        """Restores a generator from what `tensors` returned.

        Raises:
            RuntimeError, ValueError: the tensors are those of another network.
        """
        network = Network(torch.zeros(1, 3, *_GRID), torch.ones(1, 3, *_GRID))
        network.load_state_dict(tensors)
        made = cls(network)
        vertices = made.decode(torch.zeros(LATENT)).vertices
        if not float(vertices.abs().amax()) < _LARGEST_M:
            raise ValueError("no vehicles come of it")
        return made
