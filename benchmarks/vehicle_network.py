"""The small convolutional network that finds vehicles by default, as it is trained.

A fully convolutional network in the manner of CenterNet (Zhou et al. 2019, "Objects as points") and
FCOS (Tian et al. 2019): from an image, its difference from the empty road and its difference from
an image shortly before, for each cell of 4 × 4 pixels, how sure it is that a vehicle has its middle
there, how far away the sides of its box are, and its class.
"""

from __future__ import annotations

from pathlib import Path

import torch
from torch import Tensor, nn
from torch.nn import functional

from geoorbit_ros.detection.network.channels import CHANNELS, STRIDE_PX

CLASSES = ("car", "motorcycle", "bus", "truck", "bicycle")
"""In the order of the network's outputs."""
WIDTHS = (16, 32, 64, 96, 128)
"""Channels at strides of 2, 4, 8, 16 and 32 pixels."""
CAUTION = 0.7
"""Taken from the middles' logit when the network is written, so that a score of 0.25, from which on
boxes are reported unless the user says otherwise, is where false boxes are about as many as missed
vehicles in films that were kept away. Chosen: larger misses more, smaller invents more."""
RARE = -4.0
"""First value of the middles' logit: vehicles are rare."""
OPSET = 17


def convolution(
    inner: int, outer: int, side: int = 3, stride: int = 1, groups: int = 1
) -> nn.Module:
    """A convolution, batch normalisation and ReLU."""
    return nn.Sequential(
        nn.Conv2d(inner, outer, side, stride, side // 2, groups=groups, bias=False),
        nn.BatchNorm2d(outer),
        nn.ReLU(inplace=True),
    )


class Bottleneck(nn.Module):
    """Residual block of 1 × 1, 3 × 3 and 1 × 1 convolutions (He et al. 2016)."""

    def __init__(self, channels: int, narrow: int) -> None:
        super().__init__()
        self.inside = nn.Sequential(
            convolution(channels, narrow, 1),
            convolution(narrow, narrow),
            nn.Conv2d(narrow, channels, 1, bias=False),
            nn.BatchNorm2d(channels),
        )

    def forward(self, values: Tensor) -> Tensor:
        """The values, corrected."""
        return functional.relu(values + self.inside(values))


class Upward(nn.Module):
    """Coarse features, twice as large, joined with fine ones (Lin et al. 2017)."""

    def __init__(self, coarse: int, fine: int, channels: int, narrow: int) -> None:
        super().__init__()
        self.coarse = convolution(coarse, channels, 1)
        self.fine = convolution(fine, channels, 1)
        self.mix = Bottleneck(channels, narrow)

    def forward(self, coarse: Tensor, fine: Tensor) -> Tensor:
        """Both at the fine one's size."""
        larger = functional.interpolate(self.coarse(coarse), scale_factor=2.0, mode="nearest")
        mixed: Tensor = self.mix(larger + self.fine(fine))
        return mixed


class VehicleNetwork(nn.Module):
    """(N, CHANNELS, H, W) from 0 to 1 -> (N, 5 + classes, H / 4, W / 4).

    H and W are multiples of 32. The first output is the logit of a middle, the next four are the
    logarithms of the distances to left, top, right and bottom in cells, the others class logits.
    """

    def __init__(self) -> None:
        super().__init__()
        second, fourth, eighth, sixteenth, last = WIDTHS
        self.at2 = convolution(CHANNELS, second, stride=2)
        self.at4 = nn.Sequential(convolution(second, fourth, stride=2), Bottleneck(fourth, 16))
        self.at8 = nn.Sequential(
            convolution(fourth, eighth, stride=2), *(Bottleneck(eighth, 32) for _ in range(2))
        )
        self.at16 = nn.Sequential(
            convolution(eighth, sixteenth, stride=2), *(Bottleneck(sixteenth, 48) for _ in range(3))
        )
        self.at32 = nn.Sequential(
            convolution(sixteenth, last, stride=2), *(Bottleneck(last, 64) for _ in range(3))
        )
        self.up16 = Upward(last, sixteenth, sixteenth, 48)
        self.up8 = Upward(sixteenth, eighth, eighth, 32)
        self.up4 = Upward(eighth, fourth, 32, 16)
        self.head = nn.Sequential(convolution(32, 32, 5, groups=32), convolution(32, 48, 1))
        self.out = nn.Conv2d(48, 5 + len(CLASSES), 1)
        start = torch.tensor([RARE] + [1.0] * 4 + [0.0] * len(CLASSES))
        self.out.bias = nn.Parameter(start)

    def forward(self, image: Tensor) -> Tensor:
        """See the class."""
        at4 = self.at4(self.at2(image))
        at8 = self.at8(at4)
        at16 = self.at16(at8)
        up16 = self.up16(self.at32(at16), at16)
        found: Tensor = self.out(self.head(self.up4(self.up8(up16, at8), at4)))
        return found


class Deployed(nn.Module):
    """(1, H, W, CHANNELS) uint8 -> (5 + classes, H / 4, W / 4) as the detector reads it.

    The first output is the score of a middle, 0 where a cell beside has more; the next four are
    distances in pixels; the others class logits.
    """

    def __init__(self, network: VehicleNetwork) -> None:
        super().__init__()
        self.network = network

    def forward(self, image: Tensor) -> Tensor:
        """See the class."""
        found = self.network(image.permute(0, 3, 1, 2).to(torch.float32) / 255.0)
        score = torch.sigmoid(found[:, :1] - CAUTION)
        highest = functional.max_pool2d(score, 3, 1, 1)
        score = score * (score >= highest).to(score.dtype)
        sides = STRIDE_PX * torch.exp(found[:, 1:5].clamp(-3.0, 6.0))
        return torch.cat((score, sides, found[:, 5:]), 1)[0]


def write_onnx(network: VehicleNetwork, path: Path) -> None:
    """The network as the detector runs it, for images of any size that is a multiple of 32."""
    deployed = Deployed(network).eval()
    example = torch.zeros((1, 352, 640, CHANNELS), dtype=torch.uint8)
    torch.onnx.export(
        deployed,
        (example,),
        str(path),
        input_names=["image"],
        output_names=["found"],
        dynamic_axes={"image": {1: "height", 2: "width"}, "found": {1: "rows", 2: "columns"}},
        opset_version=OPSET,
        dynamo=False,
    )
