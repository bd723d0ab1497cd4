"""What a feature pyramid holds in regions: RoIAlign with one sample in each bin, made fast."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from jaxtyping import Float, Int
from torch import Tensor
from torch.nn import functional
from torchvision import ops

from skyproof.detectors.features import area_levels


class CentreAlign(ops.MultiScaleRoIAlign):
    """RoIAlign (He et al. 2017) that looks at the centre of every bin.

    It gives what torchvision's `MultiScaleRoIAlign` with `sampling_ratio=1` gives, which on a CPU
    takes 40 % of an attack's step on the slim Faster R-CNN for its backward pass: that adds
    channel by channel. Here a sample is a weighted sum of four rows of channels, all of them at
    once, and so is its gradient.

    Args:
        strides_px: of the pyramid's levels, each twice the one before.
        output_size: bins along each side of a region.
    """

    def __init__(self, strides_px: Sequence[float], output_size: int) -> None:
        names = [str(level) for level in range(len(strides_px))]
        super().__init__(names, output_size, sampling_ratio=1)
        self.strides_px = tuple(strides_px)

    def forward(
        self,
        x: dict[str, Float[Tensor, "B C _ _"]],
        boxes: list[Float[Tensor, "_ 4"]],
        image_shapes: list[tuple[int, int]],
    ) -> Float[Tensor, "K C S S"]:
        """Samples every region on the level that is right for its size.

        Args:
            x: levels of the pyramid by name, the finest first.
            boxes: per image its regions, pixel xyxy; no gradient flows to them.
            image_shapes: as torchvision gives them; the strides are known without.
        """
        pyramid = list(x.values())
        side, _ = self.output_size
        # Rows of channels: pixel after pixel, image after image, level after level.
        rows = torch.cat([level.permute(0, 2, 3, 1).flatten(0, 2) for level in pyramid])
        indices, shares = self._samples(pyramid, boxes)
        sampled = functional.embedding_bag(indices, rows, mode="sum", per_sample_weights=shares)
        return sampled.view(-1, side * side, rows.shape[1]).mT.unflatten(2, (side, side))

    @torch.no_grad()
    def _samples(
        self, pyramid: Sequence[Tensor], boxes: Sequence[Tensor]
    ) -> tuple[Int[Tensor, "N 4"], Float[Tensor, "N 4"]]:
        """Gives the four rows around every sample, and the share that each has of it."""
        side, _ = self.output_size
        regions = torch.cat(list(boxes))
        levels = area_levels(self.strides_px)(regions)
        device = regions.device
        counts = torch.tensor([len(own) for own in boxes], device=device)
        images = torch.arange(len(boxes), device=device).repeat_interleave(counts)

        # Where each level lies in the rows, and how large it is.
        shapes = torch.tensor([level.shape[-2:] for level in pyramid], device=device)
        heights, widths = shapes[levels].unbind(1)
        starts = torch.tensor([0, *(level[:, 0].numel() for level in pyramid[:-1])], device=device)
        first_rows = starts.cumsum(0)[levels] + images * heights * widths

        # Centres of the bins; torchvision makes no region smaller than one pixel of its level.
        strides = torch.tensor(self.strides_px, device=device, dtype=regions.dtype)[levels]
        corners = regions / strides[:, None]
        lengths = (corners[:, 2:] - corners[:, :2]).clamp(min=1)
        steps = (torch.arange(side, device=device) + 0.5) / side
        xs, ys = (corners[:, axis, None] + lengths[:, axis, None] * steps for axis in (0, 1))
        columns, column_shares = _neighbours(xs, widths)
        lines, line_shares = _neighbours(ys, heights)

        # Every line of a region with every column of it: [regions, side, side, 2, 2].
        places = lines[:, :, None, :, None] * widths[:, None, None, None, None]
        places = places + columns[:, None, :, None, :] + first_rows[:, None, None, None, None]
        shares = line_shares[:, :, None, :, None] * column_shares[:, None, :, None, :]
        return places.view(-1, 4), shares.view(-1, 4)


def _neighbours(
    places: Float[Tensor, "K S"], lengths: Int[Tensor, " K"]
) -> tuple[Int[Tensor, "K S 2"], Float[Tensor, "K S 2"]]:
    """Gives the two pixels around each place along an axis, and their shares.

    Within a pixel beyond the border it is the border's own value, further out nothing, as in
    torchvision.
    """
    last = (lengths - 1)[:, None]
    inside = (places >= -1) & (places <= lengths[:, None])
    low = places.clamp(min=0).floor().long().minimum(last)
    high = (low + 1).minimum(last)
    share = torch.where(low < last, places.clamp(min=0) - low, 0.0)
    shares = torch.stack([1 - share, share], dim=-1) * inside[..., None]
    return torch.stack([low, high], dim=-1), shares
