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
from collections.abc import Callable, Mapping, Sequence
from copy import copy, deepcopy
from pathlib import Path
from typing import Any, Literal, TypeVar, get_args, overload

import torch
from torch import Tensor, nn
from torch.utils.data import get_worker_info

from rawaug import bayer
from rawaug.bayer import CFA, pattern
from rawaug.isp.config import ISPParams
from rawaug.isp.dictionary import EXPOSURE, perturb
from rawaug.isp.fast import BakedISP, FastForward
from rawaug.isp.model import DictionaryISP, restrict_to_cameras
from rawaug.kernels.runtime import eager
from rawaug.noise import Iso, NoiseModel, NoiseSpec, ShotReadNoise, camera_law, noise_model
from rawaug.plugin.finishing import Finish
from rawaug.plugin.params import AugmentParams, RawPair
from rawaug.plugin.pictures import even_sided, find_picture, is_picture, picked, replaced, to_rgb_batch
from rawaug.plugin.targets import Burst, Target, Targets, reaching_white, through_jpeg
from rawaug.registry import suggest
from rawaug.seeding import keyed_generator, rank_key

Sampling = Literal["convex", "independent", "perturb", "chosen"]


class RawAugment(nn.Module):
    """sRGB batches to RAW pairs.

    It has no parameters and adds nothing to the ``state_dict`` of a surrounding network.

    Args:
        isp: the fitted camera; a frozen copy is taken, later changes do not reach it.
        noise: name of a preset or a measured camera, (shot_var, read_var), a :class:`rawaug.noise.NoiseModel`, or
            ``"camera"`` for the levels that were measured when the ISP was fitted.
        sampling: ``"convex"`` draws without looking at the picture: of an ISP of published cameras, such as
            ``universal``, a camera in a light, with the gains that follow, and a mixture of tone curves; of a fitted
            camera uniform convex combinations of the atoms. ``"independent"`` is the same with the gains of another
            camera in another light, to see what consistency is worth. ``"perturb"`` adds Gaussian noise to the weights
            that the ISP chooses; ``"chosen"`` takes these as they are.
        strength: of ``"perturb"``: standard deviation on the weights.
        seed: of the module's own draws, where no generator is passed. They are counted from its construction: to
            resume, pass a generator, or use RawPairs or wrap.
        exposure: lowest and highest exposure, in stops, that the RAW is drawn at, uniformly. ``(0, 0)``, the
            default of a fitted camera, is that of its frames. Published cameras have ``(-0.5, 1)``, for their headroom
            above their pictures' white is not known. To train for other cameras than the fitted one, use (-1.5, 0).
        cfa: pattern of the RAW, by default the ISP's: another Bayer pattern, ``"XTRANS"``, or ``"QUAD-RGGB"`` and the
            like. RAW of these last is a mosaic ``(B, 1, H, W)`` in place of packed RAW; see :mod:`rawaug.bayer`.
        light: of an ISP of published cameras, the light that cameras are drawn in: a colour temperature in kelvin, or
            one of :data:`rawaug.isp.cameras.LAMPS` by name. Any light by default.
        target: what the pair holds. ``"raw"``: noisy and clean RAW. ``"rgb"``: noisy RAW, and clean linear camera RGB
            ``(B, 3, H, W)`` of the full size, for demosaicing. ``"srgb"``: both as sRGB ``(B, 3, H, W)`` in [0, 1],
            developed by the setting that made the RAW, and no variance map; see :mod:`rawaug.plugin.targets`.
        demosaicing: of ``"srgb"``: a name of :data:`rawaug.bayer.METHODS`, or several to draw from (all).
        jpeg: of ``"srgb"``: lowest and highest quality of the JPEG that the noisy picture goes through (no JPEG).
        burst: number N of noisy frames of the scene that a pair holds, ``(B, N, ...)``; clean is that of the first. By
            default a single one, without the N.
        motion: of a burst: largest shift in pixels and rotation in degrees, (2, 0.5) by default; see
            :mod:`rawaug.plugin.targets`.
        stops: of a burst: exposure of each frame in stops, for brackets; all alike by default.
        finish: of ``"srgb"``: finish both pictures as cameras do, by a :class:`rawaug.plugin.finishing.Finish` or, with
            True, its defaults: noise reduction, sharpening, and JPEG on the noisy one.
        tone: one of the ISP's tone curves by name (``isp.info["tones"]``), in place of mixtures of them.

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
        isp: DictionaryISP,
        noise: str | Sequence[float] | Sequence[str] | NoiseModel = "cycleisp_sidd",
        sampling: Sampling = "convex",
        strength: float = 0.1,
        seed: int = 0,
        exposure: tuple[float, float] | None = None,
        cfa: str | None = None,
        light: float | str | None = None,
        tone: str | None = None,
        target: Target = "raw",
        demosaicing: str | Sequence[str] | None = None,
        jpeg: tuple[int, int] | None = None,
        burst: int | None = None,
        motion: tuple[float, float] | None = None,
        stops: Sequence[float] | None = None,
        finish: Finish | bool = False,
    ) -> None:
        super().__init__()
        self.pattern = None if cfa is None else pattern(cfa)
        if self.pattern is not None and self.pattern.name in CFA.__members__:
            isp, self.pattern = deepcopy(isp), None
            isp.configure(cfa=str(cfa))
        self.isp = frozen(isp)
        self.baked = frozen(BakedISP(isp))
        self.targets = Targets(target, demosaicing, jpeg, self.cfa, finish)
        self.forward_pass = frozen(FastForward(isp)) if target == "srgb" else None
        self.display: FastForward | None = self.forward_pass
        if burst is None and (motion, stops) != (None, None):
            raise ValueError("motion and stops are those of a burst; give burst, or omit them")
        self.burst = None if burst is None else Burst(burst, motion, stops)
        self._draw(noise, sampling, strength, seed, exposure, light, tone)

    def _draw(
        self,
        noise: NoiseSpec | NoiseModel,
        sampling: Sampling,
        strength: float = 0.1,
        seed: int = 0,
        exposure: tuple[float, float] | None = None,
        light: float | str | None = None,
        tone: str | None = None,
    ) -> None:
        if sampling not in get_args(Sampling):
            raise ValueError(f"sampling {sampling!r} is unknown; use one of {', '.join(get_args(Sampling))}")
        if not strength >= 0:
            raise ValueError(f"strength must be at least 0, got {strength}")
        cameras = bool(self.isp.config.cameras)
        if exposure is None:
            exposure = EXPOSURE if cameras else (0.0, 0.0)
        if len(exposure) != 2 or not exposure[0] <= exposure[1]:
            raise ValueError(f"exposure must be (lowest, highest) in stops, got {exposure}")
        if (light, tone) != (None, None) and not (cameras and sampling in ("convex", "independent")):
            whose = f"with sampling {sampling!r}" if cameras else "of a fitted ISP"
            raise ValueError(f"light and tone are drawn for published cameras, as in universal, not {whose}; omit them")
        self.noise = noise_for(self.isp, noise)
        self.noise_name = _noise_name(noise)
        if self.pattern is not None and self.noise.by_plane:
            raise ValueError(f"this noise is one of planes R, Gr, Gb, B, which {self.pattern.name} does not have")
        self.sampling, self.strength, self.seed, self.exposure = sampling, strength, seed, exposure
        self.cameras = self.isp.camera_sampler(sampling == "convex", light)
        self.light = light
        self.tone = None if tone is None else tone_weights(self.isp, tone)
        self._calls = 0

    def redrawn(self, noise: NoiseSpec | NoiseModel, sampling: Sampling = "convex", **draws: Any) -> RawAugment:
        """The same ISP and pattern with other draws; nothing is baked again.

        Arguments and errors are those of the constructor.
        """
        other = copy(self)
        other._draw(noise, sampling, **draws)
        return other

    @classmethod
    def from_pretrained(
        cls,
        isp: str | Path | DictionaryISP,
        camera: str | Sequence[str] | None = None,
        *,
        iso: Iso = None,
        **settings: Any,
    ) -> RawAugment:
        """From the name of a shipped ISP, a path, or an ISP.

        Args:
            isp: the name, path or ISP.
            camera: maker and model of a published camera, or several, in place of the ISP's colour atoms; for an ISP of
                published cameras, such as ``universal``.
            iso: of the noise, which is that of ``camera`` unless ``noise`` names another: one ISO or limits;
                ``rawaug info cameras`` lists the measured ranges.
            settings: as in the constructor.

        Raises:
            FileNotFoundError: if there is no such ISP.
            ValueError: if a camera is not listed, the ISP was fitted to frames, or no noise was measured at this ISO.

        Example:
            >>> augment = RawAugment.from_pretrained("universal", camera="Nikon D750")
            >>> augment.isp.info["cameras"]
            ['Nikon D750']
            >>> RawAugment.from_pretrained("universal", camera="Nikon D750", iso=800)
            RawAugment, camera: Nikon D750, convex, exposure -0.5 to 1 stops
              noise: Nikon D750, iso 800
              target: raw, RGGB
        """
        if iso is not None:
            named = settings.get("noise", camera)
            if not isinstance(named, str):
                raise ValueError("iso is that of one camera's noise: give its name as camera= or noise=")
            settings["noise"] = {"name": named, "settings": {"iso": iso}}
        loaded = isp if isinstance(isp, DictionaryISP) else DictionaryISP.from_pretrained(isp)
        return cls(loaded if camera is None else restrict_to_cameras(loaded, camera), **settings)

    @eager
    @torch.no_grad()
    def sample(self, srgb: Any, generator: torch.Generator | None = None, place: Tensor | None = None) -> AugmentParams:
        """Draw parameters for a batch; for a single picture without the leading B.

        Args:
            srgb: the pictures; only ``perturb`` and ``chosen`` look at them, ``convex`` counts them.
            generator: on the CPU; the module's own by default.
            place: ``(B, 5)`` top, left, height, width of the full frames, view; untouched full frames by default.
        """
        params = self._sample(self._batch(srgb), generator or self._own_generator(), place)
        return params.map(lambda t: t[0]) if is_picture(srgb) else params

    def _sample(self, srgb: Tensor, generator: torch.Generator, place: Tensor | None) -> AugmentParams:
        if place is None:
            place = torch.tensor([0, 0, *srgb.shape[-2:], 0]).repeat(len(srgb), 1)
        with _float32(srgb):
            setting = self._expose(self._sample_isp(srgb, generator), generator)
            noise = self.noise.sample(len(srgb), generator)
            extras = self.targets.sample(len(srgb), generator)
            if self.burst is not None:
                extras |= self.burst.sample(len(srgb), generator)
            return AugmentParams(setting, noise, place, extras)

    def _sample_isp(self, srgb: Tensor, generator: torch.Generator) -> ISPParams:
        if self.sampling in ("convex", "independent"):
            if self.cameras is None:
                return self.isp.draw_setting(len(srgb), generator)
            setting = self.cameras.sample(len(srgb), generator, self.device)
            if self.tone is None:
                return setting
            return setting._replace(tone_weights=self.tone.to(setting.tone_weights).expand_as(setting.tone_weights))
        chosen = self.baked.choose(srgb)
        if self.sampling == "chosen":
            return chosen
        weights = [w for w in (chosen.colour_weights, chosen.gain_weights, chosen.tone_weights) if w.shape[1]]
        return self.isp.params_from_weights(*(perturb(w, self.strength, generator) for w in weights))

    def _expose(self, setting: ISPParams, generator: torch.Generator) -> ISPParams:
        """An exposure of e stops divides the gains of the forward direction by 2^e."""
        if not any(self.exposure):
            return setting
        low, high = self.exposure
        stops = low + (high - low) * torch.rand(len(setting.gains), 1, generator=generator, dtype=torch.float32)
        return setting._replace(gains=setting.gains * torch.exp2(-stops).to(setting.gains))

    @eager
    @torch.no_grad()
    def apply(self, srgb: Any, params: AugmentParams | None = None) -> Any:
        """The :class:`RawPair` that ``params`` describe: pure, bit for bit the same at every call.

        For a single picture ``params`` and the pair have no leading B. With a function alone it is ``nn.Module.apply``,
        which a surrounding module may call.

        Raises:
            ValueError: if ``srgb`` is no batch of pictures, or ``params`` are for another number of them.
        """
        if params is None:
            return super().apply(srgb)
        if is_picture(srgb):
            return self._pair(self._batch(srgb), params.map(lambda t: t[None])).map(lambda t: t[0])
        return self._pair(self._batch(srgb), params)

    @eager
    @torch.no_grad()
    def make(self, srgb: Tensor, generator: torch.Generator, place: Tensor | None = None) -> RawPair:
        """Sample, then apply, of ``(B, 3, H, W)`` that :mod:`rawaug.plugin.pictures` has converted already."""
        self._require_here(srgb)
        return self._pair(srgb, self._sample(srgb, generator, place))

    def _pair(self, srgb: Tensor, params: AugmentParams) -> RawPair:
        if len(params.place) != len(srgb):
            raise ValueError(f"the parameters are for {len(params.place)} pictures, but the batch has {len(srgb)}")
        with _float32(srgb):
            if self.burst is not None:
                return self._burst(srgb, params, self.burst)
            noisy, clean, variance = self._noisy(self._clean(srgb, params), params)
            if self.targets.target == "rgb":
                clean = self.baked.colours(srgb, params.isp, params.place, white=1.0)
            return RawPair(noisy, clean, variance, params)

    @eager
    @torch.no_grad()
    def develop(self, raw: Tensor, params: AugmentParams, demosaicing: str = "malvar") -> Tensor:
        """RAW of a pair, noisy, clean or denoised, back to sRGB by the camera setting that made it, to look at.

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
        if raw.ndim == 3:
            return self.develop(raw[None], params.map(lambda t: t[None]), demosaicing)[0]
        if self.pattern is not None or raw.ndim != 4 or raw.shape[1] != 4 or min(raw.shape[-2:]) < 2:
            raise ValueError(
                f"develop takes packed RAW of a Bayer pattern, (B, 4, h, w) or (4, h, w) from 2 x 2 on, "
                f"got {tuple(raw.shape)} of {self.cfa}"
            )
        if len(params.place) != len(raw):
            raise ValueError(f"the parameters are for {len(params.place)} pictures, but the batch has {len(raw)}")
        bayer.require_method(demosaicing)
        if self.display is None:  # tables that only this needs
            self.display = frozen(FastForward(self.isp))
        mosaic, methods = bayer.unpack(raw.float(), self.isp.cfa), [demosaicing] * len(raw)
        with _float32(raw):
            return self.display.develop([mosaic], methods, reaching_white(params.isp), params.place)[0]

    def __repr__(self) -> str:
        """What is drawn, in three lines: the camera, the noise, the target."""
        names = self.isp.info.get("cameras", [])
        camera = names[0] if len(names) == 1 else f"one of {len(names)} published" if names else "the fitted one"
        light = "" if self.light is None else f", light {self.light}"
        exposure = f"exposure {self.exposure[0]:g} to {self.exposure[1]:g} stops"
        frames = "" if self.burst is None else f", bursts of {self.burst.frames} frames"
        return (
            f"RawAugment, camera: {camera}, {self.sampling}{light}, {exposure}\n"
            f"  noise: {self.noise_name}\n"
            f"  target: {self.targets.target}, {self.cfa}{frames}"
        )

    def _clean(self, srgb: Tensor, params: AugmentParams) -> Tensor:
        if self.pattern is None:
            return self.baked(srgb, params.isp, params.place, white=1.0)
        return self._planes(self.baked.colours(srgb, params.isp, params.place, white=1.0))

    def _planes(self, rgb: Tensor) -> Tensor:
        """RAW as four planes: packed, or, of other patterns, the sites of every 2 x 2 square as they come."""
        if self.pattern is None:
            return bayer.pack_rgb(rgb, self.isp.cfa)
        return bayer.pack(self.pattern.mosaic(rgb), CFA.RGGB)

    def _noisy(self, planes: Tensor, params: AugmentParams) -> tuple[Tensor, Tensor, Tensor]:
        """Noisy, clean and variance of clean planes, as RAW or developed."""
        if self.forward_pass is not None:
            return self._developed(self.forward_pass, planes, params)
        noisy, variance = self.noise.apply_with_variance(planes, params.noise)
        _require_finite(noisy)
        if self.pattern is None:
            return noisy, planes, variance
        noisy, planes, variance = (bayer.unpack(x, CFA.RGGB) for x in (noisy, planes, variance))
        return noisy, planes, variance

    def _developed(self, forward: FastForward, planes: Tensor, params: AugmentParams) -> tuple[Tensor, Tensor, Tensor]:
        raw = self.noise.apply(planes, params.noise)
        _require_finite(raw)
        mosaics = [bayer.unpack(x, self.isp.cfa) for x in (raw, planes)]
        noisy, clean = self.targets.develop(forward, mosaics, params)
        if self.targets.finish is not None:
            noisy, clean = self.targets.finish.apply(noisy, clean, params.extras["finish"])
        if "quality" in params.extras:
            noisy = through_jpeg(noisy, params.extras["quality"], params.extras.get("chroma_420"))
        return noisy, clean, noisy.new_empty(len(noisy), 0)

    def _burst(self, srgb: Tensor, params: AugmentParams, burst: Burst) -> RawPair:
        scene = self.baked.colours(srgb, params.isp, params.place, shaded=False)
        repeated = params.map(lambda t: t.repeat_interleave(burst.frames, 0))
        if "seed" in repeated.noise:
            seeds = {"sensor_seed": repeated.noise["seed"], "seed": params.extras["frame_seed"].flatten()}
            repeated.noise.update(seeds)
        moved = burst.frames_of(scene, params.extras["motion"])
        frames = burst.exposed(self.baked.shade(moved, repeated.isp, repeated.place))
        noisy, clean, variance = (
            x.unflatten(0, (len(srgb), burst.frames)) for x in self._noisy(self._planes(frames), repeated)
        )
        if self.targets.target == "rgb":
            clean = frames.unflatten(0, (len(srgb), burst.frames))
        return RawPair(noisy, clean[:, 0], variance, params)

    @overload
    def forward(self, batch: Tensor, generator: torch.Generator | None = None, key: None = None) -> RawPair: ...
    @overload
    def forward(self, batch: Any, generator: torch.Generator | None = None, key: str | int | None = None) -> Any: ...
    @eager
    @torch.no_grad()
    def forward(self, batch: Any, generator: torch.Generator | None = None, key: str | int | None = None) -> Any:
        """Sample, then apply.

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
        pictures = picked(batch, where)
        srgb = self._batch(pictures)
        pair = self.make(srgb, generator or self._own_generator())
        return replaced(batch, where, pair.map(lambda t: t[0]) if is_picture(pictures) else pair)

    def _apply(self, fn: Callable[[Tensor], Tensor], recurse: bool = True) -> RawAugment:
        """Move with the surrounding network, but stay float32."""

        def moved(tensor: Tensor) -> Tensor:
            probe = fn(tensor.new_empty(0))
            return fn(tensor) if probe.dtype == tensor.dtype else tensor.to(probe.device)

        return super()._apply(moved, recurse)

    @property
    def cfa(self) -> str:
        return str(self.isp.cfa) if self.pattern is None else self.pattern.name

    def mosaic(self, raw: Tensor) -> Tensor:
        """RAW of a pair as the mosaic ``(..., 1, H, W)``: packed Bayer RAW unpacked, other patterns as they are."""
        return bayer.unpack(raw, self.isp.cfa) if self.pattern is None else raw

    @property
    def device(self) -> torch.device:
        return self.isp.gain.log_gains.device

    def _batch(self, pictures: Any) -> Tensor:
        """``(B, 3, H, W)`` with even sides; other input is moved to the module's device."""
        srgb = even_sided(to_rgb_batch(pictures))
        if not isinstance(pictures, Tensor):
            return srgb.to(self.device)
        self._require_here(srgb)
        return srgb

    def _require_here(self, srgb: Tensor) -> None:
        if srgb.device != self.device:
            raise ValueError(f"pictures on {srgb.device}, but augmentation on {self.device}; call augment.to(...)")

    def _own_generator(self) -> torch.Generator:
        """A new one for each call, worker and process."""
        self._calls += 1
        worker = get_worker_info()
        return keyed_generator(self.seed, "augment", worker.seed if worker else 0, self._calls, *rank_key())


M = TypeVar("M", bound=nn.Module)


def frozen(module: M) -> M:
    """A copy in eval mode whose tensors are buffers outside of ``state_dict``."""
    copy = deepcopy(module).eval()
    for part in copy.modules():
        tensors = {**part._parameters, **part._buffers}
        for name, tensor in tensors.items():
            if tensor is not None:
                delattr(part, name)
                part.register_buffer(name, tensor.detach(), persistent=False)
    return copy


def tone_weights(isp: DictionaryISP, name: str) -> Tensor:
    """Weights ``(K,)`` of one of the ISP's tone curves."""
    names = list(isp.info.get("tones", []))
    if isp.tone is None or name not in names:
        listed = ", ".join(names) or "none by name: its tone is learned"
        raise ValueError(f"tone {name!r} is no curve of this ISP, which has {listed}{suggest(name, names)}")
    return torch.eye(len(names))[names.index(name)]


def _require_finite(raw: Tensor) -> None:
    """Refuse what damaged weights make; on the CPU only, elsewhere it would stall the device."""
    if raw.device.type == "cpu" and not math.isfinite(raw.numpy().min()):  # NumPy: PyTorch's threads die in a fork
        raise ValueError("the RAW has values that are not finite: the ISP's weights are damaged; fit or copy it again")


def _float32(like: Tensor) -> torch.autocast:
    """RAW is float32, inside mixed precision too."""
    return torch.autocast(like.device.type, enabled=False)


def _noise_name(noise: NoiseSpec | NoiseModel) -> str:
    if isinstance(noise, Mapping):
        own = {key: value for key, value in noise.items() if key != "name"}
        said = [f"{key} {value}" for key, value in own.pop("settings", own).items()]
        return ", ".join([str(noise.get("name", "calibrated")), *said])
    if isinstance(noise, NoiseModel):
        return type(noise).__name__
    return noise if isinstance(noise, str) else str(tuple(noise))


def noise_for(isp: DictionaryISP, noise: NoiseSpec | NoiseModel) -> NoiseModel:
    """The noise model that ``noise`` means for this ISP: ``"camera"`` is the law in its file, at any measured ISO."""
    if noise != "camera":
        return noise_model(noise)
    if "noise" not in isp.info:
        raise ValueError('noise "camera": this ISP was fitted without measuring noise; fit it again or use a preset')
    return ShotReadNoise(camera_law(isp.info["noise"]))
