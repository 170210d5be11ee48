"""Mean, spread and median of the depth of a pixel, from sums that any rasterizer can blend."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch

# Each takes three channels; with those of the colour there are 33, a number that gsplat has a kernel for.
BINS = 10


@dataclass(frozen=True, eq=False)
class DepthBins:
    """The depths in view cut into bins, each with about as much to see.

    Blending is a sum of what splats carry, times their weights in the pixel, and a median is no sum. But what a bin
    holds of a pixel's weight is, and so are the moments of the depth within the bin. The first bin up to which there
    is half of the pixel holds the median; there it is interpolated as if the depths in the bin were spread evenly,
    with the mean and the deviation that they have. Floaters in front of that bin count by their weight alone, as for
    the exact median. From photos' poses, half of bonsai's pixels come within 0.4 % of the exact median and nine in ten
    within 1.5 % (the mean depth: 2.5 % and 8.5 %); lego's, within 0.1 % and 0.3 %. Poses come out as good.

    Attributes:
        edges: (BINS - 1,) float32, ascending z-depths between the bins.
        centers: (BINS,) float32, z-depths from which moments are taken: those from the camera would lose the spread
            to rounding.
    """

    edges: torch.Tensor
    centers: torch.Tensor

    @classmethod
    def of(cls, depths: torch.Tensor, areas: torch.Tensor) -> DepthBins:
        """Make the bins for splats, at least one, at z-depths (n,) that cover `areas` (n,) of the picture, int64."""
        order = torch.argsort(depths, stable=True)
        # Of whole numbers, for sums of others differ from run to run on a GPU.
        covered = torch.cumsum(areas[order], 0)
        quantiles = torch.arange(1, BINS, device=depths.device) * covered[-1] // BINS
        edges = depths[order[torch.searchsorted(covered, quantiles)]]
        return cls(edges, torch.cat([edges[:1], 0.5 * (edges[1:] + edges[:-1]), edges[-1:]]))

    def channels(self, depths: torch.Tensor) -> torch.Tensor:
        """Return what splats at z-depths (n,) carry, to be blended: (n, 3 BINS) float32."""
        index = torch.bucketize(depths, self.edges)
        offset = depths - self.centers[index]
        moments = torch.stack([torch.ones_like(offset), offset, offset * offset], dim=1)
        inside = index[:, None] == torch.arange(BINS, device=depths.device)
        return (inside[:, :, None] * moments[:, None, :]).flatten(1)

    def statistics(self, blended: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
        """Return the mean, median and standard deviation (H, W) of the depth.

        Args:
            blended: (H, W, 3 BINS), the channels as the rasterizer blended them.
        """
        weight, first, second = blended.unflatten(-1, (BINS, 3)).unbind(-1)  # each (H, W, BINS)
        total = weight.sum(-1)
        mean = (first + self.centers * weight).sum(-1) / total
        away = self.centers - mean[..., None]
        variance = (second + 2 * away * first + away * away * weight).sum(-1) / total

        up_to = torch.cumsum(weight, -1)
        half = up_to[..., -1:].clamp(max=0.5)
        index = (up_to >= half).int().argmax(-1, keepdim=True)  # of the bin with the median
        weight, first, second, up_to = (values.gather(-1, index)[..., 0] for values in (weight, first, second, up_to))
        local = first / weight
        deviation = torch.sqrt((second / weight - local * local).clamp(min=0.0))
        place = ((half[..., 0] - up_to) / weight + 1.0).clamp(0.0, 1.0)  # 0 at the near side of the bin, 1 at the far
        median = self.centers[index[..., 0]] + local + math.sqrt(3) * deviation * (2.0 * place - 1.0)
        # Depths that are far apart in a bin can have a deviation that leads out of it.
        nearest = torch.cat([self.edges.new_zeros(1), self.edges])[index[..., 0]]
        farthest = torch.cat([self.edges, self.edges.new_full((1,), torch.inf)])[index[..., 0]]
        median = torch.minimum(torch.maximum(median, nearest), farthest)
        return mean, median, torch.sqrt(variance.clamp(min=0.0))
