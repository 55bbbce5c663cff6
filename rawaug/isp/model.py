r"""The dictionary ISP: sRGB to RAW and back, in six stages whose parameters come from two dictionaries.

``y = f6^-1 . f5^-1 . f4^-1 . f3^-1 . f2^-1 . f1^-1 (x)`` and ``x = f1 . f2 . f3 . f4 . f5 . f6 (y)``

Source: Conde et al., "Model-Based Image Signal Processors via Learnable Dictionaries", AAAI 2022. The stages are in
:mod:`rawaug.isp.stages`, the dictionaries in :mod:`rawaug.isp.dictionary`, the encoders that choose their atoms in
:mod:`rawaug.isp.encoders`, settings drawn at random in :mod:`rawaug.isp.sampling`, what a file states of a shot in
:mod:`rawaug.isp.fusion`, the mosaic in :mod:`rawaug.bayer`.
"""

from __future__ import annotations

from collections.abc import Sequence
from copy import deepcopy
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any, cast

import torch
from torch import Tensor, nn

from rawaug import bayer
from rawaug.bayer import CFA
from rawaug.camera.own import Camera, is_camera_file
from rawaug.errors import count_of
from rawaug.files import find_weights, parse_object, read_tensors, to_json, write_tensors
from rawaug.isp import functional, fusion
from rawaug.isp.cameras import (
    data_sheet_atoms,
    data_sheet_info,
    data_sheet_shading,
    data_sheet_tones,
    published_atoms,
    read_cameras,
)
from rawaug.isp.config import ISPConfig, ISPInfo, ISPParams, ISPResult
from rawaug.isp.dictionary import CameraDictionary, ColourDictionary, GainDictionary
from rawaug.isp.encoders import AtomEncoder, Encoders, thumbnail
from rawaug.isp.fusion import Tone
from rawaug.isp.stages import STAGES, FallOff, Stages
from rawaug.isp.tone import ToneCurve, ToneDictionary
from rawaug.seeding import derive_seed, initialise_from

_ADVICE = "fit or copy it again"
_INFINITE = ("colour.spread",)
"""Tensors that may hold infinity: the width is infinite if the light does not limit the colour."""


class DictionaryISP(nn.Module):
    """A learned, interpretable camera.

    Args:
        config: the parts that it consists of.
        seed: sets the initial values.

    Example:
        >>> isp = DictionaryISP()
        >>> srgb = torch.rand(2, 3, 64, 96)
        >>> isp.reverse(srgb).raw.shape
        torch.Size([2, 1, 64, 96])
    """

    def __init__(self, config: ISPConfig | None = None, seed: int = 0) -> None:
        super().__init__()
        self.info: ISPInfo = {}
        """The record of the fit."""
        self.config = config or ISPConfig()
        """The parts that the ISP consists of; :meth:`configure` and :meth:`use_encoders` change them."""

        with initialise_from(seed):
            self.colour = ColourDictionary(self.config.colour_atoms)
            if self.config.cameras:
                self.colour = CameraDictionary(self.config.colour_atoms, self.config.cameras)
            self.gain = GainDictionary(self.config.gain_atoms)

            self.stages = Stages({name: STAGES[name](self.config) for name in self.config.stages})
            self.reverse_encoders, self.forward_encoders = Encoders(self.config), Encoders(self.config)
        self.use_encoders(self.config.encoders, seed)

    def __repr__(self) -> str:
        """Describe the pattern, the stages and the sizes of the dictionaries in a line."""
        config = self.config
        colours = count_of(config.colour_atoms, "colour atom")
        if config.cameras:
            colours += f" of {count_of(config.cameras, 'published camera')}"

        atoms = f"{colours}, {config.gain_atoms} gain and {config.tone_atoms} tone atoms"
        return f"DictionaryISP, {self.cfa}, stages {' '.join(self.stages)}: {atoms}"

    @property
    def cfa(self) -> CFA:
        """The pattern of the RAW that this ISP makes."""
        return CFA(self.config.cfa)

    def with_atoms(
        self,
        *,
        colour: ColourDictionary,
        gain: GainDictionary | None = None,
        tone: ToneDictionary | None = None,
        falloff: Tensor | None = None,
    ) -> DictionaryISP:
        """Make an ISP of other atoms, whose constants weigh them equally; it has no encoders that look at the picture.

        Args:
            colour: the colour atoms.
            gain: the gain atoms; by default those of this ISP, with their constants.
            tone: the tone curves, for an ISP with the stage ``curve``; by default those of this ISP.
            falloff: the shares of light ``(N, 3, 33, 33)`` that arrive with each colour atom; by default all does.
        """
        isp = deepcopy(self)
        isp.use_encoders(False)
        isp.colour = colour
        cameras = len(colour.known) if isinstance(colour, CameraDictionary) else 0
        isp.configure(colour_atoms=len(colour.matrices), cameras=cameras)
        if gain is not None:
            isp.gain = gain
            isp.configure(gain_atoms=len(gain.log_gains))
        for encoders in (isp.reverse_encoders, isp.forward_encoders):
            encoders.colour = AtomEncoder(len(colour.matrices))
            if gain is not None:
                encoders.gain = AtomEncoder(len(gain.log_gains))

        if tone is not None:
            cast(ToneCurve, isp.stages[ToneCurve.name]).dictionary = tone
            isp.configure(tone_atoms=len(tone.curves))

        stages = [name for name in isp.stages if name != FallOff.name]
        if falloff is not None:
            stages.append(FallOff.name)
            stage = FallOff(isp.config)
            stage.tables.copy_(falloff)
            isp.stages[FallOff.name] = stage
        isp.configure(stages=tuple(stages))
        return isp

    @torch.no_grad()
    def with_cameras(self, cameras: str | Path | Camera | Sequence[str | Path | Camera]) -> DictionaryISP:
        """Make an ISP whose atoms are some cameras; tones and lights stay those of this ISP.

        Args:
            cameras: names of published cameras, cameras of your own (:class:`rawaug.Camera`) or paths of their YAML
                files.

        Raises:
            FileNotFoundError: if a camera's file is missing.
            ValueError: if the atoms of this ISP are not published cameras, or a name is unknown.
        """
        if not isinstance(self.colour, CameraDictionary):
            raise ValueError("camera: needs an ISP with published cameras, such as universal")

        sheets, published = read_cameras(cameras)
        if not sheets:
            isp = self.with_atoms(colour=published_atoms(published))
            isp.info = {**self.info, "cameras": published}
            return isp.to(self.colour.matrices.device).eval()

        assert self.tone is not None
        tones = data_sheet_tones(sheets, dict(zip(self.info["tones"], self.tone.curves, strict=True)))
        isp = self.with_atoms(
            colour=data_sheet_atoms(sheets),
            tone=ToneDictionary.from_curves(torch.stack(list(tones.values()))),
            falloff=data_sheet_shading(sheets),
        )
        isp.info = {**self.info, **data_sheet_info(sheets), "tones": list(tones)}
        isp.info.pop("holds", None)
        if sheets[0].cfa in CFA.__members__:
            isp.configure(cfa=sheets[0].cfa)
        return isp.to(self.colour.matrices.device).eval()

    def configure(self, **changes: Any) -> None:
        """Change settings that need no new parameters: ``cfa``, ``knee``, or ``stages`` to fewer of them."""
        config = replace(self.config, **changes)
        for name in config.stages:
            if name not in self.stages:
                raise ValueError(f"stages: {name!r} is not in this ISP, which has {' '.join(self.stages)}")

        self.config = config
        self.stages = Stages({name: self.stages[name] for name in config.stages})
        for stage in self.stages.ordered:
            stage.config = config

    def use_encoders(self, enabled: bool, seed: int = 0) -> None:
        """Make the encoders' networks, drawn from ``seed``, or remove them; existing networks stay as they are."""
        with initialise_from(derive_seed(seed, "encoders")):
            for module in list(self.modules()):
                if not isinstance(module, AtomEncoder):
                    continue
                if not enabled:
                    module.layers = None
                elif module.layers is None:
                    module.add_layers(self.config.encoder_widths)

        self.configure(encoders=enabled)

    @property
    def tone(self) -> ToneDictionary | None:
        """The dictionary of tone curves; None if the curve is learned."""
        stage = self.stages.find(ToneCurve)
        return None if stage is None else stage.dictionary

    def typical_tones(self) -> Tensor:
        """Weights ``(K,)`` of the tone curves for a picture of which nothing is known; none if the curve is learned."""
        if self.tone is None:
            return self.colour.matrices.new_zeros(0)
        return self.tone.typical

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

    def choose(self, srgb: Tensor) -> ISPParams:
        """Choose the settings of pictures ``(B, 3, H, W)`` by the reverse encoders, or by their constants."""
        encoders = self.reverse_encoders
        if not self.config.encoders:
            return self.params_from_weights(encoders.colour(srgb), encoders.gain(srgb))

        x2 = self.stages.linear(thumbnail(functional.as_float(srgb)))
        weights = encoders.weigh_reverse(x2, self.colour, self.gain, self.config.knee)
        return self.params_from_weights(*weights)

    def choose_forward(self, x4: Tensor) -> ISPParams:
        """Choose the settings of linear images before white balance, x4 ``(B, 3, H, W)``, by the forward encoders."""
        weights = self.forward_encoders.weigh_forward(thumbnail(x4), self.colour, self.gain)
        return self.params_from_weights(*weights)

    # -- what is known of a shot ------------------------------------------------------------------------------------

    def with_white_balance(
        self,
        params: ISPParams,
        white_balance: Tensor | tuple[float, ...] | None,
        digital_gain: Tensor | float | None = None,
    ) -> ISPParams:
        """Fuse the gains and the colour atoms that were chosen for pictures with what the camera states.

        Args:
            params: the settings chosen for B pictures.
            white_balance, digital_gain: as for :meth:`reverse`.

        Raises:
            ValueError: if a multiplier is not positive, or the shapes are for another number of pictures.
        """
        params, _ = fusion.fuse_stated(self.colour, self.info, params, white_balance, digital_gain)
        return params

    def with_tone(self, params: ISPParams, tone: Tone | None) -> ISPParams:
        """Replace the tone curves of a setting by a known one, or by a mixture.

        Args:
            params: the settings of B pictures.
            tone: a name of ``isp.info["tones"]`` such as ``"linear"``, shares by name such as
                ``{"linear": 0.5, "upi": 0.5}``, or weights ``(K,)`` or ``(B, K)``. Shares and weights are divided by
                their sum. None keeps the setting's own.

        Raises:
            ValueError: if the ISP has no such curve, or a share is negative.
        """
        if tone is None:
            return params
        if self.tone is None:
            raise ValueError("tone: this ISP has learned a curve of its own; only one with a dictionary takes it")

        like = params.gains.new_empty(len(params.gains), len(self.tone.curves))
        return params._replace(tone_weights=fusion.weigh_tones(tone, self.info.get("tones", ()), like))

    def with_raw_samples(
        self,
        params: ISPParams,
        x: Tensor,
        raw_samples: Tensor,
        coordinates: Tensor,
        white_balance: Tensor | tuple[float, ...] | None = None,
        digital_gain: Tensor | float | None = None,
    ) -> ISPParams:
        """Fuse the chosen gains with RAW readings and what the camera states.

        The readings' light weighs the colour atoms. Clipped readings do not count.

        Args:
            params: the settings chosen for the pictures.
            x: sRGB as float ``(B, 3, H, W)``.
            raw_samples: ``(B, K, 3)`` of row, column and RAW value.
            coordinates: ``(1 or B, 2, H, W)`` of the pixels in the full frame.
            white_balance, digital_gain: as for :meth:`reverse`.

        Raises:
            ValueError: if a reading is NaN or lies outside the picture.
        """
        pixels, places, site, value = fusion.locate_readings(raw_samples, x, coordinates, self.cfa)

        def reverse(setting: ISPParams) -> Tensor:
            return self.stages.reverse(pixels, setting, places)[:, :, 0]

        stated = fusion.fuse_stated(self.colour, self.info, params, white_balance, digital_gain)
        chosen = params.colour_weights
        return fusion.fuse_readings(reverse, self.colour, self.tone, chosen, *stated, pixels, site, value)

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
                They are fused with what the ISP would choose, by the errors of both (:mod:`rawaug.isp.fusion`), and
                weigh the colour atoms by how near their light is.
            digital_gain: the factor on all channels, scalar or ``(B,)``, if it is known.
            tone: the tone curve that the picture was rendered with, if the ISP has a dictionary of them
                (``isp.info["tones"]``): a name such as ``"linear"``, which is LibRaw's rendering, or a mixture
                (:meth:`with_tone`). By default the ISP chooses it.
            raw_samples: ``(B, K, 3)`` of (row, column, RAW value): the gains follow from these few readings
                (:meth:`with_raw_samples`).
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

            params = self.with_tone(params or self.choose(x), tone)
            if len(params.gains) != len(x):
                pictures = count_of(len(params.gains), "picture")
                raise ValueError(f"the parameters are for {pictures}, but the batch has {len(x)}")
            if raw_samples is None:
                params = self.with_white_balance(params, white_balance, digital_gain)
            else:
                places = functional.coordinates_or_full(x, coordinates)
                params = self.with_raw_samples(params, x, raw_samples, places, white_balance, digital_gain)

            images: dict[str, Tensor] = {}
            x5 = self.stages.reverse(x, params, coordinates, images if intermediates else None)
            return ISPResult(bayer.mosaic(x5, self.cfa), params, images)

    def _float32(self, like: Tensor) -> torch.autocast:
        """Keep the pass in float32, also in mixed precision; ValueError if the ISP has another type or device."""
        dtype, device = self.gain.log_gains.dtype, self.gain.log_gains.device
        if dtype != torch.float32:
            raise ValueError(f"RAW is float32, but this ISP was converted to {dtype}; call isp.float()")
        if device != like.device:
            raise ValueError(f"the picture is on {like.device} but the ISP is on {device}; call isp.to(...)")
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
            x5 = bayer.demosaic(functional.as_mosaic(raw), self.cfa)
            if params is None:
                params = self.choose_forward(self.stages.remove_shading(x5, coordinates))
            params = self.with_white_balance(params, white_balance)
            params = self.with_tone(params, tone)

            images: dict[str, Tensor] = {}
            if intermediates:
                images["x5"] = x5
            srgb = self.stages.forward(x5, params, coordinates, images if intermediates else None)
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
        return fusion.with_grey(self.colour, params, weights, balance.log() + weights @ self.colour.neutral)

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
                return cls.from_pretrained("universal").with_cameras(name)
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
            expected = isp.state_dict()
            for key in sorted({*state, *expected}):
                if key not in state or key not in expected or state[key].shape != expected[key].shape:
                    raise ValueError(f"tensor {key} does not fit")
            isp.load_state_dict(state)

            for part, atoms in (("colour", isp.colour.atoms()), ("gain", isp.gain.channel_gains())):
                if not atoms.isfinite().all():
                    raise ValueError(f"its {part} atoms are not finite")
            isp.info = cast(ISPInfo, parse_object(header.get("info", "{}")))
        except (LookupError, TypeError, ValueError) as error:
            reason = " ".join(str(error).split())
            raise ValueError(f"{path}: its configuration is damaged ({reason}); {_ADVICE}") from error
        return isp.eval()
