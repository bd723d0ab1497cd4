"""One universal texture map for all vehicles, under any combination of three constraints."""

from dataclasses import replace

import torch
from jaxtyping import Float, UInt8
from torch import Tensor, nn

from skyproof.camouflage.camouflage import Camouflage, random_part
from skyproof.camouflage.name import CamouflageName
from skyproof.errors import ConfigurationError
from skyproof.vehicles.vehicle import TEXTURE_SIZE, Overlay, Part, VehicleBatch

# In softmax(logits / temperature): from nearly free mixing to nearly one colour per texel.
_FIRST_TEMPERATURE = 1.0
_LAST_TEMPERATURE = 0.1
_PAPER_TAU = 0.5  # which the paper does not give
# Standard deviation, in sRGB, of optimised colours at the start around the given palette.
_PALETTE_SD = 0.05


class UniversalTexture(Camouflage):
    """Replaces every vehicle's texture by one map; a free random one is its own control.

    The map has three independent stages (section 3.3): a grid of values (512 x 512, or `blocks` x
    `blocks`), their colours (free, or mixed from a palette), and their place (everywhere, or on
    painted panels).

    With a palette every cell holds one logit per colour and shows the mixture softmax(logits /
    temperature). The temperature falls geometrically during an attack, and `finalise` keeps the
    most likely colour. A given palette has the fixed colours, or those at which optimised colours
    or free cells start, which are otherwise drawn uniformly.

    Differences from the paper: logits and annealing replace s(s(p)), which loses most of the
    optimisation (docs/attacks.md). Palettes are optimised in sRGB. The method "paper" has s(s(p)),
    s(r) = softmax(ln(r) / 0.5) over colours (section S4.2.3), and softmax(p) after every step.

    Attributes:
        cells: `[3, g, g]` sRGB in [0, 1]; or `[K, g, g]` logits, ln of uniform draws.
        palette: `[K, 3]` sRGB in [0, 1]; a parameter if optimised; absent if colours are free.
    """

    palette: Tensor
    temperature: Tensor
    finished: Tensor

    def __init__(
        self,
        name: CamouflageName,
        *,
        generator: torch.Generator,
        palette: Float[Tensor, "K 3"] | None = None,
        colours: int = 5,
        blocks: int = 32,
    ) -> None:
        super().__init__()
        self._in_paper_form = False
        if name.constraints is None:
            raise ConfigurationError(
                f"A texture expects a name with texture constraints, such as T-U, got {name}."
            )
        self.name = name
        self.constraints = name.constraints
        self.blocks = blocks if self.constraints.pixelised else TEXTURE_SIZE
        if self.blocks < 1 or TEXTURE_SIZE % self.blocks:
            raise ConfigurationError(
                f"Pix expects a number of blocks that divides the map's {TEXTURE_SIZE} texels a "
                f"side, got {blocks}; give for instance 32."
            )
        kind = self.constraints.colours
        if palette is not None:
            colours = len(palette)
        if kind != "free" and colours < 2:
            raise ConfigurationError(
                f"A palette expects at least 2 colours, got {colours}; give more colours."
            )
        grid = (self.blocks, self.blocks)
        if kind == "free":
            cells = torch.rand(3, *grid, generator=generator)
            if palette is not None:
                cells = palette[torch.randint(len(palette), grid, generator=generator)]
                cells = cells.permute(2, 0, 1).contiguous()
            self.cells = nn.Parameter(cells)
            self.learning_rates = {"cells": 1.2}
            return
        drawn = torch.rand(colours, *grid, generator=generator).clamp(min=1e-6)
        self.cells = nn.Parameter(drawn.log())
        # A logit has farther to go than a colour, which lies in [0, 1], and a palette's few colours
        # are moved by all cells (docs/attacks.md).
        self.learning_rates = {"cells": 2.4, "palette": 0.4}
        if kind == "fixed":
            assert palette is not None
            self.register_buffer("palette", palette.float().clone())
        elif palette is None:
            self.palette = nn.Parameter(torch.rand(colours, 3, generator=generator))
        else:
            apart = _PALETTE_SD * torch.randn(colours, 3, generator=generator)
            self.palette = nn.Parameter((palette + apart).clamp(0.0, 1.0))
        self.register_buffer("temperature", torch.tensor(_FIRST_TEMPERATURE))
        self.register_buffer("finished", torch.tensor(False))

    @property
    def restricted(self) -> bool:
        """Whether colours come from a palette."""
        return self.constraints.colours != "free"

    def map(self) -> Float[Tensor, "3 512 512"]:
        """Returns the whole map in sRGB, before any mask; differentiable."""
        grid = self._coloured() if self.restricted else self.cells
        side = TEXTURE_SIZE // self.blocks
        # Nearest neighbour: every cell becomes side x side texels.
        spread = grid[:, :, None, :, None].expand(-1, -1, side, -1, side)
        return spread.flatten(3, 4).flatten(1, 2)

    def _coloured(self) -> Float[Tensor, "3 g g"]:
        if self.finished:
            # The same as argmax, in a sixth of its time.
            return self.palette[self.cells.detach().max(0).indices].permute(2, 0, 1)
        logits = self.cells.log() if self._in_paper_form else self.cells
        weights = torch.softmax(logits / self.temperature, dim=0)
        return torch.einsum("kc,kij->cij", self.palette, weights)

    def bytes(self) -> UInt8[Tensor, "3 512 512"]:
        """Returns the map as its PNG holds it."""
        return (self.map().detach().clamp(0, 1) * 255).round().byte()

    def mask(self, vehicles: VehicleBatch) -> Tensor | None:
        """Returns where the map applies, as `[N, 512, 512]` bools; None for everywhere."""
        if not self.constraints.masked:
            return None
        mask = vehicles.parts == Part.BODY
        if not mask.any():
            raise ConfigurationError(
                f"The mask of {self.name} covers nothing: {vehicles.ids[0]} and all others of its "
                "batch have no painted body part; give vehicles whose part map has some, or leave "
                "out Ma."
            )
        return mask

    def forward(self, vehicles: VehicleBatch) -> VehicleBatch:
        """Puts this map on the vehicles as their texture, or over their own on painted panels."""
        mask = self.mask(vehicles)
        if mask is None:
            return replace(vehicles, texture=self.map()[None], overlay=None, repainted=True)
        return replace(vehicles, overlay=Overlay(self.map(), mask))

    @torch.no_grad()
    def paper_form_(self, on: bool) -> None:
        """Turns the cells of a palette into probabilities p, or back into logits.

        s(s(p)) is softmax(ln(p) / τ²), the usual mixture of logits ln(p) at a fixed temperature.
        """
        if not self.restricted or self.finished or on == self._in_paper_form:
            return
        self.cells.copy_(torch.softmax(self.cells, dim=0) if on else self.cells.log())
        self.temperature.fill_(_PAPER_TAU**2)
        self._in_paper_form = on

    def before_step_(self, step: int, steps: int) -> None:
        """Lowers the temperature, geometrically."""
        if self.restricted and not (self.finished or self._in_paper_form):
            share = (step - 1) / max(steps - 1, 1)
            fall = _LAST_TEMPERATURE / _FIRST_TEMPERATURE
            self.temperature.fill_(_FIRST_TEMPERATURE * fall**share)

    @torch.no_grad()
    def project_(self) -> None:
        colours = self.palette if self.restricted else self.cells
        colours.clamp_(0.0, 1.0)
        if self._in_paper_form:
            self.cells.copy_(torch.softmax(self.cells, dim=0))

    @torch.no_grad()
    def vary_(self, generator: torch.Generator) -> None:
        """Recolours a rectangle or, in a quarter of changes, an entry of an optimised palette."""
        if self.constraints.colours == "learnt" and torch.rand((), generator=generator) < 0.25:
            row = int(torch.randint(len(self.palette), (), generator=generator))
            self.palette[row] = torch.rand(3, generator=generator).to(self.palette)
            return
        rows, columns = random_part(self.blocks, generator=generator)
        if self.restricted:
            colour = int(torch.randint(len(self.palette), (), generator=generator))
            self.cells[:, rows, columns] = -1.0
            self.cells[colour, rows, columns] = 0.0
        else:
            self.cells[:, rows, columns] = torch.rand(3, 1, 1, generator=generator).to(self.cells)

    @torch.no_grad()
    def finalise(self) -> None:
        """Leaves one colour per cell, of the 8 bits per channel that the PNG holds."""
        self.paper_form_(False)
        colours = self.palette if self.restricted else self.cells
        colours.copy_((colours.clamp(0.0, 1.0) * 255).round() / 255)
        if self.restricted:
            self.finished.fill_(True)
