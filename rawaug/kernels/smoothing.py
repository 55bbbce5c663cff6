"""Symmetric separable filters of planes, as loops for the CPU."""

from __future__ import annotations

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

from rawaug.kernels.runtime import compile_loop, run_over_rows


def smooth(planes: Tensor, taps: Tensor) -> Tensor:
    """``(B, N, H, W)``, float32 on the CPU, each picture filtered with its own ``(B, K)`` taps along both axes.

    The first tap is the middle one, the others stand on both sides of it. The edge is repeated beyond the edge.
    """
    batch, count, height, width = planes.shape
    image = planes.contiguous().numpy().reshape(batch * count, height, width)
    weights = F.pad(taps.float(), (0, 1 - taps.shape[1] % 2)).repeat_interleave(count, 0).numpy()  # an odd number
    out = torch.empty(batch, count, height, width)
    given = (image, weights, out.numpy().reshape(image.shape))
    run_over_rows(len(image) * height, width, lambda start, stop: _rows(*given, start, stop))
    return out


@compile_loop
def _rows(image, weights, out, start, stop):  # type: ignore[no-untyped-def]
    """Rows ``start`` to ``stop`` of all planes: down the columns into a row with margins, then along it, two taps at a
    time.
    """
    _, height, width = image.shape
    margin = weights.shape[1] - 1
    line = np.empty(width + 2 * margin, np.float32)
    middle = line[margin : margin + width]
    for row in range(start, stop):
        plane, y = row // height, row % height
        taps, own, result = weights[plane], image[plane, y], out[plane, y]
        reach = margin
        while reach > 0 and taps[reach] == 0 and taps[reach - 1] == 0:
            reach -= 2
        for x in range(width):
            middle[x] = taps[0] * own[x]
        for k in range(1, reach, 2):
            a, b = image[plane, max(y - k, 0)], image[plane, min(y + k, height - 1)]
            c, d = image[plane, max(y - k - 1, 0)], image[plane, min(y + k + 1, height - 1)]
            first, second = taps[k], taps[k + 1]
            for x in range(width):
                middle[x] += first * (a[x] + b[x]) + second * (c[x] + d[x])
        line[margin - reach : margin] = middle[0]
        line[margin + width : margin + width + reach] = middle[width - 1]
        for x in range(width):
            result[x] = taps[0] * middle[x]
        for k in range(1, reach, 2):
            a, b, c, d = line[margin - k :], line[margin + k :], line[margin - k - 1 :], line[margin + k + 1 :]
            first, second = taps[k], taps[k + 1]
            for x in range(width):
                result[x] += first * (a[x] + b[x]) + second * (c[x] + d[x])
