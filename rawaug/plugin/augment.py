r"""Online augmentation: sRGB pictures to noisy/clean RAW pairs.

``y = isp^-1(x; C, g, T)`` with the camera setting (matrix, gains, tone curve) drawn from the hulls of the dictionaries'
atoms, or of an ISP of published cameras as one camera in one light (:mod:`rawaug.isp.dictionary`), then
``noisy ~ N(y, shot_var y + read_var)``, clipped at white, never at black (Conde et al., AAAI 2022, "Dictionary
Augmentations").

:class:`RawAugment` works on batches, on the device of the batch. It draws its parameters first and applies them after,
and the parameters replay the pair bit for bit. :mod:`rawaug.plugin.dataset` puts it behind a Dataset,
:mod:`rawaug.plugin.loader` behind a DataLoader.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from copy import copy, deepcopy
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar, get_args, overload

import numpy as np
import torch
from torch import Tensor, nn
from torch.utils.data import get_worker_info

from rawaug import bayer
from rawaug.bayer import CFA, pattern
from rawaug.isp.fast import BakedISP, FastForward
from rawaug.isp.model import DictionaryISP, restrict_to_cameras
from rawaug.isp.own_cameras import Camera
from rawaug.isp.own_sampler import own_cameras
from rawaug.kernels.runtime import eager
from rawaug.noise import Iso, MeasuredLevels, NoiseLevels, NoiseModel, NoiseSpec, noise_model
from rawaug.noise.cameras import is_law, measured_noise
from rawaug.plugin.crops import cut_patch, draw_patch
from rawaug.plugin.draw import Draw, SettingSampler
from rawaug.plugin.params import AugmentParams, RawPair
from rawaug.plugin.pictures import (
    find_picture,
    get_picture,
    is_picture,
    replace_picture,
    stack_pictures,
    to_rgb_batch,
    to_rgb_tensor,
    trim_to_even,
)
from rawaug.plugin.targets import Burst, Srgb, Target, keep_white
from rawaug.registry import check_settings, spec_label, split_spec
from rawaug.seeding import keyed_generator, rank_key


class RawAugment(nn.Module):
    """Make RAW pairs of batches of sRGB pictures.

    The module has no parameters and adds nothing to the ``state_dict`` of a surrounding network. It stays float32:
    ``half()``, ``bfloat16()`` and ``double()`` change nothing, and ``to(device)`` moves it. Calling it draws
    parameters (:meth:`sample`) and applies them (:meth:`apply`), on the device of the batch.

    Args:
        isp: the camera; a frozen copy is taken, later changes do not reach it. A :class:`rawaug.Camera` stands for the
            ISP ``universal`` with this camera.
        noise: name of a preset or a measured camera, (shot_var, read_var), a law such as
            :class:`rawaug.noise.MeasuredLevels`, a :class:`rawaug.noise.NoiseModel`, or ``"camera"`` for the levels
            that were measured when the ISP was fitted, or that a :class:`rawaug.Camera` states.
            By default those of the :class:`rawaug.Camera`, else ``"cycleisp_sidd"``.
        draw: how cameras, lights, tone curves and exposures are drawn.
        target: what the pair holds. ``"raw"``: noisy and clean RAW. ``"rgb"``: noisy RAW, and clean linear camera RGB
            ``(B, 3, H, W)`` of the full size, for demosaicing. ``"srgb"`` or an :class:`Srgb`: both as sRGB
            ``(B, 3, H, W)`` in [0, 1], developed by the setting that made the RAW, and no variance map.
        burst: number N of noisy frames of the scene that a pair holds, ``(B, N, ...)``, or a :class:`Burst`; clean is
            that of the first. By default a single one, without the N.
        cfa: pattern of the RAW, by default the ISP's: another Bayer pattern, ``"XTRANS"``, or ``"QUAD-RGGB"`` and the
            like. RAW of these last is a mosaic ``(B, 1, H, W)`` in place of packed RAW; see :mod:`rawaug.bayer`.
        seed: of the module's own draws, where no generator is passed. They are counted from its construction: to
            resume, pass a generator, or use RawPairs or wrap.

    Raises:
        ValueError: if a setting is unknown or out of range, or the noise is one of Bayer's planes and the pattern has
            none.

    Example:
        >>> augment = RawAugment(DictionaryISP(), noise="cycleisp_sidd")
        >>> pair = augment(torch.rand(2, 3, 64, 64))
        >>> pair.noisy.shape
        torch.Size([2, 4, 32, 32])
        >>> torch.equal(pair.noisy, augment.apply(torch.zeros(2, 3, 64, 64), pair.params).noisy)
        False
    """

    def __init__(
        self,
        isp: DictionaryISP | Camera,
        noise: NoiseSpec | NoiseLevels | NoiseModel | None = None,
        *,
        draw: Draw = Draw(),
        target: Target | Srgb = "raw",
        burst: int | Burst | None = None,
        cfa: str | None = None,
        seed: int = 0,
    ) -> None:
        super().__init__()
        self._rank: tuple[int, ...] = ()
        isp = of_camera(isp) if isinstance(isp, Camera) else isp
        if noise is None:
            noise = usual_noise(isp)
        cfa = isp.info.get("pattern") if cfa is None else cfa
        self.pattern = None if cfa is None else pattern(cfa)
        if self.pattern is not None and self.pattern.name in CFA.__members__:
            isp, self.pattern = deepcopy(isp), None
            isp.configure(cfa=str(cfa))
        self.isp = freeze(isp)
        self.baked = freeze(BakedISP(isp))
        self.srgb = target if isinstance(target, Srgb) else Srgb() if target == "srgb" else None
        self.target: Target = "srgb" if isinstance(target, Srgb) else target
        if self.target not in get_args(Target):
            raise ValueError(f"target {target!r} is unknown; use one of {', '.join(get_args(Target))}")
        if self.srgb is not None and self.pattern is not None:
            raise ValueError(f"target 'srgb' demosaics Bayer patterns, not {self.cfa}; use target 'rgb' or 'raw'")
        self.display: FastForward | None = None if self.srgb is None else freeze(FastForward(isp))
        self.burst = burst if burst is None or isinstance(burst, Burst) else Burst(burst)
        self.seed = seed
        self._set_draws(noise, draw)

    def _set_draws(self, noise: NoiseSpec | NoiseLevels | NoiseModel, draw: Draw) -> None:
        self.settings = SettingSampler(draw, self.isp, self.baked)
        self.noise, self.noise_name = noise_for(self.isp, noise), _noise_name(noise)
        if self.pattern is not None and self.noise.by_plane:
            raise ValueError(f"this noise needs the planes R, Gr, Gb, B, which {self.pattern.name} does not have")
        self._calls = 0

    def with_draws(self, noise: NoiseSpec | NoiseLevels | NoiseModel, draw: Draw = Draw()) -> RawAugment:
        """An augmentation with the same ISP, pattern and target but with other draws; nothing is baked again.

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
        noise: NoiseSpec | NoiseLevels | NoiseModel | None = None,
        *,
        camera: str | Path | Camera | Sequence[str | Path | Camera] | None = None,
        iso: Iso = None,
        draw: Draw = Draw(),
        target: Target | Srgb = "raw",
        burst: int | Burst | None = None,
        cfa: str | None = None,
        seed: int = 0,
    ) -> RawAugment:
        """Make an augmentation of a shipped ISP by its name, of an ISP's file, or of an ISP.

        Args:
            isp: the name, path or ISP; or a :class:`rawaug.Camera`, or the path of its YAML file.
            noise: as in the constructor; with ``iso``, by default that of ``camera``.
            camera: maker and model of a published camera, a :class:`rawaug.Camera` of your own or the path of its YAML
                file, or several of these, in place of the ISP's colour atoms; for an ISP of published cameras, such as
                ``universal``.
            iso: ISO of the noise of a measured camera, or (lowest, highest); ``rawaug info cameras`` lists the measured
                ranges. All of them by default.
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
            isp = of_camera(isp)
        elif not isinstance(isp, DictionaryISP):
            isp = DictionaryISP.from_pretrained(isp)
        own = isp if camera is None else restrict_to_cameras(isp, camera)

        if noise is None:
            noise = usual_noise(own)
            if iso is not None and noise != "camera" and camera is not None:
                several = [camera] if isinstance(camera, (str, Path, Camera)) else camera
                names = [str(name) for name in several]
                noise = names[0] if len(names) == 1 else names
        return cls(own, with_iso(noise, iso), draw=draw, target=target, burst=burst, cfa=cfa, seed=seed)

    @eager
    @torch.no_grad()
    def sample(self, srgb: Any, generator: torch.Generator | None = None, crop: Tensor | None = None) -> AugmentParams:
        """Draw the parameters of a batch; those of a single picture have no leading B.

        Args:
            srgb: pictures ``(B, 3, H, W)`` in any form that :mod:`rawaug.plugin.pictures` lists. Only the samplings
                ``perturb`` and ``chosen`` look at them, the others count them.
            generator: on the CPU; the module's own by default.
            crop: ``(B, 5)`` where the pictures are in their full frames, as :class:`AugmentParams` has it; by default
                they are full frames.
        """
        params = self._sample(self._batch(srgb), generator or self._own_generator(), crop)
        return params.map(lambda t: t[0]) if is_picture(srgb) else params

    def _sample(self, srgb: Tensor, generator: torch.Generator, crop: Tensor | None) -> AugmentParams:
        if crop is None:
            crop = torch.tensor([0, 0, *srgb.shape[-2:], 0]).repeat(len(srgb), 1)
        with _float32(srgb):
            setting = self.settings.sample(srgb, generator)
            noise, extras = self.noise.sample(len(srgb), generator), dict[str, Tensor]()
            for part in (self.srgb, self.burst):
                extras |= {} if part is None else part.sample(len(srgb), generator)
            return AugmentParams(setting, noise, crop, extras)

    @eager
    @torch.no_grad()
    def apply(self, srgb: Any, params: AugmentParams | None = None) -> Any:
        """Make the :class:`RawPair` that parameters describe, bit for bit the same at every call.

        Args:
            srgb: pictures ``(B, 3, H, W)`` in any form that :mod:`rawaug.plugin.pictures` lists. A function alone, as a
                surrounding module may pass it, goes to ``nn.Module.apply``.
            params: those of as many pictures; for a single picture they and the pair have no leading B.

        Raises:
            ValueError: if ``srgb`` is no batch of pictures, or ``params`` are for another number of them.
        """
        if params is None:
            return super().apply(srgb)
        if not isinstance(params, AugmentParams):
            raise ValueError(f"apply takes the params of a pair, pair.params, got {type(params).__name__}")
        if is_picture(srgb):
            return self._pair(self._batch(srgb), params.map(lambda t: t[None])).map(lambda t: t[0])
        return self._pair(self._batch(srgb), params)

    @eager
    @torch.no_grad()
    def make_pair(self, srgb: Tensor, generator: torch.Generator, crop: Tensor | None = None) -> RawPair:
        """Sample, then apply, without converting the pictures.

        Args:
            srgb: ``(B, 3, H, W)`` with even sides, uint8 or float32, on the module's device.
            generator: on the CPU.
            crop: ``(B, 5)``, as for :meth:`sample`.
        """
        self._require_here(srgb)
        return self._pair(srgb, self._sample(srgb, generator, crop))

    def _pair(self, srgb: Tensor, params: AugmentParams) -> RawPair:
        if len(params.crop) != len(srgb):
            raise ValueError(f"the parameters are for {len(params.crop)} pictures, but the batch has {len(srgb)}")
        with _float32(srgb):
            if self.burst is not None:
                return self._burst(srgb, params, self.burst)
            noisy, clean, variance = self._noisy(self._clean(srgb, params), params)
            if self.target == "rgb":
                clean = self.baked.colours(srgb, params.isp, params.crop, white=1.0)
            return RawPair(noisy, clean, variance, params)

    @eager
    @torch.no_grad()
    def develop(self, raw: Tensor, params: AugmentParams, demosaicing: str = "malvar") -> Tensor:
        """Develop RAW of a pair, noisy, clean or denoised, by the camera setting that made it, to look at.

        Args:
            raw: packed RAW ``(B, 4, h, w)``, or ``(4, h, w)`` of a sample of a Dataset; white = 1.
            params: of the pair: ``pair.params``.
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
            return self.develop(raw[None], params.map(lambda t: t[None]), demosaicing)[0]
        if self.pattern is not None or raw.ndim != 4 or raw.shape[1] != 4 or min(raw.shape[-2:]) < 2:
            raise ValueError(
                f"develop takes packed RAW of a Bayer pattern, (B, 4, h, w) or (4, h, w) from 2 x 2 on, "
                f"got {tuple(raw.shape)} of {self.cfa}"
            )
        if len(params.crop) != len(raw):
            raise ValueError(f"the parameters are for {len(params.crop)} pictures, but the batch has {len(raw)}")
        bayer.require_method(demosaicing)
        mosaic, methods = bayer.unpack(raw.float(), self.isp.cfa), [demosaicing] * len(raw)
        with _float32(raw):
            return self._forward_pass().develop([mosaic], methods, keep_white(params.isp), params.crop)[0]

    def _forward_pass(self) -> FastForward:
        if self.display is None:  # tables that only developing needs
            self.display = freeze(FastForward(self.isp))
        return self.display

    def __repr__(self) -> str:
        """Tell in three lines what is drawn: the camera, the noise and the target."""
        frames = "" if self.burst is None else f", bursts of {self.burst.frames} frames"
        target = self.target if self.srgb in (None, Srgb()) else self.srgb
        return (
            f"RawAugment, camera: {self.settings!r}\n  noise: {self.noise_name}\n  target: {target}, {self.cfa}{frames}"
        )

    def _clean(self, srgb: Tensor, params: AugmentParams) -> Tensor:
        if self.pattern is None:
            return self.baked(srgb, params.isp, params.crop, white=1.0)
        return self._planes(self.baked.colours(srgb, params.isp, params.crop, white=1.0))

    def _planes(self, rgb: Tensor) -> Tensor:
        """Sample RGB ``(B, 3, H, W)`` as four planes: packed RAW, or of other patterns the sites of 2 x 2 squares."""
        if self.pattern is None:
            return bayer.pack_rgb(rgb, self.isp.cfa)
        return bayer.pack(self.pattern.mosaic(rgb), CFA.RGGB)

    def _noisy(self, planes: Tensor, params: AugmentParams) -> tuple[Tensor, Tensor, Tensor]:
        """Add noise to clean planes ``(B, 4, H/2, W/2)``; noisy, clean and variance, as RAW or developed."""
        if self.srgb is not None:
            raw = self.noise.apply(planes, params.noise)
            _require_finite(raw)
            noisy, clean = (bayer.unpack(x, self.isp.cfa) for x in (raw, planes))
            noisy, clean = self.srgb.develop(self._forward_pass(), noisy, clean, params)
            return noisy, clean, noisy.new_empty(len(noisy), 0)
        noisy, variance = self.noise.apply_with_variance(planes, params.noise)
        _require_finite(noisy)
        if self.pattern is None:
            return noisy, planes, variance
        noisy, planes, variance = (bayer.unpack(x, CFA.RGGB) for x in (noisy, planes, variance))
        return noisy, planes, variance

    def _burst(self, srgb: Tensor, params: AugmentParams, burst: Burst) -> RawPair:
        scene = self.baked.colours(srgb, params.isp, params.crop, shaded=False)
        repeated = params.map(lambda t: t.repeat_interleave(burst.frames, 0))
        if "seed" in repeated.noise:
            seeds = {"sensor_seed": repeated.noise["seed"], "seed": params.extras["frame_seed"].flatten()}
            repeated.noise.update(seeds)
        moving = burst.move(scene, params.extras["motion"])
        frames = burst.expose(self.baked.shade(moving, repeated.isp, repeated.crop))
        noisy, clean, variance = (
            x.unflatten(0, (len(srgb), burst.frames)) for x in self._noisy(self._planes(frames), repeated)
        )
        if self.target == "rgb":
            clean = frames.unflatten(0, (len(srgb), burst.frames))
        return RawPair(noisy, clean[:, 0], variance, params)

    @overload
    def forward(self, batch: Tensor, generator: torch.Generator | None = None, key: None = None) -> RawPair: ...
    @overload
    def forward(self, batch: Any, generator: torch.Generator | None = None, key: str | int | None = None) -> Any: ...
    @eager
    @torch.no_grad()
    def forward(self, batch: Any, generator: torch.Generator | None = None, key: str | int | None = None) -> Any:
        """Draw parameters for a batch and apply them.

        Args:
            batch: pictures ``(B, 3, H, W)`` in any form that :mod:`rawaug.plugin.pictures` lists, or a tuple or mapping
                that has them. A single picture makes a single pair, without the leading B.
            generator: of all that is drawn, on the CPU; the module's own by default.
            key: name or index of the pictures in a mapping or tuple.

        Returns:
            A :class:`RawPair`; of a tuple or mapping, this with the pair in place of the pictures.

        Raises:
            ValueError: if there is no picture.
        """
        where = find_picture(batch, key, batched=True)
        pictures = get_picture(batch, where)
        srgb = self._batch(pictures)
        pair = self.make_pair(srgb, generator or self._own_generator())
        return replace_picture(batch, where, pair.map(lambda t: t[0]) if is_picture(pictures) else pair)

    if TYPE_CHECKING:  # nn.Module's own call is of any kind

        @overload
        def __call__(self, batch: Tensor, generator: torch.Generator | None = None, key: None = None) -> RawPair: ...
        @overload
        def __call__(
            self, batch: Any, generator: torch.Generator | None = None, key: str | int | None = None
        ) -> Any: ...
        def __call__(
            self, batch: Any, generator: torch.Generator | None = None, key: str | int | None = None
        ) -> Any: ...

    def _apply(self, fn: Callable[[Tensor], Tensor], recurse: bool = True) -> RawAugment:
        """Move with the surrounding network, but stay float32."""

        def move(tensor: Tensor) -> Tensor:
            probe = fn(tensor.new_empty(0))
            return fn(tensor) if probe.dtype == tensor.dtype else tensor.to(probe.device)

        return super()._apply(move, recurse)

    @property
    def cfa(self) -> str:
        """The pattern of the RAW, such as ``"RGGB"`` or ``"XTRANS"``."""
        return str(self.isp.cfa) if self.pattern is None else self.pattern.name

    def mosaic(self, raw: Tensor) -> Tensor:
        """Unpack RAW of a pair ``(..., 4, H/2, W/2)`` to a mosaic ``(..., 1, H, W)``; RAW of other patterns is one."""
        return bayer.unpack(raw, self.isp.cfa) if self.pattern is None else raw

    @property
    def device(self) -> torch.device:
        """The device that pairs are made on."""
        return self.isp.gain.log_gains.device

    @torch.no_grad()
    def measure_signals(self, pictures: Iterable[Any], draws: int = 4, seed: int = 0) -> list[float]:
        """Measure the mean signal of the clean RAW that pictures become, for noise of a stated PSNR of their pairs.

        Args:
            pictures: some of those that are trained on, in any form that :mod:`rawaug.plugin.pictures` lists.
            draws: camera settings that are drawn for each.
            seed: of these draws.

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
            clean = self._clean(batch, self._sample(batch, generator, None))
            signals += clean.mean((1, 2, 3)).clamp(1e-6, 1.0).tolist()
        return signals

    # -- pictures as a Dataset or a loader hands them over ------------------------------------------------------------

    def open_folder(self, path: str | Path, size: tuple[int, int] | None) -> Any:
        """The pictures of a folder, or of ``kind:path``, less those that are smaller than a crop of ``size``."""
        from rawaug.data import open_pictures

        return open_pictures(str(path), min_side=2 if size is None else min(size))

    def as_batch(self, pictures: Any, bgr: bool = False) -> Tensor:
        """Pictures of one size as ``(B, 3, H, W)`` with even sides."""
        return trim_to_even(to_rgb_batch(pictures, bgr))

    def stack(self, patches: Sequence[Tensor]) -> Tensor:
        """Stack patches of one size to ``(B, 3, H, W)``."""
        return stack_pictures(patches)

    def draw_patch(
        self,
        picture: Any,
        size: tuple[int, int] | None,
        turns: bool,
        generator: torch.Generator,
        zoom: float = 1.0,
        bgr: bool = False,
    ) -> tuple[Tensor, Tensor]:
        """Draw a crop of a picture, and cut it out; see :func:`rawaug.plugin.crops.draw_patch`."""
        return draw_patch(picture, size, turns, generator, zoom, bgr)

    def cut_patch(self, picture: Any, place: Tensor, size: tuple[int, int] | None, bgr: bool = False) -> Tensor:
        """Cut the patch of a drawn place out of a picture; see :func:`rawaug.plugin.crops.cut_patch`."""
        return cut_patch(trim_to_even(to_rgb_tensor(picture, bgr)), place, size)

    def _batch(self, pictures: Any) -> Tensor:
        """``(B, 3, H, W)`` with even sides; other input is moved to the module's device."""
        srgb = trim_to_even(to_rgb_batch(pictures))
        if not isinstance(pictures, Tensor):
            return srgb.to(self.device)
        self._require_here(srgb)
        return srgb

    def _require_here(self, srgb: Tensor) -> None:
        if srgb.device != self.device:
            raise ValueError(f"pictures on {srgb.device}, but augmentation on {self.device}; call augment.to(...)")

    def _own_generator(self) -> torch.Generator:
        """A new generator for each call, worker and process."""
        self._calls += 1
        worker = get_worker_info()
        rank = rank_key() or self._rank
        return keyed_generator(self.seed, "augment", worker.seed if worker else 0, self._calls, *rank)

    def __getstate__(self) -> dict[str, Any]:
        return {**self.__dict__, "_rank": rank_key() or self._rank}  # a spawned worker has no process group


M = TypeVar("M", bound=nn.Module)


def freeze(module: M) -> M:
    """Copy a module in eval mode, with its tensors as buffers that no ``state_dict`` holds."""
    copy = deepcopy(module).eval()
    for part in copy.modules():
        tensors = {**part._parameters, **part._buffers}
        for name, tensor in tensors.items():
            if tensor is not None:
                delattr(part, name)
                part.register_buffer(name, tensor.detach(), persistent=False)
    return copy


def of_camera(camera: Camera | str | Path) -> DictionaryISP:
    """The ISP ``universal`` with a camera of one's own in place of the published ones."""
    return restrict_to_cameras(DictionaryISP.from_pretrained("universal"), camera)


def usual_noise(isp: DictionaryISP) -> str:
    """The noise where none is given: that of the cameras of one's own, if each states one."""
    cameras = own_cameras(isp.info)
    stated = bool(cameras) and all(camera.levels for camera in cameras)
    return "camera" if stated else "cycleisp_sidd"


def _require_finite(raw: Tensor) -> None:
    """Refuse what damaged weights make; on the CPU only, elsewhere it would stall the device."""
    if raw.device.type == "cpu" and not math.isfinite(raw.numpy().min()):  # NumPy: PyTorch's threads die in a fork
        raise ValueError("the RAW has values that are not finite: the ISP's weights are damaged; fit or copy it again")


def _float32(like: Tensor) -> torch.autocast:
    """RAW is float32, inside mixed precision too."""
    return torch.autocast(like.device.type, enabled=False)


def _noise_name(noise: NoiseSpec | NoiseLevels | NoiseModel) -> str:
    if isinstance(noise, str) or (isinstance(noise, Mapping) and "name" in noise):
        return spec_label(noise)
    if isinstance(noise, MeasuredLevels):
        return noise.camera
    return type(noise).__name__ if isinstance(noise, NoiseModel) or is_law(noise) else str(noise)


def with_iso(noise: NoiseSpec | NoiseLevels | NoiseModel, iso: Iso) -> NoiseSpec | NoiseLevels | NoiseModel:
    """The noise of a measured camera at an ISO, or between two; ValueError if it does not depend on the ISO."""
    if iso is None:
        return noise
    if isinstance(noise, str):
        return {"name": noise, "settings": {"iso": iso}}
    return noise_model(noise, iso=iso)


def noise_for(isp: DictionaryISP, noise: NoiseSpec | NoiseLevels | NoiseModel) -> NoiseModel:
    """The noise model that ``noise`` means for this ISP.

    ``"camera"`` is the law in the ISP's file, at any ISO that was measured; ``{name: camera, settings: {iso: ...}}`` is
    that law at an ISO. ValueError if there is none.
    """
    if isinstance(noise, str) or (isinstance(noise, Mapping) and "name" in noise):
        name, settings = split_spec(noise)
        if name == "camera":
            return measured_noise(_laws_of(isp), **check_settings("noise camera", _iso_of, settings))
    return noise_model(noise)


def _iso_of(iso: Iso = None) -> Iso:
    """The settings of the noise ``camera``."""
    return iso


def _laws_of(isp: DictionaryISP) -> list[Mapping[str, Any]]:
    """The noise laws in an ISP's file, one for each of its cameras; ValueError if one is missing."""
    if "noise" in isp.info:
        return [isp.info["noise"]]
    laws: list[Mapping[str, Any]] = []
    for camera in own_cameras(isp.info):
        law = camera.noise_spec()
        if law is None:
            raise ValueError(f'noise "camera": camera {camera.name!r} states no noise; give noise= by name')
        laws.append(law)
    if not laws:
        raise ValueError('noise "camera": this ISP was fitted without measuring noise; fit it again or use a preset')
    return laws


class ISPModel:
    """Camera noise as a degradation of the pictures of KAIR and BSRGAN, which call it ``isp_model``.

    Args:
        augment: with the target ``"srgb"``; each call draws anew, from its own seed.

    Raises:
        ValueError: if its target is another.

    Example:
        >>> model = ISPModel(RawAugment.from_pretrained("universal", target="srgb"))
        >>> lq, hq = model.forward(np.full((31, 40, 3), 0.5), np.full((124, 160, 3), 0.5))
        >>> lq.shape, lq.dtype
        ((31, 40, 3), dtype('float32'))
    """

    def __init__(self, augment: RawAugment) -> None:
        if augment.target != "srgb":
            raise ValueError(f"ISPModel needs an augmentation with target 'srgb', got {augment.target!r}")
        self.augment = augment

    def forward(self, img: np.ndarray, hq: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Add a camera's noise to a picture ``(H, W, 3)``, sRGB in [0, 1].

        Returns:
            The noisy picture ``(H, W, 3)``, float32 in [0, 1], and ``hq`` as it is.
        """
        height, width = img.shape[:2]
        even = np.pad(img, ((0, height % 2), (0, width % 2), (0, 0)), mode="edge")
        srgb = torch.from_numpy(np.ascontiguousarray(even, np.float32)).permute(2, 0, 1).clamp(0.0, 1.0)
        srgb = srgb.to(self.augment.device)
        params = self.augment.sample(srgb)
        params = params._replace(isp=keep_white(params.isp))  # or an overexposed picture would be brighter than hq
        noisy: Tensor = self.augment.apply(srgb, params).noisy
        return noisy[:, :height, :width].permute(1, 2, 0).cpu().numpy(), hq

    __call__ = forward
