"""An ISP's configuration, the setting of a picture, and the result of a pass."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Annotated, Any, NamedTuple, TypedDict

from annotated_types import Interval
from torch import Tensor

from rawaug.bayer import CFA
from rawaug.registry import require_between, require_bounds

HIGHLIGHT_KNEE = 0.9
"""The mean linear value above which Brooks' inverse gains bend towards 1."""

# More are refused before anything is built: a few bytes of a file can ask for any amount of memory.
MOST_ATOMS, MOST_CAMERAS, MOST_FEATURES = 1024, 2**14, 256

POINTWISE_STAGES = ("tone", "gamma", "colour", "gains", "shading")
"""The stages of the paper between sRGB and the mosaic, in reverse order; the k-th makes x_k."""


@dataclass(frozen=True)
class ISPConfig:
    """Configuration of a :class:`DictionaryISP`, stored in the header of its file.

    Args:
        colour_atoms: N, the number of colour correction matrices in the dictionary.
        gain_atoms: M, the number of triplets of gains in the dictionary.
        encoder_widths: features of the encoders' three convolutions.
        cfa: pattern of the RAW it makes.
        stages: the stages in reverse order, from ``tone gamma colour gains shading`` and whatever else is registered in
            :data:`rawaug.isp.stages.STAGES`; ``curve`` replaces ``tone gamma``.
        encoders: whether encoders look at the picture; if not, there are only learned constant weights.
        attention: whether the shading stage has its attention mask.
        knee: value above which Brooks' inverse gains start to spare highlights; null to divide each channel by its gain
            alone.
        tone_atoms: K, the number of inverse tone curves in the dictionary of the stage ``curve``; 0 without it.
        cameras: P, the number of published cameras that are mixtures of the colour atoms, whose gains follow from the
            light; 0 if the atoms are fitted.
    """

    colour_atoms: Annotated[int, Interval(ge=1, le=MOST_ATOMS)] = 16
    gain_atoms: Annotated[int, Interval(ge=1, le=MOST_ATOMS)] = 16
    encoder_widths: tuple[int, int, int] = (32, 64, 160)
    cfa: str = "RGGB"
    stages: tuple[str, ...] = POINTWISE_STAGES
    encoders: bool = False
    attention: bool = True
    knee: Annotated[float, Interval(ge=0.0, le=0.999)] | None = HIGHLIGHT_KNEE
    tone_atoms: Annotated[int, Interval(ge=0, le=MOST_ATOMS)] = 0
    cameras: Annotated[int, Interval(ge=0, le=MOST_CAMERAS)] = 0

    def __post_init__(self) -> None:
        CFA(self.cfa)  # raises ValueError for an unknown pattern

        for key in ("stages", "encoder_widths"):
            values = getattr(self, key)
            if not isinstance(values, (tuple, list)):  # a recipe or a file gives lists
                raise ValueError(f"{key} must be a list, got {values!r:.100}")
            object.__setattr__(self, key, tuple(values))

        for key in ("encoders", "attention"):
            flag = getattr(self, key)
            if not isinstance(flag, bool):
                raise ValueError(f"{key} must be true or false, got {flag!r:.100}")

        require_bounds(self)
        if len(self.encoder_widths) != 3:
            raise ValueError(f"encoder_widths must be three numbers, got {self.encoder_widths!r:.100}")
        for width in self.encoder_widths:
            require_between("encoder_widths", width, 1, MOST_FEATURES)

        are_names = all(isinstance(stage, str) for stage in self.stages)
        if not self.stages or not are_names or len({*self.stages}) < len(self.stages):
            raise ValueError(f"stages must be one or more names, each at most once, got {self.stages!r:.100}")
        if (self.tone_atoms > 0) != ("curve" in self.stages):
            raise ValueError(f"tone_atoms must be at least 1 with the stage curve and 0 without, got {self.tone_atoms}")


SMALL = ISPConfig(colour_atoms=8, gain_atoms=8, encoder_widths=(16, 32, 64))
"""The size with at most 0.2 M parameters."""


class ISPInfo(TypedDict, total=False):
    """What the file of an ISP says of itself, in plain values; whatever does not apply is left out.

    Args:
        frames: names of the frames that it was fitted to.
        data: the folders or data sets of these frames, as they were given.
        registered: number of frames whose picture and mosaic agree pixel by pixel.
        unreadable: a line for each frame that could not be read.
        steps, seed, seconds: the settings and the duration of the fit.
        key: a hash of everything that an ISP in a recipe was made of.
        rendering: what the pictures of the pairs are.
        started_from: name of the camera whose figures the fit started from.
        curve_gain_db: by how many dB a tone curve is better than a learned tone, where both were compared.
        encoders_gain_db: by how many dB encoders are better than constants on frames left out.
        joint: end-to-end training: ``steps``, ``kept_step``, ``gain_db`` and the ``curve`` of its score.
        gain_errors: the covariances S_e and S_n of :mod:`rawaug.isp.fusion`, two 3 x 3 matrices.
        held_out: PSNR_r on the held-out frames in the course of the fit, ``blind`` and ``as_shot``.
        noise: the noise of the camera, as :func:`rawaug.noise.noise_model` takes it.
        noise_not_measured: the reason, if it could not be measured.
        blur: standard deviation in pixels of the blur of the frames.
        cameras: names of the colour atoms, of an ISP of known cameras.
        own_cameras: the figures of the data sheets that it was made of, as :meth:`rawaug.Camera.from_json` takes them.
        tones: names of the tone curves.
        pattern: the pattern of the sensor, if it is not Bayer's.
        holds: share of all cameras, gains and curves that the atoms' hulls hold within 45 dB.
    """

    frames: list[str]
    data: list[str]
    registered: int
    unreadable: list[str]
    steps: int
    seed: int
    seconds: float
    key: str
    rendering: str
    started_from: str
    curve_gain_db: float
    encoders_gain_db: float
    joint: dict[str, Any]
    gain_errors: list[list[list[float]]]
    held_out: list[dict[str, float]]
    noise: dict[str, Any]
    noise_not_measured: str
    blur: float
    cameras: list[str]
    own_cameras: list[dict[str, Any]]
    tones: list[str]
    pattern: str
    holds: dict[str, float]


class ISPParams(NamedTuple):
    """The camera settings of B pictures; with them a pass can be repeated.

    Args:
        colour_weights: ``(B, N)`` weights of the colour atoms.
        gain_weights: ``(B, M)`` weights of the gain atoms; ``(B, 0)`` if the gains follow from a light.
        matrix: ``(B, 3, 3)`` sRGB to camera.
        gains: ``(B, 3)`` white balance times digital gain, forward direction.
        tone_weights: ``(B, K)`` weights of the tone curves; ``(B, 0)`` if the tone is learned.
    """

    colour_weights: Tensor
    gain_weights: Tensor
    matrix: Tensor
    gains: Tensor
    tone_weights: Tensor

    def map(self, change: Callable[[Tensor], Tensor]) -> ISPParams:
        """Apply a function to every tensor."""
        return ISPParams(*map(change, self))


@dataclass
class ISPResult:
    """The result of a pass.

    Args:
        image: the mosaic ``(B, 1, H, W)`` or the picture ``(B, 3, H, W)``, also called ``raw`` and ``srgb``.
        params: the settings that were used; with them the pass can be repeated.
        intermediates: x1 ... x5 by name, if they were requested.
    """

    image: Tensor
    params: ISPParams
    intermediates: dict[str, Tensor] = field(default_factory=dict)

    @property
    def raw(self) -> Tensor:
        """The mosaic ``(B, 1, H, W)`` of a reverse pass."""
        return self.image

    @property
    def srgb(self) -> Tensor:
        """The picture ``(B, 3, H, W)`` of a forward pass."""
        return self.image
