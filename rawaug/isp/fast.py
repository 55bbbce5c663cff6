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
from functools import lru_cache, partial
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
from rawaug.isp.stages import BatchParams, PlaceGain, Stage, Tables, node_colours
from rawaug.isp.tone import STEPS, to_code
from rawaug.kernels import can_use_triton, fastest
from rawaug.kernels.reference import Display, Unprocessing, blur_taps, fall_off, look_up, mask_frame, render, unprocess
from rawaug.kernels.runtime import move_together, one_thread

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
        self.config = isp.config
        self._host = _copy_to_host(isp)
        (red, first_green, second_green, blue) = CFA(isp.config.cfa).sites
        self._sites = ((*red, 0), (*first_green, 1), (*second_green, 1), (*blue, 2))

        table, attention = _tables(isp, nodes)
        self.register_buffer("table", table)
        self.register_buffer("attention", attention)

    @property
    def host(self) -> DictionaryISP:
        """The ISP on the host, wherever the tables are."""
        return self._host[0]

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
        gain = self._gain(srgb, params, place)
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
            gain = self._gain(srgb, params, place)
        else:
            camera = camera._replace(attention=camera.attention[:0], shading=camera.shading[:0])

        ceiling = white if gain is None else math.inf

        def in_three_passes() -> Tensor:
            planes = []
            for colour in range(3):
                sites = tuple((i, j, colour) for i, j in CFA.RGGB.sites)
                packed = _pass(srgb, camera._replace(sites=sites), ceiling)
                planes.append(unpack(packed, CFA.RGGB))
            return torch.cat(planes, dim=1)

        rgb = fastest("colours", _as_pixels(srgb), camera, ceiling, otherwise=in_three_passes)
        if gain is None:
            return rgb
        return (rgb * gain).clamp_max(white)

    @torch.no_grad()
    def with_noise(
        self,
        srgb: Tensor,
        params: ISPParams,
        levels: Tensor,
        keys: Sequence[int],
        place: Tensor | None = None,
        blur: Tensor | None = None,
        colours: bool = False,
        mapped: bool = True,
    ) -> tuple[Tensor, Tensor, Tensor] | None:
        """Convert sRGB to noisy and clean RAW and the variance map in a single pass, clipped at 1.

        Args:
            srgb, params, place, blur: as in :meth:`forward`.
            levels, keys: shot and read variance ``(B, 2)`` and the number of the noise of each picture, as for
                ``shot_read`` of :mod:`rawaug.kernels.cpu`.
            colours: whether clean RAW has all three colours at every pixel, ``(B, 3, H, W)``.
            mapped: whether to compute the variance map; it is empty otherwise.

        Returns:
            Noisy, clean, variance; None where there is no such pass, and :meth:`forward` or :meth:`colours` and the
            noise have to make them one after the other.
        """
        if not can_use_triton(srgb):
            return None
        _require_batch(srgb, params, place, blur)
        if self._gain(srgb, params, place) is not None:
            return None
        camera = self._unprocessing(srgb, params, place, blur)
        return fastest(
            "raw_pairs", _as_pixels(srgb), camera, levels, keys, 1.0, colours, mapped, otherwise=lambda: None
        )

    @torch.no_grad()
    def shade(self, x4: Tensor, params: ISPParams, place: Tensor | None = None) -> Tensor:
        """Apply the shading and attention of the lens to x4 ``(B, 3, H, W)``; the result is x5."""
        camera = Unprocessing(*move_together(self._unprocessing(x4, params, place), x4.device))
        x5 = x4

        mask = fall_off(camera, 0, *x4.shape[-2:])
        if mask is not None:
            x5 = x5 * mask
        if camera.attention.numel():
            x5 = x5 * look_up(camera.attention, x5)[:, :1]

        gain = self._gain(x4, params, place)
        if gain is not None:
            x5 = x5 * gain
        return x5

    def _gain(self, image: Tensor, params: ISPParams, place: Tensor | None) -> Tensor | None:
        size = image.shape[-2], image.shape[-1]
        return _place_gain(self.host.stages.ordered, params, place, size, image.device, forward=False)

    def _unprocessing(
        self, srgb: Tensor, params: ISPParams, place: Tensor | None, blur: Tensor | None = None
    ) -> Unprocessing:
        table = self.table
        matrix, floor, frame, curves, shading = _batch_params(self.host.stages.ordered, srgb, params, place)
        if curves.numel():
            table = table[:0]
            if srgb.dtype == torch.uint8:
                curves = curves[:, ::STEPS]

        knee = self.config.knee
        rise = highlight_rise(floor, knee)
        colour = torch.cat([matrix, matrix.mean(dim=1, keepdim=True), floor, rise], dim=1)

        taps = colour.new_empty(len(srgb), 0)
        if blur is not None:
            taps = blur_taps(blur.to(colour))
        return Unprocessing(table, curves, self.attention, colour, knee or 0.0, frame, shading, self._sites, taps)


class FastForward(nn.Module):
    """The forward pass of an ISP as it is now, after demosaicing; later changes to the ISP do not affect it."""

    table: Tensor
    attention: Tensor

    def __init__(self, isp: DictionaryISP, nodes: int = NODES) -> None:
        super().__init__()
        self.cfa = CFA(isp.cfa)
        self._host = _copy_to_host(isp)

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
            return render(linear, Display(*[part.to(linear.device) for part in display]))
        return _render(linear, display)

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

        numbers = torch.tensor([bayer.METHODS.index(method) for method in methods])
        *parts, numbers = move_together([*display, numbers], raws[0].device)
        display = Display(*parts)

        def in_steps(raw: Tensor) -> Tensor:
            return render(self._demosaic(raw, methods, numbers, display.gains), display)

        return [fastest("develop", raw, display, self.cfa, numbers, otherwise=partial(in_steps, raw)) for raw in raws]

    def _gain(self, image: Tensor, params: ISPParams, place: Tensor | None) -> Tensor | None:
        size = image.shape[-2], image.shape[-1]
        stages = self._host[0].stages.ordered
        return _place_gain(stages, params, place, size, image.device, forward=True)

    def _demosaic(self, raw: Tensor, methods: Sequence[str], numbers: Tensor, gains: Tensor) -> Tensor:
        """Demosaic each picture of ``(B, 1, H, W)`` by its own method; all are made by each method, and one is kept.

        Choosing a direction needs balanced RAW clipped at black, as developers do it.
        """
        balance = gains[:, :3, None, None]
        cell = bayer.mosaic(balance.expand(-1, 3, 2, 2), self.cfa)
        sites = cell.repeat(1, 1, raw.shape[-2] // 2, raw.shape[-1] // 2)

        rgb = raw.new_zeros(len(raw), 3, *raw.shape[-2:])
        for name in dict.fromkeys(methods):
            if name in bayer.DIRECTIONAL:
                picture = bayer.demosaic((raw * sites).clamp_min(0.0), self.cfa, name) / balance
            else:
                picture = bayer.demosaic(raw, self.cfa, name)
            is_drawn = numbers == bayer.METHODS.index(name)
            rgb = torch.where(is_drawn[:, None, None, None], picture, rgb)
        return rgb

    def _display(self, linear: Tensor, params: ISPParams, place: Tensor | None) -> Display:
        table = self.table
        matrix, floor, frame, curves, shading = _batch_params(self._host[0].stages.ordered, linear, params, place)
        if curves.numel():
            table = table[:0]
            light = (
                torch.linspace(0.0, 1.0, _CURVE_NODES, dtype=torch.float32)
                .square()
                .to(curves)
                .expand(len(curves), 1, 1, -1)
            )
            curves = to_code(light, curves)[:, 0, 0]

        gains = 1.0 / floor[:, 0]
        gains = torch.cat([gains, gains.amin(dim=1, keepdim=True)], dim=1)
        return Display(table, curves, self.attention, torch.linalg.pinv(matrix), gains, frame, shading)


@torch.no_grad()
@one_thread()  # the same tables in every process
def _tables(isp: DictionaryISP, nodes: int, forward: bool = False) -> tuple[Tensor, Tensor]:
    """Make the tables of a pass: x2, or sRGB of the forward pass, and attention, which is empty if there is none."""
    if any(first.makes >= second.makes for first, second in pairwise(isp.stages.ordered)):
        order = " ".join(isp.config.stages)
        raise ValueError(f"augmentation needs the ISP's stages in the usual order, got {order}; fit it anew")
    cube = node_colours(nodes)
    with torch.autocast(isp.gain.log_gains.device.type, enabled=False):
        tables, stages = Tables(cube, cube), isp.stages.ordered
        if forward:
            tables, stages = Tables(cube, cube.square()), stages[::-1]
        for stage in stages:
            tables = stage.bake(tables, forward)

    attention = torch.empty(0, 0, 0, 4)
    if tables.attention is not None:
        attention = _as_table(tables.attention, nodes)
    return _as_table(tables.x2, nodes), attention


def _copy_to_host(isp: DictionaryISP) -> list[DictionaryISP]:
    """Copy an ISP to the host, where its stages compute the few numbers that a pass takes for each picture.

    It is in a list, which is no submodule, so that it stays there when the module around it moves.
    """
    return [deepcopy(isp).cpu().requires_grad_(False)]


def _batch_params(stages: Sequence[Stage], image: Tensor, params: ISPParams, place: Tensor | None) -> BatchParams:
    batch, _, height, width = image.shape
    batch_params = _neutral_params(batch)
    params = params.map(Tensor.cpu)
    for stage in stages:
        batch_params = stage.adjust(batch_params, params, place, (height, width))
    return batch_params


@lru_cache(maxsize=64)  # small tensors cost a single crop as much as its pixels
def _neutral_params(batch: int) -> BatchParams:
    """The numbers of an ISP that does nothing; stages replace them, and never write to them."""
    return BatchParams(
        matrix=torch.eye(3, dtype=torch.float32, device="cpu").expand(batch, 3, 3),
        floor=torch.ones(batch, 1, 3, dtype=torch.float32, device="cpu"),
        frame=torch.zeros(batch, 6, dtype=torch.float32, device="cpu"),
        curves=torch.empty(batch, 0, dtype=torch.float32, device="cpu"),
        shading=torch.empty(0, dtype=torch.float32, device="cpu"),
    )


def _place_gain(
    stages: Sequence[Stage],
    params: ISPParams,
    place: Tensor | None,
    size: tuple[int, int],
    device: torch.device,
    forward: bool,
) -> Tensor | None:
    """Compute place-dependent gains of pictures of a size, from :data:`_PLACE_NODES` nodes a side.

    Returns:
        ``(B, 1 or 3, H, W)``, or None without any.
    """
    place_gains = []
    for stage in stages:
        place_gain = stage.place_gain(forward)
        if place_gain is not None:
            place_gains.append(place_gain)
    if not place_gains:
        return None
    return _multiply_gains(place_gains, params, place, size, device)


@torch.no_grad()
@one_thread()  # as above, and the same gains in every process
def _multiply_gains(
    place_gains: Sequence[PlaceGain],
    params: ISPParams,
    place: Tensor | None,
    size: tuple[int, int],
    device: torch.device,
) -> Tensor:
    height, width = size
    places = [[0, 0, height, width]] * len(params.gains)
    if place is not None:
        places = place.tolist()
    frames = [mask_frame(row, height, width, (0.0, 0.0)) for row in places]
    frame = torch.tensor(frames, dtype=torch.float32)
    sides = torch.tensor(places, dtype=torch.float32)[:, 2:4]
    edges = sides / sides.square().sum(dim=1, keepdim=True).sqrt()

    down = torch.linspace(0.0, height - 1.0, min(_PLACE_NODES, height), dtype=torch.float32)[:, None]
    right = torch.linspace(0.0, width - 1.0, min(_PLACE_NODES, width), dtype=torch.float32)
    start_y, start_x, down_y, down_x, right_y, right_x = frame[:, :, None, None].unbind(1)
    y = start_y + down * down_y + right * right_y
    x = start_x + down * down_x + right * right_x
    coordinates = torch.stack([y, x], dim=1)

    # One picture at a time: the bits of a convolution may depend on the number of pictures.
    params = params.map(Tensor.cpu)
    gains = []
    for number, picture in enumerate(coordinates.split(1)):
        edge = edges[number : number + 1]
        setting = ISPParams(*[tensor[number : number + 1] for tensor in params])
        gain = torch.ones_like(picture[:, :1])
        for place_gain in place_gains:
            gain = gain * place_gain(picture, edge, setting)
        gains.append(gain)

    (nodes,) = move_together([torch.cat(gains)], device)
    return F.interpolate(nodes, size, mode="bilinear", align_corners=True)


def _as_pixels(srgb: Tensor) -> Tensor:
    """Pictures as the passes read them, uint8 or float32."""
    return srgb if srgb.dtype == torch.uint8 else srgb.float()


def _pass(srgb: Tensor, camera: Unprocessing, white: float) -> Tensor:
    srgb = _as_pixels(srgb)
    return fastest("unprocess", srgb, camera, white, otherwise=lambda: unprocess(srgb, camera, white))


def _render(linear: Tensor, display: Display) -> Tensor:
    def in_pytorch() -> Tensor:
        return render(linear, Display(*move_together(display, linear.device)))

    return fastest("render", linear, display, otherwise=in_pytorch)


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
