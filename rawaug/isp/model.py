r"""The dictionary ISP: sRGB to RAW and back, six stages whose parameters come from two dictionaries.

``y = f6^-1 . f5^-1 . f4^-1 . f3^-1 . f2^-1 . f1^-1 (x)`` and ``x = f1 . f2 . f3 . f4 . f5 . f6 (y)``

Source: Conde et al., "Model-Based Image Signal Processors via Learnable Dictionaries", AAAI 2022. The stages are in
:mod:`rawaug.isp.stages`, the dictionaries in :mod:`rawaug.isp.dictionary`, the mosaic in :mod:`rawaug.bayer`.
"""

from __future__ import annotations

import json
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn

from rawaug import bayer
from rawaug.bayer import CFA
from rawaug.files import find_weights, read_tensors, write_tensors
from rawaug.isp import conditioning, stages
from rawaug.isp.config import POINTWISE_STAGES, ISPConfig
from rawaug.isp.dictionary import ColourDictionary, GainDictionary
from rawaug.isp.encoder import Encoder, thumbnail
from rawaug.isp.setting import ISPParams, ISPResult
from rawaug.seeding import initialised_from


class DirectionNetworks(nn.Module):
    """What each direction has of its own: tone network, gamma, attention mask and the two encoders."""

    def __init__(self, config: ISPConfig) -> None:
        super().__init__()
        self.tone = stages.ToneNetwork()
        self.gamma = nn.Parameter(torch.tensor(2.2))
        self.attention = stages.AttentionMask()
        self.colour_encoder = Encoder(config.colour_atoms, config.encoder_widths)
        self.gain_encoder = Encoder(config.gain_atoms, config.encoder_widths)


class DictionaryISP(nn.Module):
    """A learned, interpretable camera.

    Args:
        config: what it is made of.
        seed: of the networks and gains that it starts with.

    Example:
        >>> isp = DictionaryISP()
        >>> srgb = torch.rand(2, 3, 64, 96)
        >>> isp.reverse(srgb).raw.shape
        torch.Size([2, 1, 64, 96])
    """

    def __init__(self, config: ISPConfig | None = None, seed: int = 0) -> None:
        super().__init__()
        self.config = config or ISPConfig()
        self.info: dict[str, Any] = {}
        with initialised_from(seed):
            self.colour = ColourDictionary(self.config.colour_atoms)
            self.gain = GainDictionary(self.config.gain_atoms)
            self.shading = stages.GaussianMask()
            self.reverse_networks = DirectionNetworks(self.config)
            self.forward_networks = DirectionNetworks(self.config)
        self.use_encoders(self.config.encoders)

    @property
    def cfa(self) -> CFA:
        """The pattern of the RAW that this ISP makes."""
        return CFA(self.config.cfa)

    @property
    def encoders_in_use(self) -> bool:
        """Whether the encoders look at the picture."""
        return self.reverse_networks.colour_encoder.enabled

    def use_encoders(self, enabled: bool) -> None:
        """Let the encoders look at the picture, or use their learned constants; goes into the file."""
        self.config = replace(self.config, encoders=enabled)
        for networks in (self.reverse_networks, self.forward_networks):
            networks.colour_encoder.enabled = networks.gain_encoder.enabled = enabled

    # -- parameters -------------------------------------------------------------------------------------------------

    def params_from_weights(self, colour_weights: Tensor, gain_weights: Tensor) -> ISPParams:
        """Parameters from given weights ``(B, N)`` and ``(B, M)``."""
        matrix, gains = self.colour.combine(colour_weights), self.gain.combine(gain_weights)
        return ISPParams(colour_weights, gain_weights, matrix, gains)

    def choose(self, srgb: Tensor) -> ISPParams:
        """The parameters that the reverse encoders (or their constants) choose for ``srgb`` ``(B, 3, H, W)``."""
        networks = self.reverse_networks
        x2 = self._linear(thumbnail(stages.as_float(srgb)))
        candidates = torch.einsum("nij,bjhw->bnihw", self.colour.atoms(), x2)
        colour_weights = networks.colour_encoder(candidates)
        x3 = torch.einsum("bn,bnihw->bihw", colour_weights, candidates)
        gains = self.gain.channel_gains()
        balanced = [stages.inverse_gains(x3, g.expand(len(x3), 3), self.config.knee) for g in gains]
        return self.params_from_weights(colour_weights, networks.gain_encoder(torch.stack(balanced, dim=1)))

    def choose_forward(self, x4: Tensor) -> ISPParams:
        """The parameters that the forward encoders choose for a linear image before white balance ``(B, 3, H, W)``."""
        networks = self.forward_networks
        small = thumbnail(x4)
        balanced = small[:, None] * self.gain.channel_gains()[None, :, :, None, None]
        gain_weights = networks.gain_encoder(balanced)
        x3 = stages.apply_gains(small, self.gain.combine(gain_weights))
        candidates = torch.einsum("nij,bjhw->bnihw", torch.linalg.pinv(self.colour.atoms()), x3)
        return self.params_from_weights(networks.colour_encoder(candidates), gain_weights)

    # -- passes -----------------------------------------------------------------------------------------------------

    def reverse(
        self,
        srgb: Tensor,
        params: ISPParams | None = None,
        *,
        white_balance: Tensor | tuple[float, ...] | None = None,
        digital_gain: Tensor | float | None = None,
        raw_samples: Tensor | None = None,
        place: Tensor | None = None,
        intermediates: bool = False,
    ) -> ISPResult:
        """sRGB to RAW.

        Args:
            srgb: ``(B, 3, H, W)``, uint8 or float in [0, 1], even sides.
            params: camera setting; chosen by the encoders (or their constants) if not given.
            white_balance: the camera's as-shot multipliers R, G, B, ``(3,)`` or ``(B, 3)``; green is made 1. They
                choose the colour atoms of such light as well.
            digital_gain: the factor on all channels, scalar or ``(B,)``; the fit's own by default.
            raw_samples: ``(B, K, 3)`` of (row, column, RAW value): the gains are solved for from these few readings
                (:func:`rawaug.isp.conditioning.with_raw_samples`).
            place: coordinates of the pixels in the full frame, ``(1 or B, 2, H, W)``
                (:func:`rawaug.isp.stages.place_in_frame`); the picture is taken for a full frame by default.
            intermediates: also return x1 ... x5.

        Returns:
            A :class:`ISPResult` whose ``raw`` is the mosaic ``(B, 1, H, W)`` with the ISP's CFA, white at 1.

        Raises:
            ValueError: if the shape is not ``(B, 3, H, W)``, a side is odd, the picture or a gain is out of range, or
                what is given is for another number of pictures.
        """
        if srgb.ndim != 4 or srgb.shape[1] != 3:
            raise ValueError(f"sRGB must have shape (B, 3, H, W), got {tuple(srgb.shape)}")
        x = stages.display_referred(srgb)
        params = conditioning.with_white_balance(self, params or self.choose(x), white_balance, digital_gain)
        if len(params.gains) != len(x):
            raise ValueError(f"the parameters are for {len(params.gains)} pictures, but the batch has {len(x)}")
        if raw_samples is not None:
            params = conditioning.with_raw_samples(self, x, params, raw_samples, self.place(x, place))
        seen: dict[str, Tensor] = {}
        x5 = self.reverse_pixels(x, params, place, seen if intermediates else None)
        return ISPResult(bayer.mosaic(x5, self.cfa), params, seen)

    def reverse_pixels(
        self, x: Tensor, params: ISPParams, place: Tensor | None = None, seen: dict[str, Tensor] | None = None
    ) -> Tensor:
        """x to x5 ``(B, 3, H, W)``, the reverse pass without its mosaic; fills ``seen`` with x1 ... x5."""
        networks = self.reverse_networks
        for name in self.config.stages:
            if name == "tone":
                x = networks.tone(x)
            elif name == "gamma":
                x = stages.gamma_expand(x, networks.gamma)
            elif name == "colour":
                x = stages.correct_colour(x, params.matrix)
            elif name == "gains":
                x = stages.inverse_gains(x, params.gains, self.config.knee)
            else:
                x = x * self.shading(self.place(x, place))
                x = x * networks.attention(x) if self.config.attention else x
            if seen is not None:
                seen[f"x{POINTWISE_STAGES.index(name) + 1}"] = x
        return x

    def forward(
        self,
        raw: Tensor,
        params: ISPParams | None = None,
        *,
        white_balance: Tensor | tuple[float, ...] | None = None,
        place: Tensor | None = None,
        intermediates: bool = False,
    ) -> ISPResult:
        """RAW mosaic ``(B, 1, H, W)`` to sRGB ``(B, 3, H, W)`` in [0, 1]; arguments as in :meth:`reverse`."""
        x5 = bayer.demosaic(raw, self.cfa)
        if params is None:
            x4 = self._correct_shading(x5, place) if "shading" in self.config.stages else x5
            params = self.choose_forward(x4)
        params = conditioning.with_white_balance(self, params, white_balance, None)
        seen: dict[str, Tensor] = {"x5": x5}
        srgb = self.forward_pixels(x5, params, place, seen if intermediates else None)
        return ISPResult(srgb.clamp(0.0, 1.0), params, seen if intermediates else {})

    def forward_pixels(
        self, x: Tensor, params: ISPParams, place: Tensor | None = None, seen: dict[str, Tensor] | None = None
    ) -> Tensor:
        """x5 ``(B, 3, H, W)`` to x, not clipped; fills ``seen`` with x4 ... x1."""
        networks = self.forward_networks
        for name in reversed(self.config.stages):
            if name == "shading":
                x = self._correct_shading(x, place)
            elif name == "gains":
                x = stages.apply_gains(x, params.gains)
            elif name == "colour":
                x = stages.correct_colour(x, torch.linalg.pinv(params.matrix))
            elif name == "gamma":
                x = stages.gamma_compress(x, networks.gamma)
            else:
                x = networks.tone(x)
            number = POINTWISE_STAGES.index(name)
            if seen is not None and number:
                seen[f"x{number}"] = x
        return x

    def _linear(self, x: Tensor) -> Tensor:
        if "tone" in self.config.stages:
            x = self.reverse_networks.tone(x)
        return stages.gamma_expand(x, self.reverse_networks.gamma) if "gamma" in self.config.stages else x

    def _correct_shading(self, x5: Tensor, place: Tensor | None) -> Tensor:
        x = x5 / self.shading(self.place(x5, place))
        return x * self.forward_networks.attention(x) if self.config.attention else x

    def place(self, x: Tensor, place: Tensor | None = None) -> Tensor:
        """``place``, or that of a full frame, in the type of ``x``."""
        return (stages.place_in_frame(*x.shape[-2:]) if place is None else place).to(x)

    # -- files ------------------------------------------------------------------------------------------------------

    def save(self, path: str | Path) -> None:
        """Write weights, configuration and ``info`` to one safetensors file, atomically."""
        header = {"format": "rawaug", "kind": "isp", "config": json.dumps(asdict(self.config))}
        header["info"] = json.dumps(self.info)
        write_tensors(self.state_dict(), header, path)

    @classmethod
    def from_pretrained(cls, name: str | Path) -> DictionaryISP:
        """Load an ISP: the name of one shipped with the package, or a path.

        Raises:
            FileNotFoundError: if there is no such file or name.
            ValueError: if the file is not that of an ISP.
        """
        path = find_weights(name)
        header, state = read_tensors(path, "fit or copy it again")
        if header.get("kind") != "isp":
            raise ValueError(f"{path}: contains {header.get('kind', 'no rawaug weights')}, not an ISP")
        try:
            settings: dict[str, Any] = json.loads(header["config"])
            config = ISPConfig(**settings)
            info = dict(json.loads(header.get("info", "{}")))
            with torch.device("meta"):  # takes no memory before the tensors are known to fit
                expected = cls(config).state_dict()
        except (AttributeError, LookupError, OverflowError, RuntimeError, TypeError, ValueError) as error:
            reason = str(error).splitlines()[0]
            raise ValueError(f"{path}: its configuration is damaged ({reason}); fit or copy it again") from error
        shapes, needed = ({key: value.shape for key, value in tensors.items()} for tensors in (state, expected))
        if wrong := sorted(key for key in shapes | needed if shapes.get(key) != needed.get(key)):
            raise ValueError(f"{path}: tensor {wrong[0]} does not fit its configuration; fit or copy it again")
        isp = cls(config)
        isp.load_state_dict(state)
        isp.info = info
        return isp.eval()
