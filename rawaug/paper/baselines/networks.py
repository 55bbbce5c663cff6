r"""The networks: a plain U-Net, CycleISP and InvISP.

*The U-Net*, ``y = mosaic(x + U(x))``, is trained end to end with l1. The published size is 11.77 M parameters. That is
UPI's U-Net with three channels in and out (five scales of three convolutions, 32 to 512 features, bilinear
interpolation up: 11,774,979 parameters), so the one in :mod:`denoisers.networks` is used. That the paper's U-Net is
this one is concluded from the number of parameters. Source: Ronneberger et al., MICCAI 2015; Conde et al., AAAI 2022.

*CycleISP*, ``y = mosaic(N_rgb2raw(x))``: three groups of five dual-attention blocks (:mod:`denoisers.cycleisp`) of 96
features. Its other network, from RAW to sRGB, shares no weight with this one and is left out. Loss: ``|y - y^|_1 + |log
y - log y^|_1``. Source: Zamir et al., CVPR 2020, and the published checkpoints.

*InvISP*, ``x = f(r)``, ``r = f^-1(x)``, ``r = (w demosaic(y))^(1/2.2)`` with the as-shot white balance w of largest
entry 1. f is eight blocks ``u = W v``, ``p = u_1 + F(u_23)``, ``q = u_23 exp(s(p)) + G(p)`` with the log-scale
``s = 0.8 (2 sigmoid(H(p)) - 1)``, each of which is undone exactly. Loss: ``|f(r) - x|_1 + |f^-1(x) - r|_1``. Source:
Xing et al., "Invertible Image Signal Processing", CVPR 2021; couplings of Dinh et al. (Real NVP), 1 x 1 convolutions of
Kingma and Dhariwal (Glow), dense blocks of growth 32.
"""

from __future__ import annotations

import os
from collections.abc import Sequence

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from denoisers import cycleisp
from denoisers.networks import PUBLISHED_WIDTH, UNet
from rawaug import bayer
from rawaug.bayer import CFA
from rawaug.isp import stages
from rawaug.isp.fit.samples import FramePair
from rawaug.paper.baselines.base import Crops, CropTrainedISP
from rawaug.registry import BASELINES
from rawaug.seeding import derive_seed, initialise_from

LOG_FLOOR = 1e-3
"""The value below which CycleISP's log loss is flat: at 12 bits it is four levels above black."""
SCALE_CLAMP = 0.8
GAMMA = 2.2
"""The power by which RAW is compressed before InvISP's network, as published, for its dynamic range."""
Balance = Tensor | tuple[float, ...] | None


def _conv(inputs: int, outputs: int, stride: int = 1) -> nn.Conv2d:
    return nn.Conv2d(inputs, outputs, 3, stride=stride, padding=1)


@BASELINES.register("unet")
class UNetISP(CropTrainedISP):
    """The U-Net, which has no forward pass.

    Args:
        cfa: the pattern of the RAW that it makes.
        width: number of features in the first scale.
        seed: decides the initial weights.
    """

    name = "unet"
    bidirectional = False
    learning_rate = 1e-3

    def __init__(self, cfa: CFA | str = "RGGB", width: int = PUBLISHED_WIDTH, seed: int = 0) -> None:
        super().__init__(cfa)
        self.reverse_network = UNet(width, channels=3, variance_map=False, seed=seed)


# -- CycleISP ---------------------------------------------------------------------------------------------------------


class RGB2RAW(cycleisp.Trunk):
    """The network from sRGB to linear camera colour, with the ``sizes`` features, groups, blocks and reduction."""

    def __init__(self, *sizes: int) -> None:
        super().__init__(3, *sizes)
        self.tail = nn.Sequential(_conv(sizes[0], 3))

    def forward(self, srgb: Tensor) -> Tensor:
        """``(B, 3, H, W)`` to ``(B, 3, H, W)``."""
        return self.tail(self.body(self.head(srgb)))


@BASELINES.register("cycleisp")
class CycleISP(CropTrainedISP):
    """CycleISP's network from sRGB to RAW, which has no forward pass.

    Args:
        cfa: the pattern of the RAW that it makes.
        features: in every layer.
        groups: of dual-attention blocks.
        blocks: in each group.
        reduction: of the features in channel attention.
        seed: decides the initial weights.
    """

    name = "cycleisp"
    bidirectional = False
    learning_rate = 3e-4

    def __init__(
        self,
        cfa: CFA | str = "RGGB",
        features: int = 96,
        groups: int = 3,
        blocks: int = 5,
        reduction: int = 8,
        seed: int = 0,
    ) -> None:
        super().__init__(cfa)
        with initialise_from(derive_seed(seed, "baseline")):
            self.reverse_network = RGB2RAW(features, groups, blocks, reduction)
            for layer in self.modules():  # a trunk leaves its weights as they are in memory
                if isinstance(layer, nn.Conv2d):
                    layer.reset_parameters()

    def raw_error(self, predicted: Tensor, raw: Tensor) -> Tensor:
        """l1 of mosaics ``(B, 1, H, W)`` and of their logarithms, a scalar."""
        log_predicted, log_raw = (image.clamp_min(LOG_FLOOR).log() for image in (predicted, raw))
        return F.l1_loss(predicted, raw) + F.l1_loss(log_predicted, log_raw)

    def load_published(self, path: str | os.PathLike[str]) -> None:
        """Take the RGGB weights of a published checkpoint, as :func:`denoisers.cycleisp.load_published` does."""
        cycleisp.load_published(self.reverse_network, path, "rgb2raw")


# -- InvISP -----------------------------------------------------------------------------------------------------------


class DenseBlock(nn.Module):
    """Five 3 x 3 convolutions, each of which sees all before it; leaky ReLU 0.2; the last starts at zero."""

    def __init__(self, inputs: int, outputs: int, growth: int) -> None:
        super().__init__()
        self.hidden = nn.ModuleList(_conv(inputs + k * growth, growth) for k in range(4))
        self.last = _conv(inputs + 4 * growth, outputs)
        nn.init.zeros_(self.last.weight)
        nn.init.zeros_(self.last.bias)  # type: ignore[arg-type]

    def forward(self, x: Tensor) -> Tensor:
        """``(B, inputs, H, W)`` to ``(B, outputs, H, W)``."""
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
        """``(B, 3, H, W)`` to ``(B, 3, H, W)``."""
        one, two = F.conv2d(x, self.weight[:, :, None, None]).split([1, 2], dim=1)
        one = one + self.add_one(two)
        return torch.cat([one, two * self._log_scale(one).exp() + self.add_two(one)], dim=1)

    def inverse(self, x: Tensor) -> Tensor:
        """The input ``(B, 3, H, W)`` that :meth:`forward` makes ``x`` of, which has the same shape."""
        one, two = x.split([1, 2], dim=1)
        two = (two - self.add_two(one)) * (-self._log_scale(one)).exp()
        one = one - self.add_one(two)
        return F.conv2d(torch.cat([one, two], dim=1), torch.linalg.inv(self.weight)[:, :, None, None])

    def _log_scale(self, one: Tensor) -> Tensor:
        return SCALE_CLAMP * (2.0 * torch.sigmoid(self.scale_two(one)) - 1.0)


class Flow(nn.Module):
    """The blocks in a row. Before training their exchanges of channels undo each other, so that it is the identity."""

    def __init__(self, blocks: int, growth: int) -> None:
        super().__init__()
        shifts = [*[1] * (blocks - 1), -(blocks - 1) % 3]
        self.blocks = nn.ModuleList(InvertibleBlock(growth, shift) for shift in shifts)

    def forward(self, x: Tensor) -> Tensor:
        """Compressed, balanced RAW ``(B, 3, H, W)`` to sRGB of the same shape."""
        for block in self.blocks:
            x = block(x)
        return x

    def inverse(self, x: Tensor) -> Tensor:
        """sRGB ``(B, 3, H, W)`` to compressed, balanced RAW of the same shape."""
        for block in reversed(self.blocks):
            x = block.inverse(x)  # type: ignore[operator]
        return x


@BASELINES.register("invisp")
class InvISP(CropTrainedISP):
    """InvISP; the setting of a pass is the shot's as-shot multipliers R, G, B, ``(3,)`` or ``(B, 3)``.

    Without a setting both passes take the geometric mean of the training pairs' multipliers.

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
        self.balance: Tensor
        self.register_buffer("balance", torch.ones(1, 3))

    def prepare(self, pairs: Sequence[FramePair]) -> None:
        """Take the pairs' mean multipliers as those of shots that state none."""
        self.balance.copy_(torch.tensor([pair.white_balance for pair in pairs]).log().mean(0, keepdim=True).exp())

    def setting_of(self, white_balance: tuple[float, float, float]) -> Balance:
        """The multipliers themselves."""
        return white_balance

    def unprocess(self, srgb: Tensor, setting: Balance = None) -> Tensor:
        """sRGB ``(B, 3, H, W)`` to linear camera colour of the same shape."""
        balanced = stages.gamma_expand(self.flow.inverse(srgb), GAMMA)
        return stages.apply_gains(balanced, 1.0 / self._gains(setting, len(srgb)))

    def render(self, raw: Tensor, setting: Balance = None) -> Tensor:
        """Mosaic ``(B, 1, H, W)`` to sRGB ``(B, 3, H, W)``."""
        return self.flow(self.compress(raw, setting))

    def compress(self, raw: Tensor, setting: Balance) -> Tensor:
        """Mosaic ``(B, 1, H, W)`` to balanced, gamma-compressed colour ``(B, 3, H, W)``, the input of the flow."""
        balanced = stages.apply_gains(bayer.demosaic(raw, self.cfa), self._gains(setting, len(raw)))
        return stages.gamma_compress(balanced, GAMMA)

    def loss(self, crops: Crops) -> Tensor:
        """l1 of both passes, a scalar."""
        raw = self.compress(crops.raw, crops.white_balance)
        return F.l1_loss(self.flow(raw), crops.srgb) + F.l1_loss(self.flow.inverse(crops.srgb), raw)

    def _gains(self, setting: Balance, batch: int) -> Tensor:
        given = self.balance if setting is None else setting
        gains = torch.as_tensor(given, dtype=self.balance.dtype, device=self.balance.device).expand(batch, 3)
        return gains / gains.amax(dim=1, keepdim=True)
