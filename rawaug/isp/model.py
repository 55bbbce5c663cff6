r"""The dictionary ISP: sRGB to RAW and back, in six stages whose parameters come from two dictionaries.

``y = f6^-1 . f5^-1 . f4^-1 . f3^-1 . f2^-1 . f1^-1 (x)`` and ``x = f1 . f2 . f3 . f4 . f5 . f6 (y)``

Source: Conde et al., "Model-Based Image Signal Processors via Learnable Dictionaries", AAAI 2022. The stages are in
:mod:`rawaug.isp.stages`, the dictionaries in :mod:`rawaug.isp.dictionary`, the mosaic in :mod:`rawaug.bayer`.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from rawaug import bayer
from rawaug.bayer import CFA
from rawaug.camera.lights import D65, compute_mired, light_range, weights_in_light, white_point
from rawaug.camera.matrices import gains_in_light, load_cameras
from rawaug.camera.names import find_camera
from rawaug.camera.own import Camera, as_camera, is_camera_file, own_cameras
from rawaug.errors import count_of
from rawaug.files import find_weights, parse_object, read_tensors, to_json, write_tensors
from rawaug.isp import functional, staged, stages
from rawaug.isp.config import ISPConfig, ISPParams, ISPResult
from rawaug.isp.dictionary import CameraDictionary, CameraSampler, convex_weights, log_light
from rawaug.isp.own_sampler import OwnCameraSampler
from rawaug.isp.staged import StagedISP, Tone, thumbnail
from rawaug.registry import suggest
from rawaug.seeding import Generators

_ADVICE = "fit or copy it again"
_INFINITE = ("colour.spread",)
"""Tensors that may hold infinity: the width is infinite if the light does not limit the colour."""


class DictionaryISP(StagedISP):
    """A learned, interpretable camera: ``config`` says what it consists of, ``seed`` sets its initial values.

    Example:
        >>> isp = DictionaryISP()
        >>> srgb = torch.rand(2, 3, 64, 96)
        >>> isp.reverse(srgb).raw.shape
        torch.Size([2, 1, 64, 96])
    """

    def __repr__(self) -> str:
        """Describe the pattern, the stages and the sizes of the dictionaries in a line."""
        config = self.config
        colours = count_of(config.colour_atoms, "colour atom")
        if config.cameras:
            colours += f" of {count_of(config.cameras, 'published camera')}"

        atoms = f"{colours}, {config.gain_atoms} gain and {config.tone_atoms} tone atoms"
        return f"DictionaryISP, {self.cfa}, stages {' '.join(self.stages)}: {atoms}"

    # -- settings ---------------------------------------------------------------------------------------------------

    def params_from_weights(
        self, colour_weights: Tensor, gain_weights: Tensor, tone_weights: Tensor | None = None
    ) -> ISPParams:
        """Combine atoms by given weights into the settings of B pictures.

        Args:
            colour_weights: ``(B, N)``, weights of the colour atoms.
            gain_weights: ``(B, M)``, weights of the gain atoms.
            tone_weights: ``(B, K)``, weights of the tone curves; the typical weights by default.
        """
        matrix, gains = self.colour.combine(colour_weights), self.gain.combine(gain_weights)
        if tone_weights is None:
            tone_weights = self.typical_tones().expand(len(matrix), -1)
        return ISPParams(colour_weights, gain_weights, matrix, gains, tone_weights)

    def draw_setting(self, batch: int, generator: Generators) -> ISPParams:
        """Draw the settings of ``batch`` pictures from a generator on the CPU, or one each, without looking at them.

        If the atoms are published cameras, it draws a camera in a light, else mixtures of atoms with uniform weights.
        """
        config, device = self.config, self.colour.matrices.device
        sampler = self.camera_sampler()
        if sampler is not None:
            return sampler.sample(batch, generator, device)

        weights = []
        for atoms in (config.colour_atoms, config.gain_atoms, config.tone_atoms):
            if atoms:
                weights.append(convex_weights(batch, atoms, generator).to(device))
        return self.params_from_weights(*weights)

    def camera_sampler(self, consistent: bool = True, light: float | str | None = None) -> CameraSampler | None:
        """Make the sampler that draws cameras in a light; None unless the colour atoms are published cameras.

        Later changes to the atoms do not affect it.

        Args:
            consistent: whether colour and gains are of one camera in one light; if not, gains are drawn separately.
            light: a colour temperature in kelvin or one of :data:`rawaug.camera.lights.LAMPS`; any light by default.
        """
        if not isinstance(self.colour, CameraDictionary):
            return None
        own = own_cameras(self.info)
        if own:
            return OwnCameraSampler(self.colour, own, self.config.tone_atoms, light, consistent)
        return CameraSampler(self.colour, self.config.tone_atoms, light_range(light), consistent)

    def choose(self, srgb: Tensor) -> ISPParams:
        """Choose the settings of pictures ``(B, 3, H, W)`` by the reverse encoders, or by their constants."""
        encoders = self.reverse_encoders
        if not self.config.encoders:
            return self.params_from_weights(encoders.colour(srgb), encoders.gain(srgb))

        x2 = self.linear(thumbnail(functional.as_float(srgb)))
        candidates = torch.einsum("nij,bjhw->bnihw", self.colour.atoms(), x2)
        colour_weights = encoders.colour(candidates)
        x3 = torch.einsum("bn,bnihw->bihw", colour_weights, candidates)

        balanced = []
        for gains in self.gain.channel_gains():
            balanced.append(functional.inverse_gains(x3, gains.expand(len(x3), 3), self.config.knee))
        return self.params_from_weights(colour_weights, encoders.gain(torch.stack(balanced, dim=1)))

    def choose_forward(self, x4: Tensor) -> ISPParams:
        """Choose the settings of linear images before white balance, x4 ``(B, 3, H, W)``, by the forward encoders."""
        small = thumbnail(x4)
        balanced = small[:, None] * self.gain.channel_gains()[None, :, :, None, None]
        gain_weights = self.forward_encoders.gain(balanced)

        x3 = functional.apply_gains(small, self.gain.combine(gain_weights))
        candidates = torch.einsum("nij,bjhw->bnihw", torch.linalg.pinv(self.colour.atoms()), x3)
        return self.params_from_weights(self.forward_encoders.colour(candidates), gain_weights)

    # -- passes -----------------------------------------------------------------------------------------------------

    def reverse(
        self,
        srgb: Tensor,
        params: ISPParams | None = None,
        *,
        white_balance: Tensor | tuple[float, ...] | None = None,
        digital_gain: Tensor | float | None = None,
        tone: Tone | None = None,
        raw_samples: Tensor | None = None,
        coordinates: Tensor | None = None,
        intermediates: bool = False,
    ) -> ISPResult:
        """Convert sRGB pictures to RAW.

        Args:
            srgb: ``(B, 3, H, W)``, uint8 or float in [0, 1], even sides.
            params: the settings of the pictures; by default the encoders, or their constants, choose them.
            white_balance: the camera's as-shot multipliers R, G, B, ``(3,)`` or ``(B, 3)``, scaled so that green is 1.
                They are fused with what the ISP would choose, by the errors of both (:mod:`rawaug.isp.staged`), and
                weigh the colour atoms by how near their light is.
            digital_gain: the factor on all channels, scalar or ``(B,)``, if it is known.
            tone: the tone curve that the picture was rendered with, if the ISP has a dictionary of them
                (``isp.info["tones"]``): a name such as ``"linear"``, which is LibRaw's rendering, or a mixture
                (:func:`rawaug.isp.staged.with_tone`). By default the ISP chooses it.
            raw_samples: ``(B, K, 3)`` of (row, column, RAW value): the gains follow from these few readings
                (:func:`rawaug.isp.staged.with_raw_samples`).
            coordinates: ``(1 or B, 2, H, W)`` of the pixels in the full frame
                (:func:`rawaug.isp.functional.frame_coordinates`); by default the picture is taken for a full frame.
            intermediates: also return x1 ... x5.

        Returns:
            A :class:`ISPResult` whose ``raw`` is the mosaic ``(B, 1, H, W)`` with the ISP's CFA, white at 1.

        Raises:
            ValueError: if the shape is not ``(B, 3, H, W)``, a side is odd, the picture or a gain is out of range, or
                an argument is for another number of pictures.
        """
        if srgb.ndim != 4 or srgb.shape[1] != 3 or min(srgb.shape[2:]) < 2:
            raise ValueError(f"sRGB must have shape (B, 3, H >= 2, W >= 2), got {tuple(srgb.shape)}")

        with self._float32(srgb):
            x = functional.as_display_referred(srgb)

            params = staged.with_tone(self, params or self.choose(x), tone)
            if len(params.gains) != len(x):
                pictures = count_of(len(params.gains), "picture")
                raise ValueError(f"the parameters are for {pictures}, but the batch has {len(x)}")
            if raw_samples is None:
                params = staged.with_white_balance(self, params, white_balance, digital_gain)
            else:
                where = functional.coordinates_or_full(x, coordinates)
                stated = white_balance, digital_gain
                params = staged.with_raw_samples(self, x, params, raw_samples, where, *stated)

            images: dict[str, Tensor] = {}
            x5 = self.reverse_pixels(x, params, coordinates, images if intermediates else None)
            return ISPResult(bayer.mosaic(x5, self.cfa), params, images)

    def _float32(self, like: Tensor) -> torch.autocast:
        """Keep the pass in float32, also in mixed precision; ValueError if the ISP has another type or device."""
        own = self.gain.log_gains
        if own.dtype != torch.float32:
            raise ValueError(f"RAW is float32, but this ISP was converted to {own.dtype}; call isp.float()")
        if own.device != like.device:
            raise ValueError(f"the picture is on {like.device} but the ISP is on {own.device}; call isp.to(...)")
        return torch.autocast(like.device.type, enabled=False)

    def forward(
        self,
        raw: Tensor,
        params: ISPParams | None = None,
        *,
        white_balance: Tensor | tuple[float, ...] | None = None,
        tone: Tone | None = None,
        coordinates: Tensor | None = None,
        intermediates: bool = False,
    ) -> ISPResult:
        """Develop RAW mosaics to sRGB.

        Args:
            raw: ``(B, 1, H, W)`` with the ISP's CFA, floating point, white = 1.
            params: the settings of the pictures; by default the forward encoders, or their constants, choose them.
            white_balance: the camera's as-shot multipliers R, G, B, ``(3,)`` or ``(B, 3)``.
            tone: the tone curve to render with, as in :meth:`reverse`.
            coordinates: as in :meth:`reverse`.
            intermediates: also return x5 ... x1.

        Returns:
            A :class:`ISPResult` whose ``srgb`` is ``(B, 3, H, W)`` in [0, 1].

        Raises:
            ValueError: if ``raw`` is no such mosaic or not finite, or an argument is for another number of pictures.
        """
        with self._float32(raw):
            x5 = bayer.demosaic(_require_mosaic(raw), self.cfa)
            if params is None:
                params = self.choose_forward(self.remove_shading(x5, coordinates))
            params = staged.with_white_balance(self, params, white_balance, None)
            params = staged.with_tone(self, params, tone)

            if not intermediates:
                srgb = self.forward_pixels(x5, params, coordinates)
                return ISPResult(srgb.clamp(0.0, 1.0), params)

            images: dict[str, Tensor] = {"x5": x5}
            srgb = self.forward_pixels(x5, params, coordinates, images)
            return ISPResult(srgb.clamp(0.0, 1.0), params, images)

    # -- as numbers -------------------------------------------------------------------------------------------------

    def typical_setting(self, white_balance: Sequence[float] | None = None) -> ISPParams:
        """The setting of one picture that the constants choose, under as-shot multipliers R, G, B if given."""
        encoders = self.reverse_encoders
        colour_weights = encoders.colour.prior.softmax(0)[None]
        gain_weights = encoders.gain.prior.softmax(0)[None]
        params = self.params_from_weights(colour_weights, gain_weights)

        if white_balance is None:
            return params

        # without a picture there is nothing to fuse with: the file decides
        balance = torch.tensor([tuple(white_balance)]).to(params.gains)
        balance = balance / balance[:, 1:2]
        weights = self.colour.weights_for(balance, colour_weights)
        return staged.with_grey(self, params, weights, balance.log() + weights @ self.colour.neutral)

    @torch.no_grad()
    def reverse_table(self, setting: ISPParams, nodes: int = 33) -> Tensor:
        """Tabulate the reverse pass up to the mosaic, at the centre of the shading, with ``nodes`` sRGB values an axis.

        Returns:
            Linear camera RGB ``(nodes ** 3, 3)``, black 0 and white 1, red changing fastest.
        """
        cube = stages.node_colours(nodes)
        shading = self.find(stages.LensShading)
        centre = torch.zeros(2)
        if shading is not None:
            centre = shading.mask.mean

        coordinates = centre[None, :, None, None].expand(1, 2, *cube.shape[-2:])
        return self.reverse_pixels(cube, setting, coordinates)[0].flatten(1).T.contiguous()

    @torch.no_grad()
    def tone_curve(self) -> Tensor:
        """Compute linear x2 of the 256 greys of sRGB, ``(256, 3)``: tone and gamma in one curve per channel."""
        return self.linear(torch.linspace(0.0, 1.0, 256).expand(1, 3, 1, -1))[0, :, 0].T.contiguous()

    @torch.no_grad()
    def description(self) -> dict[str, Any]:
        """Describe the ISP as JSON: its atoms, curves and mask, :meth:`typical_setting`, and the record of the fit."""
        setting, shading, info = self.typical_setting(), self.find(stages.LensShading), dict(self.info)
        mask = shading and {"mean": shading.mask.mean.tolist(), "precision": shading.mask.precision.tolist()}
        return {
            "kind": "isp",
            "cfa": str(self.cfa),
            "config": asdict(self.config),
            "parameters": sum(p.numel() for p in self.parameters()),
            "rendering": info.pop("rendering", None),
            "colour_atoms": self.colour.atoms().tolist(),
            "gain_atoms": self.gain.atoms().tolist(),
            "setting": {
                "colour_weights": setting.colour_weights[0].tolist(),
                "gain_weights": setting.gain_weights[0].tolist(),
                "matrix": setting.matrix[0].tolist(),
                "gains": setting.gains[0].tolist(),
            },
            "tone_curve": self.tone_curve().tolist(),
            "shading": mask,
            "noise": info.pop("noise", None),
            "info": info,
        }

    # -- files ------------------------------------------------------------------------------------------------------

    def save(self, path: str | Path) -> None:
        """Write weights, configuration and ``info`` to one safetensors file, completely or not at all."""
        header = {"format": "rawaug", "kind": "isp", "config": to_json(asdict(self.config)), "info": to_json(self.info)}
        write_tensors(self.state_dict(), header, path)

    @classmethod
    def from_pretrained(cls, name: str | Path) -> DictionaryISP:
        """Load an ISP by the name of one that the package ships, or from a path.

        The path of a camera's YAML file (:class:`rawaug.Camera`) gives ``universal`` with this camera.

        Raises:
            FileNotFoundError: if there is no such file or name.
            ValueError: if the file does not contain an ISP, or is damaged.
        """
        if is_camera_file(name):
            try:
                return restrict_to_cameras(cls.from_pretrained("universal"), name)
            except ValueError as error:
                text = str(error)
                if text.startswith(str(name)):
                    raise
                raise ValueError(f"{name}: {text}") from None

        path = find_weights(name)
        header, state = read_tensors(path, _ADVICE, _INFINITE)
        if header.get("kind") != "isp":
            raise ValueError(f"{path}: contains {header.get('kind', 'no rawaug weights')}, not an ISP")
        try:
            isp = cls(ISPConfig(**parse_object(header["config"])))
            _require_shapes(state, isp.state_dict())
            isp.load_state_dict(state)

            for part, atoms in (("colour", isp.colour.atoms()), ("gain", isp.gain.channel_gains())):
                if not atoms.isfinite().all():
                    raise ValueError(f"its {part} atoms are not finite")
            isp.info = parse_object(header.get("info", "{}"))
        except (LookupError, TypeError, ValueError) as error:
            reason = " ".join(str(error).split())
            raise ValueError(f"{path}: its configuration is damaged ({reason}); {_ADVICE}") from error
        return isp.eval()


@torch.no_grad()
def restrict_to_cameras(
    isp: DictionaryISP, names: str | Path | Camera | Sequence[str | Path | Camera]
) -> DictionaryISP:
    """Make an ISP whose atoms are some cameras; the tones and lights stay those of ``isp``.

    Args:
        isp: an ISP of published cameras, such as ``universal``.
        names: names of published cameras, cameras of your own (:class:`rawaug.Camera`) or paths of their YAML files.

    Raises:
        FileNotFoundError: if a camera's file is missing.
        ValueError: if the atoms of ``isp`` are not published cameras, or a name is unknown.
    """
    if not isinstance(isp.colour, CameraDictionary):
        raise ValueError("camera: needs an ISP with published cameras, such as universal")
    if isinstance(names, (str, Path, Camera)):
        names = [names]

    own = []
    published = []
    for name in names:
        if isinstance(name, Camera) or is_camera_file(name):
            own.append(as_camera(name))
        else:
            published.append(str(name))

    if own:
        for name in published:
            camera = Camera.published(name)
            own.append(replace(camera, cfa=own[0].cfa))  # the table of published cameras has no patterns
        return _with_own_cameras(isp, own)

    listed = load_cameras()
    cameras = [find_camera(name, listed.names) for name in published]
    narrowed = _without_colour(isp, colour_atoms=len(cameras), cameras=len(cameras))
    assert isinstance(narrowed.colour, CameraDictionary)
    narrowed.colour.set_cameras(listed.select(cameras), torch.eye(len(cameras)))
    narrowed.info = {**isp.info, "cameras": cameras}
    return narrowed.to(isp.colour.matrices.device).eval()


def _without_colour(isp: DictionaryISP, **changes: Any) -> DictionaryISP:
    """Copy an ISP with other colour atoms, and with ``tone_atoms`` other tone curves; both have yet to be set."""
    other = DictionaryISP(replace(isp.config, encoders=False, **changes))
    state = other.state_dict()
    for key, value in isp.state_dict().items():
        is_tone = key.startswith("stages.curve.")
        if not _of_colour(key) and not (is_tone and "tone_atoms" in changes):
            state[key] = value
    other.load_state_dict(state)
    return other


def _with_own_cameras(isp: DictionaryISP, cameras: Sequence[Camera]) -> DictionaryISP:
    """Make an ISP of the user's own cameras, with an atom for each light of a camera."""
    anchors = [camera.anchors() for camera in cameras]
    count = sum(map(len, anchors))

    patterns = {camera.cfa for camera in cameras}
    if len(patterns) > 1:
        raise ValueError(f"cameras have several patterns, {', '.join(sorted(patterns))}; give those of one pattern")
    (mosaic,) = patterns

    tones, curves = _tones_of(isp, cameras)
    pipeline = isp.config.stages
    if any(camera.shading is not None for camera in cameras):
        pipeline = (*pipeline, stages.FallOff.name)
    own = _without_colour(
        isp,
        stages=pipeline,
        colour_atoms=count,
        cameras=len(cameras),
        tone_atoms=len(curves),
        cfa=mosaic if mosaic in CFA.__members__ else isp.config.cfa,
    )
    assert own.tone is not None
    own.tone.curves.copy_(curves)

    assert isinstance(own.colour, CameraDictionary)
    falloff = own.find(stages.FallOff)
    daylight = white_point(D65)
    camera_weights = torch.zeros(len(cameras), count)
    atom = 0
    for row, in_lights in enumerate(anchors):
        by_day = weights_in_light([anchor.mired for anchor in in_lights], compute_mired(daylight[None].numpy()))
        camera_weights[row, atom : atom + len(in_lights)] = torch.from_numpy(by_day)[0].float()
        for anchor in in_lights:
            own.colour.matrices[atom] = anchor.matrix.float()
            own.colour.light[atom] = log_light(gains_in_light(anchor.from_xyz, daylight)[None])[0].float()
            shares = cameras[row].shading_in(anchor.light)
            if falloff is not None and shares is not None:
                falloff.set(atom, shares)
            atom += 1
    own.colour.known.copy_(camera_weights)

    own.info = {**isp.info, "cameras": [camera.name for camera in cameras]}
    own.info["own_cameras"] = [camera.to_json() for camera in cameras]
    own.info["tones"] = tones
    own.info.pop("holds", None)
    if mosaic not in CFA.__members__:
        own.info["pattern"] = mosaic
    if len(cameras) == 1 and cameras[0].noise_spec() is not None:
        own.info["noise"] = cameras[0].noise_spec()
    return own.to(isp.colour.matrices.device).eval()


def _tones_of(isp: DictionaryISP, cameras: Sequence[Camera]) -> tuple[list[str], Tensor]:
    """The names and inverse curves ``(K, 1021)`` to draw cameras with: their own, or the ISP's if one has none.

    Raises:
        ValueError: if a camera names a curve that the ISP does not have.
    """
    assert isp.tone is not None
    names = list(isp.info["tones"])
    curves = dict(zip(names, isp.tone.curves, strict=True))
    tones: dict[str, Tensor] = {}
    for camera in cameras:
        table = camera.inverse_curve(isp.tone.curves.shape[1])
        if camera.tone is None:
            tones |= curves
        elif table is not None:
            tones[camera.name] = table
        elif camera.tone in curves:
            tones[camera.tone] = curves[camera.tone]
        else:
            unknown = f"camera {camera.name!r}: tone {camera.tone!r:.80} is unknown"
            raise ValueError(f"{unknown}; use points or one of {', '.join(names)}{suggest(camera.tone, names)}")
    return list(tones), torch.stack(list(tones.values()))


def _require_shapes(tensors: Mapping[str, Tensor], expected: Mapping[str, Tensor]) -> None:
    for key in sorted({*tensors, *expected}):
        if key not in tensors or key not in expected or tensors[key].shape != expected[key].shape:
            raise ValueError(f"tensor {key} does not fit")


def _of_colour(key: str) -> bool:
    return key.startswith("colour.") or ("_encoders." in key and ".gain.prior" not in key)


def _require_mosaic(raw: Tensor) -> Tensor:
    """Return RAW as float32; ValueError unless it is a floating-point mosaic ``(B, 1, H, W)`` of finite values."""
    if raw.ndim != 4 or raw.shape[1] != 1 or not raw.is_floating_point():
        raise ValueError(f"RAW must be a floating-point mosaic (B, 1, H, W), got {tuple(raw.shape)} {raw.dtype}")
    if raw.device.type == "cpu" and (damaged := int((~raw.detach().isfinite()).sum())):
        raise ValueError(f"RAW must be finite, got NaN or infinity in {damaged} of {raw.numel()} values")
    return raw.float()
