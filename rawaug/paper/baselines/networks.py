r"""The networks: a plain U-Net, invertible greyscale, CycleISP and InvISP.

*The U-Net*, ``y = mosaic(x + U(x))``, is trained end to end with l1. The published size is 11.77 M parameters. That is
UPI's U-Net with three channels in and out (five scales of three convolutions, 32 to 512 features, bilinear
interpolation up: 11,774,979 parameters), so the one in :mod:`denoisers.networks` is used. That the paper's U-Net is
this one is concluded from the number of parameters. Source: Ronneberger et al., MICCAI 2015; Conde et al., AAAI 2022.

*Invertible greyscale*, ``x = E(demosaic(y))``, ``y = mosaic(D(x))``: Xia et al. hide a colour picture in a grey one by
an encoder E and restore it by a decoder D. In InvISP's comparison the hidden picture is the RAW and the visible one the
sRGB. E is a residual encoder-decoder of 64, 128 and 256 features with 2, 4 and 2 residual blocks, strides of 2 down,
nearest neighbours up, and the finer features added; D has 64 features and 8 residual blocks, then 256 features and a
1 x 1 convolution. Two things differ here, and are assumptions: the outputs are linear, since most of RAW is near black,
where the published tanh is flat; and the losses are l1 of the two directions, as for InvISP, since there is no grey
picture to resemble. Source: Xia et al., "Invertible Grayscale", ACM TOG 37(6), 2018; Xing et al., CVPR 2021.

*CycleISP*, ``y = mosaic(N_rgb2raw(x))`` and ``x = N_raw2rgb(pack(y), a(x'))``: three groups of five dual-attention
blocks (:mod:`denoisers.cycleisp`) of 96 features a network. RAW has no trace of how its picture was coloured, so a
colour branch a guides the way to sRGB: a blurred sRGB picture x' becomes a map in (0, 1) that re-weights the features.
Loss: ``|y - y^|_1 + |log y - log y^|_1`` to RAW, ``|x - x^|_1`` to sRGB. Source: Zamir et al., CVPR 2020; sizes that
the text leaves open (colour branch: two groups of two blocks; blur: 21 x 21, sigma 12) follow the published
checkpoints.

*InvISP*, ``x = f(r)``, ``r = f^-1(x)``, ``r = (w demosaic(y))^(1/2.2)`` with the as-shot white balance w of largest
entry 1. f is eight blocks ``u = W v``, ``p = u_1 + F(u_23)``, ``q = u_23 exp(s(p)) + G(p)`` with the log-scale
``s = 0.8 (2 sigmoid(H(p)) - 1)``, each of which is undone exactly. Loss: ``|f(r) - x|_1 + |f^-1(x) - r|_1``; with JPEG
between, the second term is ``|f^-1(jpeg(f(r))) - r|_1``. Source: Xing et al., "Invertible Image Signal Processing",
CVPR 2021; couplings of Dinh et al. (Real NVP), 1 x 1 convolutions of Kingma and Dhariwal (Glow), dense blocks of
growth 32.
"""

from __future__ import annotations

import os
from collections.abc import Sequence
from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from denoisers import cycleisp
from denoisers.network import pad_to_multiple
from denoisers.networks import PUBLISHED_WIDTH, UNet
from rawaug import bayer
from rawaug.bayer import CFA
from rawaug.isp import stages
from rawaug.isp.fit.samples import FramePair
from rawaug.isp.stages import as_float
from rawaug.paper.baselines.base import Crops, CropTrainedISP
from rawaug.registry import BASELINES
from rawaug.seeding import derive_seed, initialise_from

BLUR_SIZE, BLUR_SIGMA = 21, 12.0
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


# -- invertible greyscale ---------------------------------------------------------------------------------------------


class ResidualBlock(nn.Sequential):
    """``x + conv(relu(conv(x)))`` of features ``(B, C, H, W)``."""

    def __init__(self, features: int) -> None:
        super().__init__(_conv(features, features), nn.ReLU(), _conv(features, features))

    def forward(self, x: Tensor) -> Tensor:
        """Features ``(B, C, H, W)`` to features of the same shape."""
        return x + super().forward(x)


def _blocks(features: int, count: int) -> nn.Sequential:
    return nn.Sequential(*(ResidualBlock(features) for _ in range(count)))


def _scale(inputs: int, outputs: int, stride: int) -> nn.Sequential:
    """A change of size and of the number of features."""
    return nn.Sequential(_conv(inputs, outputs, stride), _conv(outputs, outputs), nn.ReLU())


class Encoder(nn.Module):
    """E, demosaiced RAW to sRGB, with ``features``, twice and four times as many in its three scales."""

    def __init__(self, features: int) -> None:
        super().__init__()
        fine, middle, coarse = features, 2 * features, 4 * features
        self.first = nn.Sequential(_conv(3, fine), _blocks(fine, 2))
        self.down = nn.ModuleList([_scale(fine, middle, 2), _scale(middle, coarse, 2)])
        self.centre = _blocks(coarse, 4)
        self.up = nn.ModuleList([_scale(coarse, middle, 1), _scale(middle, fine, 1)])
        self.last = nn.Sequential(_blocks(fine, 2), _conv(fine, 3))

    def forward(self, x: Tensor) -> Tensor:
        """``(B, 3, H, W)`` to ``(B, 3, H, W)``; sides are padded to multiples of 4 inside."""
        fine = self.first(pad_to_multiple(x, 4))
        middle = self.down[0](fine)
        features = self.centre(self.down[1](middle))
        for up, skip in zip(self.up, (middle, fine), strict=True):
            features = up(F.interpolate(features, scale_factor=2.0, mode="nearest")) + skip
        return self.last(features)[..., : x.shape[-2], : x.shape[-1]]


@BASELINES.register("invgrey")
class InvertibleGrey(CropTrainedISP):
    """The invertible-greyscale network, one network a direction.

    Args:
        cfa: the pattern of the RAW that it makes and takes.
        features: in the finest scale of either direction.
        blocks: number of residual blocks of the decoder, from sRGB to RAW.
        seed: decides the initial weights.
    """

    name = "invgrey"
    learning_rate = 1e-3

    def __init__(self, cfa: CFA | str = "RGGB", features: int = 64, blocks: int = 8, seed: int = 0) -> None:
        super().__init__(cfa)
        with initialise_from(derive_seed(seed, "baseline")):
            self.encoder = Encoder(features)
            last = nn.Conv2d(4 * features, 3, 1)
            body = (_conv(3, features), _blocks(features, blocks), _conv(features, 4 * features))
            self.reverse_network = nn.Sequential(*body, last)

    def render(self, raw: Tensor, setting: Any = None) -> Tensor:
        """Mosaic ``(B, 1, H, W)`` to sRGB ``(B, 3, H, W)``; there are no settings."""
        return self.encoder(bayer.demosaic(raw, self.cfa))


# -- CycleISP ---------------------------------------------------------------------------------------------------------


class RGB2RAW(cycleisp.Trunk):
    """The network from sRGB to linear camera colour, with the ``sizes`` features, groups, blocks and reduction."""

    def __init__(self, *sizes: int) -> None:
        super().__init__(3, *sizes)
        self.tail = nn.Sequential(_conv(sizes[0], 3))

    def forward(self, srgb: Tensor) -> Tensor:
        """``(B, 3, H, W)`` to ``(B, 3, H, W)``."""
        return self.tail(self.body(self.head(srgb)))


class ColourBranch(cycleisp.Trunk):
    """The branch that guides the way to sRGB by the colours of a picture."""

    def __init__(self, features: int, reduction: int) -> None:
        super().__init__(3, features, groups=2, blocks=2, reduction=reduction)
        self.tail = nn.Sequential(_conv(features, features), nn.Sigmoid())

    def forward(self, srgb: Tensor) -> Tensor:
        """A picture ``(B, 3, H, W)`` to weights of features in (0, 1), ``(B, features, H/2, W/2)``."""
        from kornia.filters import gaussian_blur2d

        if min(srgb.shape[-2:]) <= BLUR_SIZE // 2:
            sides = "x".join(map(str, srgb.shape[-2:]))
            raise ValueError(f"the colour branch needs sides larger than {BLUR_SIZE // 2} pixels, got {sides}")
        blurred = gaussian_blur2d(srgb, BLUR_SIZE, (BLUR_SIGMA, BLUR_SIGMA), border_type="reflect")
        return self.tail(self.body(F.max_pool2d(self.head(blurred), 2)))


class RAW2RGB(cycleisp.Trunk):
    """The network from packed RAW to sRGB, with the ``sizes`` features, groups, blocks and reduction."""

    def __init__(self, *sizes: int) -> None:
        super().__init__(4, *sizes)
        self.tail = nn.Sequential(_conv(sizes[0], sizes[0]), self.body[-1])
        self.tail_rgb = nn.Sequential(nn.Conv2d(sizes[0], 12, 1))

    def forward(self, packed: Tensor, colour: Tensor) -> Tensor:
        """RAW ``(B, 4, H/2, W/2)`` and weights ``(B, features, H/2, W/2)`` of the branch to sRGB ``(B, 3, H, W)``."""
        features = self.body[:-1](self.head(packed))
        features = self.body[-1](features + features * colour)
        return F.pixel_shuffle(self.tail_rgb(self.tail(features)), 2)


@BASELINES.register("cycleisp")
class CycleISP(CropTrainedISP):
    """CycleISP. To render RAW it needs a picture of the same scene whose colours it takes: ``model(raw, srgb)``.

    Args:
        cfa: the pattern of the RAW that it makes and takes.
        features: in every layer.
        groups: of dual-attention blocks, in each network.
        blocks: in each group.
        reduction: of the features in channel attention.
        seed: decides the initial weights.
    """

    name = "cycleisp"
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
        start = derive_seed(seed, "baseline")
        with initialise_from(start):
            self.rgb2raw = RGB2RAW(features, groups, blocks, reduction)
            self.raw2rgb = RAW2RGB(features, groups, blocks, reduction)
            self.ccm = ColourBranch(features, reduction)
        with initialise_from(start):  # a trunk leaves its weights as they are in memory
            for layer in self.modules():
                if isinstance(layer, nn.Conv2d):
                    layer.reset_parameters()

    @property
    def reverse_network(self) -> nn.Module:  # type: ignore[override]
        """The network from sRGB to RAW, under its published name."""
        return self.rgb2raw

    def render(self, raw: Tensor, setting: Tensor | None = None) -> Tensor:
        """Mosaic ``(B, 1, H, W)`` to sRGB ``(B, 3, H, W)``; the setting is an sRGB picture of the same scene."""
        if setting is None:
            raise ValueError("cycleisp renders RAW in the colours of a picture: pass the sRGB of the same scene")
        return self.raw2rgb(bayer.pack(raw, self.cfa), self.ccm(as_float(setting)))

    def cycle(self, srgb: Tensor) -> Tensor:
        """sRGB ``(B, 3, H, W)`` to RAW and back, in its own colours."""
        return self.forward(self.reverse(srgb), srgb)

    def raw_error(self, predicted: Tensor, raw: Tensor) -> Tensor:
        """l1 of mosaics ``(B, 1, H, W)`` and of their logarithms, a scalar."""
        log_predicted, log_raw = (image.clamp_min(LOG_FLOOR).log() for image in (predicted, raw))
        return F.l1_loss(predicted, raw) + F.l1_loss(log_predicted, log_raw)

    def load_published(self, path: str | os.PathLike[str], part: str = "rgb2raw") -> None:
        """Take the RGGB weights of a published checkpoint for a part: "rgb2raw", "raw2rgb" or "ccm", the colour branch.

        Nothing in the file is run as code; errors are those of :func:`denoisers.cycleisp.load_published`.
        """
        cycleisp.load_published(getattr(self, part), path, part)


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
        jpeg_quality: from 1 to 100: the way back is trained through a differentiable JPEG of the network's own
            rendering. None leaves that out.
        seed: decides the initial weights.
    """

    name = "invisp"
    learning_rate = 3e-4

    def __init__(
        self, cfa: CFA | str = "RGGB", blocks: int = 8, growth: int = 32, jpeg_quality: int | None = None, seed: int = 0
    ) -> None:
        super().__init__(cfa)
        self.jpeg_quality = jpeg_quality
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
        """l1 of both passes, a scalar; the way back starts from the rendering as a JPEG if ``jpeg_quality`` is set."""
        raw = self.compress(crops.raw, crops.white_balance)
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
