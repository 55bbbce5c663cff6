r"""Online augmentation: sRGB pictures to noisy/clean RAW pairs.

``y = isp^-1(x; C, g, T)`` inverts the camera's development. Its setting (matrix, gains, tone curve) is drawn from the
hulls of the dictionaries' atoms or, for an ISP of published cameras, as one camera in one light
(:mod:`rawaug.isp.dictionary`). Then noise is added, ``noisy ~ N(y, shot_var y + read_var)``. The result is clipped at
white, never at black (Conde et al., AAAI 2022, "Dictionary Augmentations").

:class:`RawAugment` works on batches, on the device of the batch. It first draws its parameters and then applies them;
the same parameters reproduce the pair bit for bit. :mod:`rawaug.plugin.dataset` applies it to a Dataset,
:mod:`rawaug.plugin.wrapped` to a DataLoader.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import AbstractContextManager, nullcontext
from copy import copy, deepcopy
from operator import itemgetter
from pathlib import Path
from typing import Any, TypeVar, get_args

import torch
from torch import Tensor, nn

from rawaug import bayer
from rawaug.bayer import CFA, pattern
from rawaug.camera.own import Camera
from rawaug.errors import count_of
from rawaug.isp.config import ISPParams
from rawaug.isp.fast import BakedISP, FastForward
from rawaug.isp.model import DictionaryISP
from rawaug.kernels import can_use_triton
from rawaug.kernels.runtime import eager, take_pictures
from rawaug.noise import Iso, NoiseSpec, noise_model
from rawaug.noise.models import ShotReadNoise
from rawaug.plugin.camera_noise import noise_label, usual_noise, with_iso
from rawaug.plugin.crops import cut_patch, draw_patch
from rawaug.plugin.draw import Draw, SettingSampler
from rawaug.plugin.maker import PairMaker
from rawaug.plugin.params import AugmentParams, RawPair
from rawaug.plugin.pictures import is_picture, stack_pictures, to_rgb_batch, to_rgb_tensor, trim_to_even
from rawaug.plugin.targets import Burst, Srgb, Target, keep_white
from rawaug.seeding import keyed_generator


class RawAugment(PairMaker):
    """Make RAW pairs of batches of sRGB pictures.

    The module has no parameters and adds nothing to the ``state_dict`` of a surrounding network. It stays float32:
    ``half()``, ``bfloat16()`` and ``double()`` change nothing, and ``to(device)`` moves it. Calling it draws
    parameters (:meth:`sample`) and applies them (:meth:`apply`), on the device of the batch. Pictures come in any form
    that :mod:`rawaug.plugin.pictures` lists.

    Args:
        isp: the camera. A frozen copy is taken, so later changes do not affect it. A :class:`rawaug.Camera` stands for
            the ISP ``universal`` with this camera.
        noise: name of a preset or a measured camera, (shot_var, read_var), a law such as
            :class:`rawaug.noise.MeasuredLevels`, a :class:`rawaug.noise.NoiseModel`, or ``"camera"`` for the levels
            that were measured when the ISP was fitted, or that a :class:`rawaug.Camera` states.
            The default is the noise of the :class:`rawaug.Camera`, else ``"cycleisp_sidd"``.
        draw: how cameras, lights, tone curves, exposures and the blur of the lens are drawn.
        target: what the pair holds. ``"raw"``: noisy and clean RAW. ``"rgb"``: noisy RAW, and clean linear camera RGB
            ``(B, 3, H, W)`` of the full size, for demosaicing. ``"srgb"`` or an :class:`Srgb`: both as sRGB
            ``(B, 3, H, W)`` in [0, 1], developed by the setting that made the RAW, and no variance map.
        burst: number N of noisy frames of the scene in a pair, ``(B, N, ...)``, that do not move against each other,
            or a :class:`Burst`, for a moving hand or a bracket. The clean frame belongs to the first noisy one. By
            default there is a single frame, without the N.
        cfa: pattern of the RAW, by default the ISP's: another Bayer pattern, ``"XTRANS"``, or ``"QUAD-RGGB"`` and the
            like. Patterns other than Bayer's give a mosaic ``(B, 1, H, W)`` instead of packed RAW; see
            :mod:`rawaug.bayer`.
        seed: seed of the module's own draws, used where no generator is passed. They are counted from its construction:
            to resume, pass a generator, or use RawPairs or wrap.

    Raises:
        ValueError: if a setting is unknown or out of range, or the noise distinguishes Bayer planes and the pattern
            has none.

    Example:
        >>> augment = RawAugment(DictionaryISP(), noise="cycleisp_sidd")
        >>> pair = augment(torch.rand(2, 3, 64, 64))
        >>> pair.noisy.shape
        torch.Size([2, 4, 32, 32])
        >>> torch.equal(pair.noisy, augment.apply(torch.zeros(2, 3, 64, 64), pair.params).noisy)
        False
    """

    stream = "augment"

    def __init__(
        self,
        isp: DictionaryISP | Camera,
        noise: NoiseSpec | None = None,
        *,
        draw: Draw = Draw(),
        target: Target | Srgb = "raw",
        burst: int | Burst | None = None,
        cfa: str | None = None,
        seed: int = 0,
    ) -> None:
        super().__init__(seed)
        if isinstance(isp, Camera):
            isp = _isp_of_camera(isp)
        if noise is None:
            noise = usual_noise(isp)

        # A Bayer pattern is a setting of the ISP; for other patterns the colours are sampled after it.
        if cfa is None:
            cfa = isp.info.get("pattern")
        self.pattern = None if cfa is None else pattern(cfa)
        if self.pattern is not None and self.pattern.name in CFA.__members__:
            isp, self.pattern = deepcopy(isp), None
            isp.configure(cfa=str(cfa))
        self.isp = freeze(deepcopy(isp))
        self.baked = freeze(BakedISP(isp))

        self.srgb: Srgb | None = None
        if isinstance(target, Srgb):
            self.srgb, target = target, "srgb"
        elif target == "srgb":
            self.srgb = Srgb()
        if target not in get_args(Target):
            raise ValueError(f"target {target!r} is unknown; use one of {', '.join(get_args(Target))}")
        if self.srgb is not None and self.pattern is not None:
            raise ValueError(f"target 'srgb' demosaics Bayer patterns, not {self.cfa}; use target 'rgb' or 'raw'")
        self.target: Target = target

        self.display: FastForward | None = None  # tables that developing needs
        if self.srgb is not None:
            self.display = freeze(FastForward(isp))
        if burst is not None and not isinstance(burst, Burst):
            burst = Burst(burst, motion=(0.0, 0.0))
        self.burst = burst
        self._set_draws(noise, draw)

    def _set_draws(self, noise: NoiseSpec, draw: Draw) -> None:
        self.settings = SettingSampler(draw, self.isp, self.baked)
        self.noise = noise_model(noise, info=self.isp.info)
        self.noise_name = noise_label(noise)
        if self.pattern is not None and self.noise.by_plane:
            raise ValueError(f"this noise needs the planes R, Gr, Gb, B, which {self.pattern.name} does not have")
        self._calls = 0

    def with_draws(self, noise: NoiseSpec, draw: Draw = Draw()) -> RawAugment:
        """Make an augmentation with the same ISP, pattern and target but other draws; nothing is baked again.

        Args:
            noise, draw: as in the constructor, whose errors they raise.
        """
        other = copy(self)
        other._set_draws(noise, draw)
        return other

    @classmethod
    def from_pretrained(
        cls,
        isp: str | Path | DictionaryISP | Camera,
        noise: NoiseSpec | None = None,
        *,
        camera: str | Path | Camera | Sequence[str | Path | Camera] | None = None,
        iso: Iso = None,
        draw: Draw = Draw(),
        target: Target | Srgb = "raw",
        burst: int | Burst | None = None,
        cfa: str | None = None,
        seed: int = 0,
    ) -> RawAugment:
        """Make an augmentation from the name of a shipped ISP, from an ISP's file, or from an ISP.

        Args:
            isp: the name, path or ISP; or a :class:`rawaug.Camera`, or the path of its YAML file.
            noise: as in the constructor; with ``iso`` the default is the noise of ``camera``.
            camera: maker and model of a published camera, a :class:`rawaug.Camera` of your own or the path of its YAML
                file, or several of these, in place of the ISP's colour atoms; for an ISP of published cameras, such as
                ``universal``.
            iso: ISO of the noise of a measured camera, or (lowest, highest); ``rawaug info cameras`` lists the measured
                ranges. The default is the whole range.
            draw, target, burst, cfa, seed: as in the constructor.

        Raises:
            FileNotFoundError: if there is no such ISP.
            ValueError: if a camera is not listed, the ISP was fitted to frames, or no noise was measured at this ISO.

        Example:
            >>> augment = RawAugment.from_pretrained("universal", camera="Nikon D750")
            >>> augment.isp.info["cameras"]
            ['Nikon D750']
            >>> RawAugment.from_pretrained("universal", camera="Nikon D750", iso=800)
            RawAugment, camera: Nikon D750, convex, exposure -0.5 to 1 stops
              noise: Nikon D750 iso=800
              target: raw, RGGB
        """
        if isinstance(isp, Camera):
            isp = _isp_of_camera(isp)
        elif not isinstance(isp, DictionaryISP):
            isp = DictionaryISP.from_pretrained(isp)
        if camera is not None:
            isp = isp.with_cameras(camera)

        if noise is None:
            noise = usual_noise(isp)
            if iso is not None and noise != "camera" and camera is not None:
                noise = _noise_of_cameras(camera)
        return cls(isp, with_iso(noise, iso), draw=draw, target=target, burst=burst, cfa=cfa, seed=seed)

    # -- draw, apply: see PairMaker -----------------------------------------------------------------------------------

    def look(self, whole: Any, bgr: bool = False) -> ISPParams | None:
        """Choose the setting of a whole picture for the samplings ``perturb`` and ``chosen``; None for the others.

        Args:
            whole: a picture, in any form; None if it is unknown, and the constants of the ISP serve.
            bgr: whether its channels are in the order B, G, R.
        """
        if not self.settings.looks:
            return None
        if whole is None:
            return self.settings.constants
        return self.settings.choose(to_rgb_tensor(whole, bgr)[None].to(self.device))

    def draw_params(
        self, batch: Tensor, generator: torch.Generator, crop: Tensor | None, chosen: ISPParams | None = None
    ) -> AugmentParams:
        """Draw the parameters of pictures ``(B, 3, H, W)``.

        The samplings ``perturb`` and ``chosen`` look at whole pictures for which nothing was chosen; the others only
        count them.
        """
        self._require_here(batch)
        if chosen is None and crop is not None:
            chosen = self.look(None)
        if crop is None:
            crop = torch.tensor([0, 0, *batch.shape[-2:], 0]).repeat(len(batch), 1)

        with _float32(batch):
            setting = self.settings.sample(batch, generator, chosen)
            return self._draw_noise(setting, generator, crop)

    def _draw_noise(self, setting: ISPParams, generator: torch.Generator, crop: Tensor) -> AugmentParams:
        """Draw what follows after the camera settings: the noise, and what the target needs."""
        batch = len(crop)
        noise = self.noise.sample(batch, generator)
        extras: dict[str, Tensor] = {}
        if self.srgb is not None:
            extras |= self.srgb.sample(batch, generator)
        if self.burst is not None:
            extras |= self.burst.sample(batch, generator)
        extras |= self.settings.sample_blur(batch, generator)
        return AugmentParams(setting, noise, crop, extras)

    @eager
    def sample_each(
        self,
        batch: Tensor,
        generators: Sequence[torch.Generator],
        crops: Tensor,
        chosen: Sequence[ISPParams | None],
    ) -> AugmentParams:
        """Draw the parameters of each picture from a generator of its own, published cameras in one pass."""
        if not self.settings.takes_rows:
            return super().sample_each(batch, generators, crops, chosen)

        self._require_here(batch)
        with _float32(batch):
            settings = self.settings.sample(batch, generators)
            if len(batch) == 1:
                return self._draw_noise(settings, generators[0], crops)

            parts = []
            for row, (generator, crop) in enumerate(zip(generators, crops.split(1), strict=True)):
                setting = settings.map(itemgetter(slice(row, row + 1)))
                parts.append(self._draw_noise(setting, generator, crop))
        return AugmentParams.concatenate(parts)

    def apply_params(self, batch: Tensor, params: AugmentParams) -> RawPair:
        """Make the pairs of pictures ``(B, 3, H, W)`` that the parameters describe."""
        self._require_here(batch)
        self._require_as_many(batch, params)
        host = params.map(Tensor.cpu)  # where they are drawn, unless they have been moved since
        with _float32(batch):
            if self.burst is not None:
                noisy, clean, variance = self._burst(batch, host, self.burst)
            else:
                noisy, clean, variance = self._shot(batch, host)
            return RawPair(noisy, clean, variance, params)

    def _shot(self, srgb: Tensor, params: AugmentParams) -> tuple[Tensor, Tensor, Tensor]:
        """Make noisy, clean and variance of single shots, in one pass where there is one."""
        in_colour = self.target == "rgb"
        in_bayer = self.pattern is None and can_use_triton(srgb)
        if in_bayer and isinstance(self.noise, ShotReadNoise) and self.noise.is_plain:
            in_one_pass = self.baked.with_noise(
                srgb,
                params.isp,
                *self.noise.levels_and_keys(params.noise),
                params.crop,
                params.extras.get("blur"),
                colours=in_colour,
                mapped=self.srgb is None,
            )
            if in_one_pass is not None:
                noisy, clean, variance = in_one_pass
                if self.srgb is not None:
                    return self._developed(self.srgb, noisy, clean, params)
                return noisy, clean, variance

        if not in_colour:
            return self._noisy(self._clean(srgb, params), params)

        clean = self.baked.colours(srgb, params.isp, params.crop, 1.0, params.extras.get("blur"))
        noisy, _, variance = self._noisy(self._planes(clean), params)
        return noisy, clean, variance

    def _clean(self, srgb: Tensor, params: AugmentParams) -> Tensor:
        if self.pattern is None:
            return self.baked(srgb, params.isp, params.crop, 1.0, params.extras.get("blur"))
        return self._planes(self.baked.colours(srgb, params.isp, params.crop, 1.0, params.extras.get("blur")))

    def _planes(self, rgb: Tensor) -> Tensor:
        """Sample RGB ``(B, 3, H, W)`` as four planes: packed RAW, or the sites of 2 x 2 squares for other patterns."""
        if self.pattern is None:
            return bayer.pack_rgb(rgb, self.isp.cfa)
        return bayer.pack(self.pattern.mosaic(rgb), CFA.RGGB)

    def _noisy(self, planes: Tensor, params: AugmentParams) -> tuple[Tensor, Tensor, Tensor]:
        """Add noise to clean planes ``(B, 4, H/2, W/2)``; return noisy, clean and variance, as RAW or developed."""
        noise = self.noise.move(params.noise, planes.device)
        if self.srgb is not None:
            raw = self.noise.apply(planes, noise)
            _require_finite(raw)
            return self._developed(self.srgb, raw, planes, params)

        noisy, variance = self.noise.apply_with_variance(planes, noise)
        _require_finite(noisy)
        if self.pattern is None:
            return noisy, planes, variance
        return bayer.unpack(noisy, CFA.RGGB), bayer.unpack(planes, CFA.RGGB), bayer.unpack(variance, CFA.RGGB)

    def _developed(
        self, target: Srgb, raw: Tensor, planes: Tensor, params: AugmentParams
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Develop noisy and clean planes ``(B, 4, H/2, W/2)``; there is no variance."""
        noisy, clean = bayer.unpack(raw, self.isp.cfa), bayer.unpack(planes, self.isp.cfa)
        shots = self._further_shots(target, planes, params)
        noisy, clean = target.develop(self._forward_pass(), noisy, clean, params, shots)
        return noisy, clean, noisy.new_empty(len(noisy), 0)

    def _further_shots(self, target: Srgb, planes: Tensor, params: AugmentParams) -> list[Tensor]:
        """Make mosaics ``(b, 1, H, W)`` in pairs of opposite noise, of the b pictures whose target is their mean."""
        is_averaged = target.needs_shots(params)
        if not is_averaged.any():
            return []

        planes = take_pictures(planes, is_averaged)
        params = params.map(lambda tensor: tensor[is_averaged])

        shots = []
        for seed in params.extras["shot_seed"].unbind(1):
            shot_noise = self.noise.move(_with_seed(params.noise, seed), planes.device)
            noise = self.noise.disturb(planes, shot_noise) - planes
            for shot in (planes + noise, planes - noise):
                shots.append(bayer.unpack(shot.clamp_(max=1.0), self.isp.cfa))
        return shots

    def _burst(self, srgb: Tensor, params: AugmentParams, burst: Burst) -> tuple[Tensor, Tensor, Tensor]:
        """Make pairs of N noisy frames; each frame has its own noise, and all share the sensor's defects."""
        frame_params = params.map(lambda tensor: tensor.repeat_interleave(burst.frames, 0))
        noise = _with_seed(frame_params.noise, params.extras["frame_seed"].flatten())
        frame_params = frame_params._replace(noise=noise)

        scene = self.baked.colours(srgb, params.isp, params.crop, blur=params.extras.get("blur"), shaded=False)
        moving = burst.move(scene, params.extras["motion"])
        frames = burst.expose(self.baked.shade(moving, frame_params.isp, frame_params.crop))
        noisy, clean, variance = self._noisy(self._planes(frames), frame_params)
        if self.target == "rgb":
            clean = frames

        bursts = (len(srgb), burst.frames)
        noisy, variance = noisy.unflatten(0, bursts), variance.unflatten(0, bursts)
        return noisy, clean.unflatten(0, bursts)[:, 0], variance

    # -- back to sRGB -------------------------------------------------------------------------------------------------

    @eager
    def develop(self, raw: Tensor, params: AugmentParams, demosaicing: str = "malvar") -> Tensor:
        """Develop a pair's RAW (noisy, clean or denoised) for viewing, by the camera setting that made it.

        Args:
            raw: packed RAW ``(B, 4, h, w)``, or ``(4, h, w)`` of a sample of a Dataset; white = 1.
            params: the pair's parameters, ``pair.params``.
            demosaicing: a name of :data:`rawaug.bayer.METHODS`.

        Returns:
            float32 sRGB ``(B, 3, 2h, 2w)`` or ``(3, 2h, 2w)`` in [0, 1].

        Raises:
            ValueError: if it is not packed RAW, or ``params`` are for another number of pictures.

        Example:
            >>> augment = RawAugment(DictionaryISP())
            >>> pair = augment(torch.rand(2, 3, 64, 64))
            >>> augment.develop(pair.noisy, pair.params).shape
            torch.Size([2, 3, 64, 64])
        """
        if not isinstance(params, AugmentParams):
            raise ValueError(f"develop takes the params of a pair, pair.params, got {type(params).__name__}")
        if raw.ndim == 3:
            return self.develop(raw[None], params.map(lambda tensor: tensor[None]), demosaicing)[0]
        if self.pattern is not None or raw.ndim != 4 or raw.shape[1] != 4 or min(raw.shape[-2:]) < 2:
            raise ValueError(
                f"develop takes packed RAW of a Bayer pattern, (B, 4, h, w) or (4, h, w) from 2 x 2 on, "
                f"got {tuple(raw.shape)} of {self.cfa}"
            )
        self._require_as_many(raw, params)
        bayer.require_method(demosaicing)

        mosaic = bayer.unpack(raw.float(), self.isp.cfa)
        methods = [demosaicing] * len(raw)
        with _float32(raw):
            setting = keep_white(params.isp.map(Tensor.cpu))
            (srgb,) = self._forward_pass().develop([mosaic], methods, setting, params.crop)
        return srgb

    def _forward_pass(self) -> FastForward:
        if self.display is None:
            self.display = freeze(FastForward(self.isp))
        return self.display

    # -- pictures -----------------------------------------------------------------------------------------------------

    def is_single(self, inputs: Any) -> bool:
        """Whether this is one picture, and not a batch."""
        return is_picture(inputs)

    def open_folder(self, path: str | Path, size: tuple[int, int] | None) -> Any:
        """The pictures of a folder, or of ``kind:path``, less those that are smaller than a crop of ``size``."""
        from rawaug.data import open_pictures

        min_side = 2 if size is None else min(size)
        return open_pictures(str(path), min_side=min_side)

    def as_batch(self, inputs: Any, bgr: bool = False) -> Tensor:
        """Pictures of one size as ``(B, 3, H, W)`` with even sides, uint8 or float32."""
        return trim_to_even(to_rgb_batch(inputs, bgr))

    def stack(self, patches: Sequence[Tensor]) -> Tensor:
        """Stack patches of one size to ``(B, 3, H, W)``."""
        return stack_pictures(patches)

    def draw_patch(
        self,
        whole: Any,
        size: tuple[int, int] | None,
        views: bool,
        generator: torch.Generator,
        zoom: float = 1.0,
        bgr: bool = False,
    ) -> tuple[Tensor, Tensor]:
        """Draw a crop of a picture, and cut it out; see :func:`rawaug.plugin.crops.draw_patch`."""
        return draw_patch(whole, size, views, generator, zoom, bgr)

    def cut_patch(self, whole: Any, place: Tensor, size: tuple[int, int] | None, bgr: bool = False) -> Tensor:
        """Cut the patch of a drawn place out of a picture; see :func:`rawaug.plugin.crops.cut_patch`."""
        return cut_patch(trim_to_even(to_rgb_tensor(whole, bgr)), place, size)

    @torch.no_grad()
    def measure_signals(self, pictures: Iterable[Any], draws: int = 4, seed: int = 0) -> list[float]:
        """Measure the mean signal of the clean RAW that pictures become, to set the noise by the PSNR of the pairs.

        Args:
            pictures: some of the training pictures, in any form that :mod:`rawaug.plugin.pictures` lists.
            draws: number of camera settings to draw for each picture.
            seed: seed of these draws.

        Returns:
            Mean signals, white = 1, one for each picture and draw.

        Example:
            >>> from rawaug.noise import CalibratedNoise
            >>> augment = RawAugment(DictionaryISP())
            >>> noise = CalibratedNoise(41.18, signal=augment.measure_signals([torch.rand(3, 32, 32)]))
            >>> calibrated = augment.with_draws(noise)
        """
        signals = []
        for number, picture in enumerate(pictures):
            generator = keyed_generator(seed, "signals", number)
            batch = self.as_batch(picture).to(self.device).expand(draws, -1, -1, -1)
            clean = self._clean(batch, self.draw_params(batch, generator, None))
            signals += clean.mean((1, 2, 3)).clamp(1e-6, 1.0).tolist()
        return signals

    # -- the module ---------------------------------------------------------------------------------------------------

    @property
    def cfa(self) -> str:
        """The pattern of the RAW, such as ``"RGGB"`` or ``"XTRANS"``."""
        return str(self.isp.cfa) if self.pattern is None else self.pattern.name

    def load_kernels(self) -> None:
        """Load the compiled code, 0.3 s, in the process that will be forked: else every worker of every pass does."""
        if self.device.type == "cpu":
            black = torch.zeros(1, 3, 2, 2, dtype=torch.uint8)
            self.baked(black, self.settings.constants)

    @property
    def is_row_exact(self) -> bool:
        """Whether the pairs of a batch have the bits that each has alone: RAW has, a development is off by rounding."""
        return self.srgb is None

    def mosaic(self, raw: Tensor) -> Tensor:
        """Unpack RAW of a pair ``(..., 4, H/2, W/2)`` to a mosaic ``(..., 1, H, W)``; others already are one."""
        return bayer.unpack(raw, self.isp.cfa) if self.pattern is None else raw

    @property
    def device(self) -> torch.device:
        """The device that pairs are made on."""
        return self.isp.gain.log_gains.device

    def __repr__(self) -> str:
        """Describe in three lines what is drawn: the camera, the noise and the target."""
        target: str | Srgb = self.target
        if self.srgb is not None and self.srgb != Srgb():
            target = self.srgb
        line = f"{target}, {self.cfa}"
        if self.burst is not None:
            line += f", bursts of {count_of(self.burst.frames, 'frame')}"
        return f"RawAugment, camera: {self.settings!r}\n  noise: {self.noise_name}\n  target: {line}"

    def _apply(self, fn: Callable[[Tensor], Tensor], recurse: bool = True) -> RawAugment:
        """Move with the surrounding network, but stay float32."""

        def move(tensor: Tensor) -> Tensor:
            probe = fn(tensor.new_empty(0))
            if probe.dtype == tensor.dtype:
                return fn(tensor)
            return tensor.to(probe.device)

        return super()._apply(move, recurse)

    def _require_here(self, srgb: Tensor) -> None:
        if srgb.device != self.device:
            raise ValueError(f"pictures on {srgb.device}, but augmentation on {self.device}; call augment.to(...)")


M = TypeVar("M", bound=nn.Module)


def freeze(module: M) -> M:
    """Put a module in eval mode, with its tensors as buffers that no ``state_dict`` holds."""
    for part in module.eval().modules():
        tensors = {**part._parameters, **part._buffers}
        for name, tensor in tensors.items():
            if tensor is not None:
                delattr(part, name)
                part.register_buffer(name, tensor.detach(), persistent=False)
    return module


def _isp_of_camera(camera: Camera | str | Path) -> DictionaryISP:
    """The ISP ``universal`` with the user's own camera in place of the published ones."""
    return DictionaryISP.from_pretrained("universal").with_cameras(camera)


def _noise_of_cameras(camera: str | Path | Camera | Sequence[str | Path | Camera]) -> str | list[str]:
    """Turn the names of cameras into the names of their noise."""
    if isinstance(camera, (str, Path, Camera)):
        return str(camera)
    names = [str(name) for name in camera]
    return names[0] if len(names) == 1 else names


def _with_seed(noise: Mapping[str, Tensor], seed: Tensor) -> dict[str, Tensor]:
    """Change the seeds ``(B,)`` of the noise that every shot has anew; the defects of the sensor stay."""
    if "seed" not in noise:
        return dict(noise)
    return {**noise, "sensor_seed": noise["seed"], "seed": seed}


def _require_finite(raw: Tensor) -> None:
    """Refuse what damaged weights produce; this is checked on the CPU only, because it would stall other devices."""
    if raw.device.type == "cpu" and not math.isfinite(raw.numpy().min()):  # NumPy: PyTorch's threads die in a fork
        raise ValueError("the RAW has values that are not finite: the ISP's weights are damaged; fit or copy it again")


def _float32(like: Tensor) -> AbstractContextManager[Any]:
    """Keep RAW in float32, inside mixed precision too."""
    if not torch.is_autocast_enabled(like.device.type):
        return nullcontext()
    return torch.autocast(like.device.type, enabled=False)
