r"""InvISP: one invertible network for both directions, ``x = f(r)``, ``r = f^-1(x)``.

RAW enters as InvISP prepares it: demosaiced, balanced by the white balance w of the shot, whose largest entry is 1, and
compressed, ``r = (w demosaic(y))^(1/2.2)``. f is eight blocks ``u = W v``, ``p = u_1 + F(u_23)``,
``q = u_23 exp(s(p)) + G(p)`` with the log-scale ``s = 0.8 (2 sigmoid(H(p)) - 1)``, each of which is undone exactly.

Loss: ``|f(r) - x|_1 + |f^-1(x) - r|_1``. With JPEG in between, the second term is ``|f^-1(jpeg(f(r))) - r|_1``, for
which the codec (:mod:`rawaug.paper.baselines.jpeg`) must be differentiable.

InvISP's own figures are for RAW recovered from the network's *own rendering*, stored as JPEG. That rendering may hide
in the picture what the way back needs. RAW recovered from a camera's picture is another task, and the harder one.

Source: Xing et al., "Invertible Image Signal Processing", CVPR 2021; couplings of Dinh et al. (Real NVP), 1 x 1
convolutions of Kingma and Dhariwal (Glow), dense blocks of growth 32.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from rawaug import bayer
from rawaug.bayer import CFA
from rawaug.isp import functional
from rawaug.isp.fit.samples import FramePair
from rawaug.paper.baselines.base import BASELINES, Crops, CropTrainedISP
from rawaug.paper.baselines.jpeg import jpeg
from rawaug.seeding import derive_seed, initialise_from

SCALE_CLAMP = 0.8
"""A coupling has at most this absolute log-scale."""
GAMMA = 2.2
"""RAW is compressed by this power before the network."""
SLOPE = 0.2
"""The leaky ReLUs have this slope for negative values."""
JPEG_QUALITY = 90
"""Pictures are stored at this quality between the two passes, as published."""
Balance = Tensor | tuple[float, ...] | None


class CompressedISP(CropTrainedISP):
    """A network that sees RAW as InvISP prepares it; the setting is the as-shot multipliers R, G, B.

    The multipliers are ``(3,)`` or ``(B, 3)``. Without a setting, both passes take the training pairs' geometric mean.

    Args:
        cfa: the pattern of the RAW that it makes and takes.
    """

    renders = True

    def __init__(self, cfa: CFA | str = "RGGB") -> None:
        super().__init__(cfa)
        self.balance: Tensor
        self.register_buffer("balance", torch.ones(1, 3))

    def prepare(self, pairs: Sequence[FramePair]) -> None:
        """Take the pairs' mean multipliers for shots that state none."""
        multipliers = torch.tensor([pair.clean.white_balance for pair in pairs])
        self.balance.copy_(multipliers.log().mean(0, keepdim=True).exp())

    def as_shot_setting(self, white_balance: tuple[float, float, float]) -> Balance:
        """Return the multipliers themselves."""
        return white_balance

    def from_picture(self, srgb: Tensor) -> Tensor:
        """Convert sRGB ``(B, 3, H, W)`` to balanced, compressed colour of the same shape."""
        raise NotImplementedError

    def to_picture(self, compressed: Tensor) -> Tensor:
        """Balanced, compressed colour ``(B, 3, H, W)`` to sRGB of the same shape, not clipped."""
        raise NotImplementedError

    def unprocess(self, srgb: Tensor, setting: Balance = None) -> Tensor:
        """Convert sRGB ``(B, 3, H, W)`` to linear camera colour of the same shape."""
        balanced = functional.gamma_expand(self.from_picture(srgb), GAMMA)
        return functional.apply_gains(balanced, 1.0 / self.gains(setting, len(srgb)))

    def render(self, raw: Tensor, setting: Balance = None) -> Tensor:
        """Render a mosaic ``(B, 1, H, W)`` to sRGB ``(B, 3, H, W)``."""
        return self.to_picture(self.compress(raw, setting))

    def compress(self, raw: Tensor, setting: Balance = None) -> Tensor:
        """Convert a mosaic ``(B, 1, H, W)`` to balanced, gamma-compressed colour ``(B, 3, H, W)`` for the network."""
        balanced = functional.apply_gains(bayer.demosaic(raw, self.cfa), self.gains(setting, len(raw)))
        return functional.gamma_compress(balanced, GAMMA)

    def gains(self, setting: Balance, batch: int) -> Tensor:
        """Give the multipliers ``(B, 3)`` of a setting, scaled to a largest entry of 1."""
        multipliers = self.balance if setting is None else setting
        gains = torch.as_tensor(multipliers, dtype=self.balance.dtype, device=self.balance.device).expand(batch, 3)
        return gains / gains.amax(dim=1, keepdim=True)


class DenseBlock(nn.Module):
    """Five 3 x 3 convolutions, each of which sees all before it; the last starts at zero."""

    def __init__(self, inputs: int, outputs: int, growth: int) -> None:
        super().__init__()
        self.hidden = nn.ModuleList()
        for k in range(4):
            self.hidden.append(nn.Conv2d(inputs + k * growth, growth, 3, padding=1))

        self.last = nn.Conv2d(inputs + 4 * growth, outputs, 3, padding=1)
        for parameter in self.last.parameters():
            nn.init.zeros_(parameter)

    def forward(self, x: Tensor) -> Tensor:
        """Map ``(B, inputs, H, W)`` to ``(B, outputs, H, W)``."""
        for layer in self.hidden:
            x = torch.cat([x, F.leaky_relu(layer(x), SLOPE)], dim=1)
        return self.last(x)


class InvertibleBlock(nn.Module):
    """An invertible 1 x 1 convolution, then an affine coupling of one channel with two."""

    def __init__(self, growth: int, shift: int) -> None:
        super().__init__()
        self.weight = nn.Parameter(torch.eye(3).roll(shift, 0))
        self.add_one = DenseBlock(2, 1, growth)
        self.scale_two = DenseBlock(1, 2, growth)
        self.add_two = DenseBlock(1, 2, growth)

    def forward(self, x: Tensor) -> Tensor:
        """Map ``(B, 3, H, W)`` to ``(B, 3, H, W)``."""
        mixed = F.conv2d(x, self.weight[:, :, None, None])
        first, second = mixed.split([1, 2], dim=1)

        first = first + self.add_one(second)
        second = second * self.log_scale(first).exp() + self.add_two(first)
        return torch.cat([first, second], dim=1)

    def inverse(self, x: Tensor) -> Tensor:
        """Compute the input ``(B, 3, H, W)`` from which :meth:`forward` makes ``x``, which has the same shape."""
        first, second = x.split([1, 2], dim=1)
        second = (second - self.add_two(first)) * (-self.log_scale(first)).exp()
        first = first - self.add_one(second)

        unmix = torch.linalg.inv(self.weight)
        return F.conv2d(torch.cat([first, second], dim=1), unmix[:, :, None, None])

    def log_scale(self, first: Tensor) -> Tensor:
        """Compute the logarithm ``(B, 2, H, W)`` of two channels' factor from the third, ``(B, 1, H, W)``."""
        return SCALE_CLAMP * (2.0 * torch.sigmoid(self.scale_two(first)) - 1.0)


class Flow(nn.Module):
    """The blocks in a row. Before training, their exchanges of channels undo each other, so it is the identity."""

    def __init__(self, blocks: int, growth: int) -> None:
        super().__init__()
        self.blocks = nn.ModuleList()
        for _ in range(blocks - 1):
            self.blocks.append(InvertibleBlock(growth, shift=1))
        self.blocks.append(InvertibleBlock(growth, shift=-(blocks - 1) % 3))

    def forward(self, x: Tensor) -> Tensor:
        """Compressed, balanced RAW ``(B, 3, H, W)`` to sRGB of the same shape."""
        for block in self.blocks:
            x = block(x)
        return x

    def inverse(self, x: Tensor) -> Tensor:
        """Convert sRGB ``(B, 3, H, W)`` to compressed, balanced RAW of the same shape."""
        for block in reversed(self.blocks):
            x = block.inverse(x)  # type: ignore[operator]
        return x


@BASELINES.register("invisp")
class InvISP(CompressedISP):
    """InvISP without JPEG: both passes learn from the camera's picture.

    Args:
        cfa: the pattern of the RAW that it makes and takes.
        blocks: number of invertible blocks.
        growth: features that each layer of a dense block adds.
        seed: decides the initial weights.
    """

    name = "invisp"
    learning_rate = 3e-4

    def __init__(self, cfa: CFA | str = "RGGB", blocks: int = 8, growth: int = 32, seed: int = 0) -> None:
        super().__init__(cfa)
        with initialise_from(derive_seed(seed, "baseline")):
            self.flow = Flow(blocks, growth)

    @property
    def reverse_network(self) -> nn.Module:  # type: ignore[override]
        """The flow, which is the network of both directions."""
        return self.flow

    def from_picture(self, srgb: Tensor) -> Tensor:
        """Convert sRGB ``(B, 3, H, W)`` to balanced, compressed colour of the same shape."""
        compressed: Tensor = self.flow.inverse(srgb)
        return compressed

    def to_picture(self, compressed: Tensor) -> Tensor:
        """Balanced, compressed colour ``(B, 3, H, W)`` to sRGB of the same shape."""
        picture: Tensor = self.flow(compressed)
        return picture

    def loss(self, crops: Crops, share_done: float = 1.0) -> Tensor:
        """Compute the l1 error of both passes, a scalar."""
        compressed = self.compress(crops.raw, crops.white_balance)
        rendered = self.to_picture(compressed)
        recovered = self.from_picture(self.stored(rendered, crops.srgb))
        return F.l1_loss(rendered, crops.srgb) + F.l1_loss(recovered, compressed)

    def stored(self, rendered: Tensor, srgb: Tensor) -> Tensor:
        """Return the picture ``(B, 3, H, W)`` from which the way back starts: here the camera's."""
        return srgb


@BASELINES.register("invisp-jpeg")
class JpegInvISP(InvISP):
    """InvISP with JPEG: the way back learns from the network's own rendering, stored as a JPEG.

    Args:
        cfa, blocks, growth, seed: as for :class:`InvISP`.
        quality: quality of the JPEG, from 1 to 100.
    """

    name = "invisp-jpeg"

    def __init__(
        self, cfa: CFA | str = "RGGB", blocks: int = 8, growth: int = 32, quality: int = JPEG_QUALITY, seed: int = 0
    ) -> None:
        super().__init__(cfa, blocks, growth, seed)
        self.quality = quality

    def stored(self, rendered: Tensor, srgb: Tensor) -> Tensor:
        """Compress the network's own rendering ``(B, 3, H, W)``."""
        return jpeg(rendered.clamp(0.0, 1.0), self.quality)
