"""The settings of the fit of an ISP."""

from __future__ import annotations

from dataclasses import dataclass, field, fields, replace
from typing import Annotated, Any, Literal

from annotated_types import Interval

from rawaug.isp.config import POINTWISE_STAGES, SMALL, ISPConfig
from rawaug.isp.stages import STAGES
from rawaug.registry import require_bounds

_PUBLISHED_STEPS = 3000
"""Number of end-to-end steps of the published fit."""
MOST = 2**31
"""Upper limit of settings that count steps or pixels."""

Steps = Annotated[int, Interval(ge=0, le=MOST)]
"""A number of steps."""

Weight = Annotated[float, Interval(ge=0.0, le=float(MOST))]
"""A weight of a loss, or a rate."""


@dataclass(frozen=True)
class FitConfig:
    """How an ISP is fitted.

    Args:
        method: "staged" fits stage by stage and keeps encoders and masks only if held-out frames gain; it is meant for
            a handful of frames. "published" is the fit of the paper. It learns encoders and both masks end to end after
            a short start, with l2 losses on RAW and on every image between the stages of both passes, and with the
            consistency of the weights (``joint_steps``, 3,000 by default). It sets ``shading`` and ``attention`` to on,
            ``tone`` to learned, and ``encoders`` to on unless they are off. It needs two frames or more; the paper has
            5 to 320.
        start: an ISP, given by the name of a shipped one or by its file. The fit starts from its tone if that suits the
            frames better than the curves of the standards.
        size: "small" has at most 8 atoms a dictionary and narrow encoders: with encoders it has 0.12 M parameters
            instead of 0.52 M, without them about 5,000 in either case.
        atoms: largest number of atoms in each dictionary; if there are more frames, they are clustered.
        reach: gain atoms that no frame had are added, up to ``atoms`` in all: the frames' mean with red and blue gains
            multiplied and divided by this factor (the digital gain by its fourth root), so that the hull covers other
            light as well; 1 adds none.
        steps: number of refinement steps in each direction.
        pixels: number of random pixels kept of each frame.
        batch: number of pixels of each frame in a step.
        learning_rate: initial learning rate of Adam, with cosine decay to 0.
        shading: "on" fits the lens shading mask, "off" omits the stage, "auto" keeps a mask that removes
            at least half of the squared error.
        tone: "learned" is the tone network and gamma of the paper, "curve" a monotone curve as a table, the same for R,
            G and B. "auto" fits both with some of the frames held out and keeps the one that is better on those, given
            their as-shot gains; with one frame it is "learned".
        attention: fit the attention mask as well.
        encoders: "on" trains the encoders, "off" uses constant weights. "auto" trains them if there are a dozen frames
            or more, and keeps them if they beat the constants on held-out frames.
        raw_loss: loss of end-to-end training on RAW: "l2" as published, or "log", the logarithm of each frame's mean
            squared error, which weights frames as the mean of decibels does.
        encoder_steps: number of steps of the encoders' training.
        joint_steps: number of steps of a last end-to-end training of everything at once; by default 1000 with 50 frames
            or more, else 0. Its result is kept only if held-out frames improve.
        curve_steps: number of steps of the first stage, which fits the tone curve; 150 by default.
        prior_steps: number of steps of the descent on the constant weights.
        mse_floor: added to a frame's mean squared error under the logarithm, so that frames beyond 50 dB count no more.
        intermediate: weight of the loss on the images between the stages, where that on sRGB has weight 1; 0 leaves it
            out.
        consistency: factor of the losses between the weights that reverse and forward encoders choose; 0 leaves them
            out.
        noisy: fit on the captured noisy RAW of the pairs.
        seed: random seed of the pixels to draw and of the initial networks.
        isp: further keys of :class:`rawaug.isp.config.ISPConfig`, such as ``encoder_widths``.
    """

    method: Literal["staged", "published"] = "staged"
    start: str | None = None
    size: Literal["default", "small"] = "default"
    atoms: Annotated[int, Interval(ge=1, le=MOST)] = 16
    reach: Annotated[float, Interval(ge=1.0, le=float(MOST))] = 1.6
    steps: Steps = 200
    pixels: Annotated[int, Interval(ge=1, le=MOST)] = 32768
    batch: Annotated[int, Interval(ge=1, le=MOST)] = 4096
    learning_rate: Weight = 2e-3
    shading: Literal["auto", "on", "off"] = "auto"
    tone: Literal["auto", "learned", "curve"] = "learned"
    attention: bool = False
    encoders: Literal["auto", "on", "off"] = "auto"
    encoder_steps: Steps = 200
    joint_steps: Steps | None = None
    curve_steps: Steps | None = None
    prior_steps: Steps = 400
    mse_floor: Weight = 1e-5
    raw_loss: Literal["l2", "log"] = "l2"
    intermediate: Weight = 0.1
    consistency: Weight = 1.0
    noisy: bool = False
    seed: Annotated[int, Interval(ge=-(2**63), le=2**63 - 1)] = 0
    isp: dict[str, Any] = field(default_factory=dict)

    @property
    def most_atoms(self) -> int:
        """``atoms``, as far as the size allows."""
        return min(self.atoms, SMALL.colour_atoms) if self.size == "small" else self.atoms

    def settled(self) -> FitConfig:
        """The same configuration, with the settings that its method implies."""
        if self.method == "staged":
            return self

        steps = _PUBLISHED_STEPS if self.joint_steps is None else self.joint_steps
        encoders: Literal["on", "off"] = "on"
        if self.encoders == "off":
            encoders = "off"
        return replace(
            self, shading="on", attention=True, encoders=encoders, tone="learned", encoder_steps=0, joint_steps=steps
        )

    def shortest(self) -> FitConfig:
        """The same configuration, reduced to a fit that takes a second."""
        short = replace(self, steps=2, curve_steps=10, pixels=512, batch=128, prior_steps=20, encoder_steps=4)
        return replace(short, joint_steps=4) if self.method == "published" else short

    def __post_init__(self) -> None:
        require_bounds(self)
        keys = [field.name for field in fields(ISPConfig)]
        unknown = sorted(set(self.isp).difference(keys))
        if unknown:
            raise ValueError(f"isp: unknown keys {unknown}; use {keys}")
        if not any(STAGES[name].makes <= 2 for name in self.isp.get("stages", POINTWISE_STAGES)):
            raise ValueError("isp: a fit needs a stage up to x2, such as tone or gamma")
