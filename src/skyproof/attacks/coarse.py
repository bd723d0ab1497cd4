"""A camouflage changed by a few numbers: offsets on bands of it, from nose to tail.

A query attack cannot try 800,000 texels one by one, but it can search a dozen numbers. Over an
optimised camouflage they keep the detail and change the whole.
"""

import copy
import math

import numpy as np
import torch
from jaxtyping import Float
from torch import nn

from skyproof.camouflage.camouflage import Camouflage
from skyproof.camouflage.combination import Combination
from skyproof.camouflage.displacement import DisplacementMap
from skyproof.camouflage.texture import UniversalTexture
from skyproof.errors import ConfigurationError

MOST_NUMBERS = 60

# With as many images, 48 numbers (4 x 4 fields) found nothing better than their start, and 12 (4
# bands) did: docs/attacks.md.
_TEXTURE_BANDS = 4
_SHAPE_BANDS = 8


class CoarseChange:
    """Offsets on bands across the cells of a texture (sRGB), or across the reach of a shape.

    The start is a finished camouflage and is not changed. Of a combination the shape moves.

    Raises:
        ConfigurationError: a camouflage of another kind, or of few colours.
    """

    def __init__(self, start: Camouflage) -> None:
        self._start = start
        moved = _moved(start)
        # A shape has one value a place.
        channels, bands = (len(moved), _TEXTURE_BANDS) if moved.ndim == 3 else (1, _SHAPE_BANDS)
        self.shape = (channels, max(1, min(bands, MOST_NUMBERS // channels)))

    @property
    def count(self) -> int:
        """The number of offsets."""
        return math.prod(self.shape)

    def __call__(self, numbers: Float[np.ndarray, " K"]) -> Camouflage:
        """Gives the finished camouflage of some offsets; zeros give the start."""
        changed = copy.deepcopy(self._start)
        moved = _moved(changed)
        offsets = torch.as_tensor(numbers, dtype=moved.dtype).reshape(self.shape)
        rows = moved.shape[-2]
        band = ((torch.arange(rows) + 0.5) * self.shape[1] / rows).long()
        by_row = offsets[:, band].reshape(*moved.shape[:-1], 1).to(moved.device)
        with torch.no_grad():
            moved.add_(by_row)
        changed.project_()
        changed.finalise()
        return changed.requires_grad_(False)


def _moved(camouflage: Camouflage) -> nn.Parameter:
    part: nn.Module = camouflage.shape if isinstance(camouflage, Combination) else camouflage
    if isinstance(part, UniversalTexture) and not part.restricted:
        return part.cells
    if isinstance(part, DisplacementMap):
        return part.reach
    raise ConfigurationError(
        f"{camouflage.name} is neither a texture of free colours nor a shape, so there is nothing "
        "to move by degrees; give one that skyproof made."
    )
