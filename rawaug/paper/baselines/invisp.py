r"""InvISP: one invertible network, RAW to sRGB forwards and sRGB to RAW backwards.

``x = f(r)``, ``r = f^-1(x)``, ``r = (w demosaic(y))^(1/2.2)`` with the as-shot white balance ``w`` of largest entry 1.
``f`` is eight blocks ``u = W v``, ``p = u_1 + F(u_23)``, ``q = u_23 exp(s(p)) + G(p)`` with the log-scale
``s = 0.8 (2 sigmoid(H(p)) - 1)``, each of which is undone exactly. Loss: ``|f(r) - x|_1 + |f^-1(x) - r|_1``; with JPEG
between, the second term is ``|f^-1(jpeg(f(r))) - r|_1``.

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
from rawaug.isp import stages
from rawaug.isp.fit.samples import FramePair
from rawaug.paper.baselines.base import Crops, CropTrainedISP
from rawaug.registry import BASELINES
from rawaug.seeding import derived_seed, initialised_from

SCALE_CLAMP = 0.8
GAMMA = 2.2
"""RAW is compressed before the network, as published, for its dynamic range."""
Balance = Tensor | tuple[float, ...] | None


class DenseBlock(nn.Module):
    """Five 3 x 3 convolutions, each of which sees all before it; leaky ReLU 0.2; the last starts at zero."""

    def __init__(self, inputs: int, outputs: int, growth: int) -> None:
        super().__init__()
        self.hidden = nn.ModuleList(nn.Conv2d(inputs + k * growth, growth, 3, padding=1) for k in range(4))
        self.last = nn.Conv2d(inputs + 4 * growth, outputs, 3, padding=1)
        nn.init.zeros_(self.last.weight)
        nn.init.zeros_(self.last.bias)  # type: ignore[arg-type]

    def forward(self, x: Tensor) -> Tensor:
        for layer in self.hidden:
            x = torch.cat([x, F.leaky_relu(layer(x), 0.2)], dim=1)
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
        one, two = F.conv2d(x, self.weight[:, :, None, None]).split([1, 2], dim=1)
        one = one + self.add_one(two)
        return torch.cat([one, two * self._log_scale(one).exp() + self.add_two(one)], dim=1)

    def inverse(self, x: Tensor) -> Tensor:
        one, two = x.split([1, 2], dim=1)
        two = (two - self.add_two(one)) * (-self._log_scale(one)).exp()
        one = one - self.add_one(two)
        return F.conv2d(torch.cat([one, two], dim=1), torch.linalg.inv(self.weight)[:, :, None, None])

    def _log_scale(self, one: Tensor) -> Tensor:
        return SCALE_CLAMP * (2.0 * torch.sigmoid(self.scale_two(one)) - 1.0)


class Flow(nn.Module):
    """The blocks in a row; untrained, their exchanges of channels undo each other and the flow is the identity."""

    def __init__(self, blocks: int, growth: int) -> None:
        super().__init__()
        shifts = [*[1] * (blocks - 1), -(blocks - 1) % 3]
        self.blocks = nn.ModuleList(InvertibleBlock(growth, shift) for shift in shifts)

    def forward(self, x: Tensor) -> Tensor:
        """Compressed, balanced RAW ``(B, 3, H, W)`` to sRGB."""
        for block in self.blocks:
            x = block(x)
        return x

    def inverse(self, x: Tensor) -> Tensor:
        """sRGB ``(B, 3, H, W)`` to compressed, balanced RAW."""
        for block in reversed(self.blocks):
            x = block.inverse(x)  # type: ignore[operator]
        return x


@BASELINES.register("invisp")
class InvISP(CropTrainedISP):
    """InvISP; the setting of a pass is the shot's as-shot multipliers R, G, B, ``(3,)`` or ``(B, 3)``.

    Without, both passes take the geometric mean of the training pairs'.

    Args:
        cfa: pattern of the RAW.
        blocks, growth: size of the network.
        jpeg_quality: train the way back through a differentiable JPEG of this quality, in 1 to 100, of the network's
            own rendering; without, on the pairs' sRGB.
        seed: of the initial weights.

    Example:
        >>> model, srgb = InvISP(blocks=2, growth=4), torch.rand(1, 3, 8, 8)
        >>> model.reverse(srgb, (2.0, 1.0, 1.5)).shape
        torch.Size([1, 1, 8, 8])
    """

    name = "invisp"
    learning_rate = 3e-4

    def __init__(
        self,
        cfa: CFA | str = "RGGB",
        blocks: int = 8,
        growth: int = 32,
        jpeg_quality: int | None = None,
        seed: int = 0,
    ) -> None:
        super().__init__(cfa)
        if jpeg_quality is not None and not 1 <= jpeg_quality <= 100:
            raise ValueError(f"jpeg_quality must be 1 to 100, got {jpeg_quality}")
        self.jpeg_quality = jpeg_quality
        with initialised_from(derived_seed(seed, "baseline")):
            self.flow = Flow(blocks, growth)
        self.balance: Tensor
        self.register_buffer("balance", torch.ones(1, 3))

    def prepare(self, pairs: Sequence[FramePair]) -> None:
        self.balance.copy_(torch.tensor([pair.white_balance for pair in pairs]).log().mean(0, keepdim=True).exp())

    def balanced(self, white_balance: tuple[float, float, float]) -> Balance:
        return white_balance

    def unprocess(self, srgb: Tensor, setting: Balance = None) -> Tensor:
        balanced = stages.gamma_expand(self.flow.inverse(srgb), GAMMA)
        return stages.apply_gains(balanced, 1.0 / self._gains(setting, len(srgb)))

    def render(self, raw: Tensor, setting: Balance = None) -> Tensor:
        return self.flow(self.compressed(raw, setting))

    def compressed(self, raw: Tensor, setting: Balance) -> Tensor:
        """What the flow takes ``(B, 3, H, W)`` of a mosaic ``(B, 1, H, W)``."""
        balanced = stages.apply_gains(bayer.demosaic(raw, self.cfa), self._gains(setting, len(raw)))
        return stages.gamma_compress(balanced, GAMMA)

    def loss(self, crops: Crops) -> Tensor:
        """l1 in both directions; with JPEG between, the way back starts from the network's own rendering."""
        raw = self.compressed(crops.raw, crops.white_balance)
        rendered = self.flow(raw)
        picture = crops.srgb if self.jpeg_quality is None else self._jpeg(rendered.clamp(0.0, 1.0))
        return F.l1_loss(rendered, crops.srgb) + F.l1_loss(self.flow.inverse(picture), raw)

    def _jpeg(self, srgb: Tensor) -> Tensor:
        from kornia.enhance import jpeg_codec_differentiable

        return jpeg_codec_differentiable(srgb, srgb.new_tensor([float(self.jpeg_quality or 100)]))

    def _gains(self, setting: Balance, batch: int) -> Tensor:
        given = self.balance if setting is None else setting
        gains = torch.as_tensor(given, dtype=self.balance.dtype, device=self.balance.device).expand(batch, 3)
        return gains / gains.amax(dim=1, keepdim=True)
