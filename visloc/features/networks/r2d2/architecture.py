"""R2D2 (Revaud et al., NeurIPS 2019) and Fast-R2D2 (Humenberger et al. 2020, appendix).

Written from the papers and from the published weights' own shapes. Our own weights come from the
extension ``training``. One trunk of nine convolutions gives 128 channels x per pixel; two 1 x 1
heads on x^2 give reliability and repeatability; x / |x| is the descriptor. Fast-R2D2 pools once, so
that most of the trunk works at half resolution, and interpolates x back to full resolution before
the heads.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

from visloc.features.weights.files import FASTER2D2_WASF_N16, R2D2_WASF_N16, PublishedWeights

DESCRIPTOR_DIM = 128
# Of RGB in 0 to 255; the networks see the difference to the mean in standard deviations.
MEAN = (0.485 * 255, 0.456 * 255, 0.406 * 255)
STD = (0.229 * 255, 0.224 * 255, 0.225 * 255)


class Layer(NamedTuple):
    """One convolution; padding keeps the size."""

    kernel: int
    dilation: int
    width: int  # output channels as a multiple of the first layer's; 0 for DESCRIPTOR_DIM
    normalized: bool
    relu: bool

    @property
    def padding(self) -> int:
        """Zeros around the input."""
        return self.dilation * (self.kernel - 1) // 2


@dataclass(frozen=True, slots=True)
class Architecture:
    """A network without its weights.

    Attributes:
        pool_after: how many layers come before the pooling; 0 for no pooling.
    """

    name: str
    published: PublishedWeights
    layers: tuple[Layer, ...]
    pool_after: int

    @property
    def stride(self) -> int:
        """Pixels of the image per pixel of x."""
        return 2 if self.pool_after else 1


def _layers(dilations: tuple[int, ...]) -> tuple[Layer, ...]:
    kernels = (3, 3, 3, 3, 3, 3, 2, 2, 2)
    widths = (1, 1, 2, 2, 4, 4, 4, 4, 0)
    return tuple(
        Layer(kernel, dilation, width, normalized=number < 9, relu=number < 7)
        for number, (kernel, dilation, width) in enumerate(
            zip(kernels, dilations, widths, strict=True), start=1
        )
    )


R2D2 = Architecture("r2d2", R2D2_WASF_N16, _layers((1, 1, 1, 2, 2, 4, 4, 8, 16)), pool_after=0)
FAST_R2D2 = Architecture(
    "faster2d2", FASTER2D2_WASF_N16, _layers((1, 1, 1, 1, 1, 2, 2, 4, 8)), pool_after=3
)
ARCHITECTURES = {each.name: each for each in (R2D2, FAST_R2D2)}
