"""What an ISP is made of: stages in order, two dictionaries, and the encoders that choose among their atoms.

An encoder gives the weights of a dictionary's atoms, ``w = softmax(b + E(I))``, from the N images ``I`` that the atoms
make of one picture (Conde et al., AAAI 2022, "Parameter Dictionaries"); ``b`` is a learned constant, which decides
alone where there is no network ``E``.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any, TypeVar, cast

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from rawaug.bayer import CFA
from rawaug.isp.config import ISPConfig, ISPParams
from rawaug.isp.dictionary import CameraDictionary, ColourDictionary, GainDictionary
from rawaug.isp.stages import Stage
from rawaug.isp.tone import ToneCurve, ToneDictionary
from rawaug.registry import STAGES
from rawaug.seeding import derived_seed, initialised_from

S = TypeVar("S", bound=Stage)


THUMBNAIL = 48
"""Longest side of what an encoder looks at."""


class Encoder(nn.Module):
    """A learned constant ``prior`` ``(N,)``, as logits, and convolutions if it looks at the picture."""

    def __init__(self, atoms: int) -> None:
        super().__init__()
        self.prior = nn.Parameter(torch.zeros(atoms))
        self.layers: nn.Sequential | None = None

    @property
    def looks(self) -> bool:
        """Whether it looks at the picture."""
        return self.layers is not None

    def add_layers(self, widths: tuple[int, int, int]) -> None:
        """Look at the picture from now on; changes no weight before the layers are trained."""
        atoms = len(self.prior)
        channels = (3 * atoms, *widths)
        layers: list[nn.Module] = []
        for i in range(3):
            layers += [nn.Conv2d(channels[i], channels[i + 1], 3, stride=2, padding=1), nn.ReLU()]
        head = nn.Linear(widths[-1], atoms)
        nn.init.zeros_(head.weight)
        nn.init.zeros_(head.bias)
        self.layers = nn.Sequential(*layers, nn.AdaptiveAvgPool2d(1), nn.Flatten(), head).to(self.prior.device)

    def forward(self, images: Tensor) -> Tensor:
        """Images ``(B, N, 3, h, w)`` to weights ``(B, N)`` on the simplex."""
        logits = self.prior.expand(len(images), -1)
        if self.layers is not None:
            logits = logits + self.layers(images.flatten(1, 2))
        return logits.softmax(dim=1)

    @torch.no_grad()
    def set_prior(self, weights: Tensor) -> None:
        """Make the constant ``weights`` ``(N,)`` (zeros become 1e-6)."""
        self.prior.copy_(weights.clamp_min(1e-6).log())


class Encoders(nn.Module):
    """What chooses the weights of both dictionaries in one direction."""

    def __init__(self, config: ISPConfig) -> None:
        super().__init__()
        self.colour = Encoder(config.colour_atoms)
        self.gain = Encoder(config.gain_atoms)


def thumbnail(image: Tensor) -> Tensor:
    """``(B, 3, H, W)`` averaged down to at most :data:`THUMBNAIL` a side."""
    height, width = image.shape[-2:]
    scale = THUMBNAIL / max(height, width, THUMBNAIL)
    return F.adaptive_avg_pool2d(image, (max(1, round(height * scale)), max(1, round(width * scale))))


class StagedISP(nn.Module):
    """Stages, dictionaries and encoders; :class:`rawaug.isp.model.DictionaryISP` adds the choice of a setting."""

    def __init__(self, config: ISPConfig | None = None, seed: int = 0) -> None:
        super().__init__()
        self.info: dict[str, Any] = {}
        """What a fit recorded."""
        self.config = config or ISPConfig()
        """What it is made of; :meth:`configure` and :meth:`use_encoders` change it."""
        with initialised_from(seed):
            self.colour = ColourDictionary(self.config.colour_atoms)
            if self.config.cameras:
                self.colour = CameraDictionary(self.config.colour_atoms, self.config.cameras)
            self.gain = GainDictionary(self.config.gain_atoms)
            made = [STAGES[name](self.config) for name in self.config.stages]
            self.stages = nn.ModuleDict({stage.name: stage for stage in made})
            self.reverse_encoders, self.forward_encoders = Encoders(self.config), Encoders(self.config)
        self.use_encoders(self.config.encoders, seed)

    @property
    def cfa(self) -> CFA:
        """The pattern of the RAW that this ISP makes."""
        return CFA(self.config.cfa)

    @property
    def ordered_stages(self) -> list[Stage]:
        """The stages in reverse order."""
        return [cast(Stage, stage) for stage in self.stages.values()]

    def find(self, kind: type[S]) -> S | None:
        """The stage of this class, or None."""
        return next((stage for stage in self.ordered_stages if isinstance(stage, kind)), None)

    def configure(self, **changes: Any) -> None:
        """Change settings that need no new parameters: ``cfa``, ``knee``, or ``stages`` to fewer of them."""
        config = replace(self.config, **changes)
        if absent := [name for name in config.stages if name not in self.stages]:
            raise ValueError(f"stages: {absent[0]!r} is not in this ISP, which has {' '.join(self.stages)}")
        self.config = config
        self.stages = nn.ModuleDict({name: self.stages[name] for name in config.stages})
        for stage in self.ordered_stages:
            stage.config = config

    def use_encoders(self, enabled: bool, seed: int = 0) -> None:
        """Make networks for the encoders, drawn from ``seed``, or remove them; existing ones stay as they are."""
        with initialised_from(derived_seed(seed, "encoders")):
            for encoder in (module for module in self.modules() if isinstance(module, Encoder)):
                if not enabled:
                    encoder.layers = None
                elif not encoder.looks:
                    encoder.add_layers(self.config.encoder_widths)
        self.configure(encoders=enabled)

    @property
    def tone(self) -> ToneDictionary | None:
        """The dictionary of tone curves; None where the curve is learned."""
        stage = self.find(ToneCurve)
        return stage.dictionary if stage else None

    def typical_tones(self) -> Tensor:
        """Weights ``(K,)`` of the tone curves where nothing is known of a picture; none where the curve is learned."""
        return self.tone.typical if self.tone else self.colour.matrices.new_zeros(0)

    def reverse_pixels(
        self, x: Tensor, params: ISPParams, place: Tensor | None = None, seen: dict[str, Tensor] | None = None
    ) -> Tensor:
        """x to x5 ``(B, 3, H, W)``, the reverse pass without its mosaic; fills ``seen`` with x1 ... x5."""
        for stage in self.ordered_stages:
            x = stage.reverse(x, params, place)
            if seen is not None:
                seen[f"x{stage.makes}"] = x
        return x

    def forward_pixels(
        self, x: Tensor, params: ISPParams, place: Tensor | None = None, seen: dict[str, Tensor] | None = None
    ) -> Tensor:
        """x5 ``(B, 3, H, W)`` to x, not clipped; fills ``seen`` with x4 ... x1."""
        for stage in reversed(self.ordered_stages):
            x = stage.forward(x, params, place)
            if seen is not None and stage.makes > 1:
                seen[f"x{stage.makes - 1}"] = x
        return x

    def linear(self, x: Tensor) -> Tensor:
        """x to x2 by the stages in their usual order, without a setting: what the reverse encoders look at."""
        for stage in sorted(self.ordered_stages, key=lambda stage: stage.makes):
            x = stage.reverse(x, None) if stage.makes <= 2 else x
        return x

    def unshaded(self, x: Tensor, place: Tensor | None) -> Tensor:
        """x5 to x4, what the forward encoders look at."""
        for stage in reversed(self.ordered_stages):
            x = stage.forward(x, None, place) if stage.makes >= 5 else x
        return x
