r"""The passes of an ISP, each as a table and a matrix: the same RAW and the same sRGB, dozens of times faster.

``y_c = sum_k C[c, k] T_k(x) * max(m + (1 - m) / g_c, 1 / g_c) * G(p) A(x4)``

Tone network and gamma are the same for every picture, and pointwise. ``T`` is their table over the sRGB cube, read by
trilinear interpolation (65 nodes a side: above 75 dB against the network), and ``A`` is the same for the attention
mask. Colour and gains are one matrix and three numbers per picture. Every site computes its own colour alone, hence
packed RAW.

The forward pass of demosaiced RAW is ``x = T'(sqrt(pinv(C) min(g x5 / G(p) A', min g)))``, with the forward network and
gamma in a table over the roots of linear light, or the picture's own tone curve inverted.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from copy import deepcopy
from functools import partial
from itertools import pairwise

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from rawaug import bayer
from rawaug.bayer import CFA, unpack
from rawaug.errors import count_of
from rawaug.isp.config import ISPParams
from rawaug.isp.functional import highlight_rise
from rawaug.isp.model import DictionaryISP
from rawaug.isp.stages import BatchParams, Stage, Tables, node_colours
from rawaug.isp.tone import STEPS, to_code
from rawaug.kernels import fastest
from rawaug.kernels.reference import Display, Unprocessing, blur_taps, fall_off, look_up, mask_frame, render, unprocess
from rawaug.kernels.runtime import one_thread

NODES = 65
"""Number of nodes of the table along each axis of the sRGB cube."""
_CURVE_NODES = 1025
"""Number of nodes of an inverted tone curve over the root of linear light."""
_PLACE_NODES = 33
"""Number of nodes along each side of a picture, between which place-dependent gains are interpolated."""


class BakedISP(nn.Module):
    """The reverse pass of an ISP as it is now; later changes to the ISP do not affect it."""

    table: Tensor
    attention: Tensor

    def __init__(self, isp: DictionaryISP, nodes: int = NODES) -> None:
        super().__init__()
        self.isp, self.config = deepcopy(isp), isp.config

        table, attention = _tables(isp, nodes)
        self.register_buffer("table", table)
        self.register_buffer("attention", attention)

    @torch.no_grad()
    def choose(self, srgb: Tensor) -> ISPParams:
        """The setting that the encoders (or their constants) choose for ``srgb`` ``(B, 3, H, W)``, as in the ISP."""
        if not self.config.encoders:
            return self.isp.choose(srgb)
        with one_thread():  # the same choice in every process
            return self.isp.choose(srgb)

    @torch.no_grad()
    def forward(
        self,
        srgb: Tensor,
        params: ISPParams,
        place: Tensor | None = None,
        white: float = math.inf,
        blur: Tensor | None = None,
    ) -> Tensor:
        """Convert sRGB to clean packed RAW.

        Args:
            srgb: ``(B, 3, H, W)``, uint8 or float in [0, 1], even sides.
            params: the settings of the pictures.
            place: where each picture lies in its frame, ``(B, 4 to 6)``: top, left, height and width of the frame, and,
                if the crop was turned or enlarged, its view and how many rows of the frame it has; None for full
                frames.
            white: the RAW value to clip at; nothing is clipped by default.
            blur: ``(B,)``, the deviation in pixels of the Gaussian that blurs linear light, at most 1; None for none.

        Returns:
            float32 ``(B, 4, H/2, W/2)``, planes R, Gr, Gb, B.
        """
        _require_batch(srgb, params, place, blur)

        camera = self._unprocessing(srgb, params, place, blur)
        size = srgb.shape[-2], srgb.shape[-1]
        gain = _place_gain(self.isp.ordered_stages, params, place, size, self.table, forward=False)
        if gain is None:
            return _pass(srgb, camera, white)

        raw = _pass(srgb, camera, math.inf)
        with one_thread():  # PyTorch's threads do not survive the fork of a worker
            sites = bayer.pack_rgb(gain.expand(-1, 3, -1, -1), self.config.cfa)
            return (raw * sites).clamp_max(white)

    @torch.no_grad()
    def colours(
        self,
        srgb: Tensor,
        params: ISPParams,
        place: Tensor | None = None,
        white: float = math.inf,
        blur: Tensor | None = None,
        shaded: bool = True,
    ) -> Tensor:
        """Convert sRGB to RAW of all three colours at every pixel.

        Args:
            srgb: ``(B, 3, H, W)``, uint8 or float in [0, 1], even sides.
            params: the settings of the pictures.
            place: as in :meth:`forward`.
            white: as in :meth:`forward`.
            blur: as in :meth:`forward`.
            shaded: whether the lens is applied; if not, the result is x4, for :meth:`shade`.

        Returns:
            float32 ``(B, 3, H, W)``.
        """
        _require_batch(srgb, params, place, blur)

        camera = self._unprocessing(srgb, params, place, blur)
        gain = None
        if shaded:
            size = srgb.shape[-2], srgb.shape[-1]
            gain = _place_gain(self.isp.ordered_stages, params, place, size, self.table, forward=False)
        else:
            camera = camera._replace(attention=camera.attention[:0], shading=camera.shading[:0])

        ceiling = math.inf
        if gain is None:
            ceiling = white
        planes = []
        for colour in range(3):
            sites = torch.tensor([(i, j, colour) for i, j in CFA.RGGB.sites])
            packed = _pass(srgb, camera._replace(sites=sites), ceiling)
            planes.append(unpack(packed, CFA.RGGB))
        rgb = torch.cat(planes, dim=1)

        if gain is None:
            return rgb
        return (rgb * gain).clamp_max(white)

    @torch.no_grad()
    def shade(self, x4: Tensor, params: ISPParams, place: Tensor | None = None) -> Tensor:
        """Apply the shading and attention of the lens to x4 ``(B, 3, H, W)``; the result is x5."""
        camera = self._unprocessing(x4, params, place)
        x5 = x4

        mask = fall_off(camera, 0, *x4.shape[-2:])
        if mask is not None:
            x5 = x5 * mask
        if camera.attention.numel():
            x5 = x5 * look_up(camera.attention, x5)[:, :1]

        size = x4.shape[-2], x4.shape[-1]
        gain = _place_gain(self.isp.ordered_stages, params, place, size, self.table, forward=False)
        if gain is not None:
            x5 = x5 * gain
        return x5

    def _unprocessing(
        self, srgb: Tensor, params: ISPParams, place: Tensor | None, blur: Tensor | None = None
    ) -> Unprocessing:
        table = self.table
        matrix, floor, frame, curves, shading = _batch_params(self.isp.ordered_stages, srgb, params, place, table)
        if curves.numel():
            table = table[:0]
            if srgb.dtype == torch.uint8:
                curves = curves[:, ::STEPS]

        knee = self.config.knee
        rise = highlight_rise(floor, knee)
        colour = torch.cat([matrix, matrix.mean(dim=1, keepdim=True), floor, rise], dim=1)

        sites = []
        for channel, (i, j) in zip((0, 1, 1, 2), CFA(self.config.cfa).sites, strict=True):
            sites.append((i, j, channel))

        taps = table.new_empty(len(srgb), 0)
        if blur is not None:
            taps = blur_taps(blur.to(table))
        return Unprocessing(
            table, curves, self.attention, colour, knee or 0.0, frame, shading, torch.tensor(sites), taps
        )


class FastForward(nn.Module):
    """The forward pass of an ISP as it is now, after demosaicing; later changes to the ISP do not affect it."""

    table: Tensor
    attention: Tensor

    def __init__(self, isp: DictionaryISP, nodes: int = NODES) -> None:
        super().__init__()
        self.cfa = CFA(isp.cfa)
        self.isp = deepcopy(isp).requires_grad_(False)

        table, attention = _tables(isp, nodes, forward=True)
        self.register_buffer("table", table)
        self.register_buffer("attention", attention)

    def forward(self, linear: Tensor, params: ISPParams, place: Tensor | None = None) -> Tensor:
        """Develop linear camera RGB x5 ``(B, 3, H, W)`` to sRGB ``(B, 3, H, W)`` in [0, 1], float32.

        Balanced light is clipped at the smallest gain, where a saturated sensor is neutral, as RAW developers do. The
        ISP's own pass clips only sRGB, and its saturated highlights are magenta.
        Differentiable with respect to ``linear`` and to the matrix and gains of ``params``.
        """
        _require_batch(linear, params, place)

        display = self._display(linear, params, place)
        linear = linear.float()
        gain = self._gain(linear, params, place)
        if gain is not None:
            linear = linear * gain

        needs_gradient = linear.requires_grad or display.matrix.requires_grad or display.gains.requires_grad
        if needs_gradient and torch.is_grad_enabled():
            return render(linear, display)
        return fastest("render", linear, display, otherwise=lambda: render(linear, display))

    @torch.no_grad()
    def develop(
        self, raws: Sequence[Tensor], methods: Sequence[str], params: ISPParams, place: Tensor | None = None
    ) -> list[Tensor]:
        """Develop mosaics to sRGB, each picture demosaiced by its own method.

        Args:
            raws: mosaics ``(B, 1, H, W)`` of the same B pictures, such as the noisy and the clean ones.
            methods: B names from :data:`rawaug.bayer.METHODS`.
            params: the settings of the pictures.
            place: as in :meth:`BakedISP.forward`.

        Returns:
            sRGB ``(B, 3, H, W)`` in [0, 1] for each of ``raws``.
        """
        display = self._display(raws[0], params, place)
        gain = self._gain(raws[0], params, place)
        if gain is not None:  # the gains change slowly, so they are about the same before demosaicing and after
            sites = bayer.mosaic(gain.expand(-1, 3, -1, -1), self.cfa)
            raws = [raw * sites for raw in raws]

        groups: dict[str, list[int]] = {}
        for number, method in enumerate(methods):
            kind = method if method in bayer.DIRECTIONAL else ""
            groups.setdefault(kind, []).append(number)
        if len(groups) == 1:
            return [self._develop_alike(raw, methods, display) for raw in raws]

        developed = [raw.new_empty(len(raw), 3, *raw.shape[-2:], dtype=torch.float32) for raw in raws]
        for numbers in groups.values():
            members = torch.tensor(numbers)
            own_methods = [methods[number] for number in numbers]
            own_display = display.of(members.to(raws[0].device))
            for raw, srgb in zip(raws, developed, strict=True):
                index = members.to(raw.device)
                srgb[index] = self._develop_alike(raw[index], own_methods, own_display)
        return developed

    def _develop_alike(self, raw: Tensor, methods: Sequence[str], display: Display) -> Tensor:
        """Develop mosaics ``(B, 1, H, W)``, all by stencils or all by one method that chooses directions."""

        def in_steps() -> Tensor:
            linear = self._demosaic(raw, methods, display.gains)
            return fastest("render", linear, display, otherwise=lambda: render(linear, display))

        if methods[0] in bayer.DIRECTIONAL:
            return in_steps()
        return fastest("develop", raw, display, self.cfa, methods, otherwise=in_steps)

    def _gain(self, image: Tensor, params: ISPParams, place: Tensor | None) -> Tensor | None:
        size = image.shape[-2], image.shape[-1]
        return _place_gain(self.isp.ordered_stages, params, place, size, self.table, forward=True)

    def _demosaic(self, raw: Tensor, methods: Sequence[str], gains: Tensor) -> Tensor:
        """Demosaic ``(B, 1, H, W)``; choosing a direction needs balanced RAW clipped at black, as developers do it."""
        method = methods[0]
        if method not in bayer.DIRECTIONAL:
            pictures = [bayer.demosaic(raw, self.cfa, name) for name in dict.fromkeys(methods)]
            rgb = pictures[0]
            for name, picture in zip(list(dict.fromkeys(methods))[1:], pictures[1:], strict=True):
                is_own = torch.tensor([own == name for own in methods], device=raw.device)
                rgb = torch.where(is_own[:, None, None, None], picture, rgb)
            return rgb

        balance = gains[:, :3, None, None]
        cell = bayer.mosaic(balance.expand(-1, 3, 2, 2), self.cfa)
        sites = cell.repeat(1, 1, raw.shape[-2] // 2, raw.shape[-1] // 2)
        balanced = (raw * sites).clamp_min(0.0)

        plain = partial(bayer.demosaic, balanced, self.cfa, method)
        rgb = fastest("demosaic_directional", balanced, self.cfa, method, otherwise=plain)
        return rgb.div_(balance)

    def _display(self, linear: Tensor, params: ISPParams, place: Tensor | None) -> Display:
        table = self.table
        matrix, floor, frame, curves, shading = _batch_params(self.isp.ordered_stages, linear, params, place, table)
        if curves.numel():
            table = table[:0]
            light = torch.linspace(0.0, 1.0, _CURVE_NODES).square().to(curves).expand(len(curves), 1, 1, -1)
            curves = to_code(light, curves)[:, 0, 0]

        gains = 1.0 / floor[:, 0]
        gains = torch.cat([gains, gains.amin(dim=1, keepdim=True)], dim=1)
        return Display(table, curves, self.attention, torch.linalg.pinv(matrix), gains, frame, shading)


@torch.no_grad()
@one_thread()  # the same tables in every process
def _tables(isp: DictionaryISP, nodes: int, forward: bool = False) -> tuple[Tensor, Tensor]:
    """Make the tables of a pass: x2, or sRGB of the forward pass, and attention, which is empty if there is none."""
    if any(first.makes >= second.makes for first, second in pairwise(isp.ordered_stages)):
        order = " ".join(isp.config.stages)
        raise ValueError(f"augmentation needs the ISP's stages in the usual order, got {order}; fit it anew")
    cube = node_colours(nodes)
    with torch.autocast(isp.gain.log_gains.device.type, enabled=False):
        tables, stages = Tables(cube, cube), isp.ordered_stages
        if forward:
            tables, stages = Tables(cube, cube.square()), stages[::-1]
        for stage in stages:
            tables = stage.bake(tables, forward)

    attention = torch.empty(0, 0, 0, 4)
    if tables.attention is not None:
        attention = _as_table(tables.attention, nodes)
    return _as_table(tables.x2, nodes), attention


def _batch_params(
    stages: Sequence[Stage], image: Tensor, params: ISPParams, place: Tensor | None, table: Tensor
) -> BatchParams:
    batch, _, height, width = image.shape
    batch_params = BatchParams(
        matrix=torch.eye(3).to(table).expand(batch, 3, 3),
        floor=torch.ones(batch, 1, 3).to(table),
        frame=table.new_zeros(batch, 6),
        curves=table.new_empty(batch, 0),
        shading=table.new_empty(0),
    )
    for stage in stages:
        batch_params = stage.adjust(batch_params, params, place, (height, width))
    return batch_params


@torch.no_grad()
@one_thread()  # as above, and the same gains in every process
def _place_gain(
    stages: Sequence[Stage],
    params: ISPParams,
    place: Tensor | None,
    size: tuple[int, int],
    like: Tensor,
    forward: bool,
) -> Tensor | None:
    """Compute place-dependent gains of pictures of a size, from :data:`_PLACE_NODES` nodes a side.

    Returns:
        ``(B, 1 or 3, H, W)``, or None without any.
    """
    factors = [stage.place_gain(forward) for stage in stages]
    place_gains = [factor for factor in factors if factor is not None]
    if not place_gains:
        return None

    height, width = size
    places = [[0, 0, height, width]] * len(params.gains)
    if place is not None:
        places = place.tolist()
    frame = like.new_tensor([mask_frame(row, height, width, (0.0, 0.0)) for row in places])
    sides = like.new_tensor(places)[:, 2:4]
    edges = sides / sides.square().sum(dim=1, keepdim=True).sqrt()

    down = torch.linspace(0.0, height - 1.0, min(_PLACE_NODES, height)).to(like)[:, None]
    right = torch.linspace(0.0, width - 1.0, min(_PLACE_NODES, width)).to(like)
    start_y, start_x, down_y, down_x, right_y, right_x = frame[:, :, None, None].unbind(1)
    y = start_y + down * down_y + right * right_y
    x = start_x + down * down_x + right * right_x
    coordinates = torch.stack([y, x], dim=1)

    # One picture at a time: on a GPU the bits of a convolution depend on the number of pictures.
    gains = []
    for number, picture in enumerate(coordinates.split(1)):
        edge = edges[number : number + 1]
        setting = ISPParams(*[tensor[number : number + 1] for tensor in params])
        gain = torch.ones_like(picture[:, :1])
        for place_gain in place_gains:
            gain = gain * place_gain(picture, edge, setting)
        gains.append(gain)
    gain = torch.cat(gains)
    return F.interpolate(gain, size, mode="bilinear", align_corners=True)


def _pass(srgb: Tensor, camera: Unprocessing, white: float) -> Tensor:
    if srgb.dtype != torch.uint8:
        srgb = srgb.float()
    return fastest("unprocess", srgb, camera, white, otherwise=lambda: unprocess(srgb, camera, white))


def _require_batch(srgb: Tensor, params: ISPParams, place: Tensor | None, blur: Tensor | None = None) -> None:
    """Raise ValueError unless ``srgb`` is ``(B, 3, H, W)`` with even sides and all else is for B pictures."""
    if srgb.ndim != 4 or srgb.shape[1] != 3 or srgb.shape[2] % 2 or srgb.shape[3] % 2:
        raise ValueError(f"sRGB must have shape (B, 3, H, W) with even sides, got {tuple(srgb.shape)}")
    for what, value in (("matrix", params.matrix), ("gains", params.gains), ("place", place), ("blur", blur)):
        if value is not None and len(value) != len(srgb):
            raise ValueError(f"{what} is for {count_of(len(value), 'picture')}, but the batch has {len(srgb)}")


def _as_table(values: Tensor, nodes: int) -> Tensor:
    """Arrange values on the cube ``(1, C, N, N * N)`` as ``(N, N, N, 4)``; missing channels are 0."""
    channels_last = values[0].permute(1, 2, 0).reshape(nodes, nodes, nodes, -1)
    return F.pad(channels_last, (0, 4 - channels_last.shape[-1])).contiguous()
