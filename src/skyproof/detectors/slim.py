"""The backbone of the slim detectors, small enough to train from scratch on a CPU."""

from collections import OrderedDict

from jaxtyping import Float
from torch import Tensor, nn
from torch.nn import functional
from torchvision.ops import FeaturePyramidNetwork

STAGE_CHANNELS = (24, 48, 96, 128)
"""Channels at strides 2, 4, 8 and 16."""
PYRAMID_CHANNELS = 64
"""Channels of the feature pyramid and of the heads on it; a multiple of 8."""
REGION_CHANNELS = 192
"""Numbers in each hidden layer of Faster R-CNN's region head."""


def _convolution(inputs: int, outputs: int, stride: int = 1) -> nn.Sequential:
    return nn.Sequential(
        nn.Conv2d(inputs, outputs, 3, stride=stride, padding=1, bias=False),
        nn.BatchNorm2d(outputs),
        nn.ReLU(inplace=True),
    )


class _Residual(nn.Module):
    """Two 3x3 convolutions beside the identity; the second starts at zero, for easy training."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.first = _convolution(channels, channels)
        self.second = nn.Conv2d(channels, channels, 3, padding=1, bias=False)
        self.normalise = nn.BatchNorm2d(channels)
        nn.init.zeros_(self.normalise.weight)

    def forward(self, features: Float[Tensor, "B C h w"]) -> Float[Tensor, "B C h w"]:
        return functional.relu(features + self.normalise(self.second(self.first(features))))


class SlimBackbone(nn.Module):
    """Four stages with a feature pyramid at strides 8 and 16.

    A vehicle of 36x15 px spans 4.5x2 cells at stride 8; it would vanish at stride 32.
    """

    def __init__(self) -> None:
        super().__init__()
        first, second, third, fourth = STAGE_CHANNELS
        self.out_channels = PYRAMID_CHANNELS
        self.to_stride_4 = nn.Sequential(
            _convolution(3, first, stride=2),
            _convolution(first, second, stride=2),
            _Residual(second),
        )
        self.to_stride_8 = nn.Sequential(_convolution(second, third, stride=2), _Residual(third))
        self.to_stride_16 = nn.Sequential(_convolution(third, fourth, stride=2), _Residual(fourth))
        self.pyramid = FeaturePyramidNetwork([third, fourth], PYRAMID_CHANNELS)

    def forward(self, images: Float[Tensor, "B 3 H W"]) -> OrderedDict[str, Tensor]:
        stride_8 = self.to_stride_8(self.to_stride_4(images))
        return self.pyramid(OrderedDict([("0", stride_8), ("1", self.to_stride_16(stride_8))]))
