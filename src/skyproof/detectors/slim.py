"""The small backbone of the slim and wide detectors: trained from nothing on a CPU."""

from __future__ import annotations

from collections import OrderedDict
from dataclasses import dataclass

from jaxtyping import Float
from torch import Tensor, nn
from torch.nn import functional
from torchvision.ops import FeaturePyramidNetwork


@dataclass(frozen=True)
class Widths:
    """How wide a small network is.

    Attributes:
        stages: channels at strides 2, 4, 8 and 16.
        pyramid: channels of the feature pyramid and of the heads on it; a multiple of 8.
        region: numbers in each hidden layer of Faster R-CNN's region head.
    """

    stages: tuple[int, int, int, int]
    pyramid: int
    region: int


# Wide is one and a half times slim everywhere: 2.2 times its parameters.
WIDTHS = {
    "slim": Widths(stages=(24, 48, 96, 128), pyramid=64, region=192),
    "wide": Widths(stages=(36, 72, 144, 192), pyramid=96, region=288),
}


def _convolution(inputs: int, outputs: int, stride: int = 1) -> nn.Sequential:
    return nn.Sequential(
        nn.Conv2d(inputs, outputs, 3, stride=stride, padding=1, bias=False),
        nn.BatchNorm2d(outputs),
        nn.ReLU(inplace=True),
    )


class _Residual(nn.Module):
    """Two 3x3 convolutions beside the identity.

    The second starts at zero, so that depth costs no trainability.
    """

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

    A vehicle of 36x15 px spans 4.5x2 cells at stride 8; stride 32 would hold no vehicle.

    Args:
        widths: channels of the stages and of the pyramid.
    """

    def __init__(self, widths: Widths) -> None:
        super().__init__()
        first, second, third, fourth = widths.stages
        self.out_channels = widths.pyramid
        self.to_stride_4 = nn.Sequential(
            _convolution(3, first, stride=2),
            _convolution(first, second, stride=2),
            _Residual(second),
        )
        self.to_stride_8 = nn.Sequential(_convolution(second, third, stride=2), _Residual(third))
        self.to_stride_16 = nn.Sequential(_convolution(third, fourth, stride=2), _Residual(fourth))
        self.pyramid = FeaturePyramidNetwork([third, fourth], widths.pyramid)

    def forward(self, images: Float[Tensor, "B 3 H W"]) -> OrderedDict[str, Tensor]:
        stride_8 = self.to_stride_8(self.to_stride_4(images))
        return self.pyramid(OrderedDict([("0", stride_8), ("1", self.to_stride_16(stride_8))]))
