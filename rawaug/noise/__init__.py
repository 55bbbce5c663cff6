"""Noise that real sensors make: models, published levels, the estimate of a camera's own, and stabilisation."""

from rawaug.noise.cameras import (
    CalibratedNoise,
    IsoLevel,
    MeasuredLevels,
    MeasuredNoise,
    NoiseSpec,
    ScaledLevels,
    camera_law,
    camera_names,
    noise_levels,
    noise_model,
    noise_names,
)
from rawaug.noise.estimate import (
    DarkNoise,
    NoiseEstimate,
    NoisePoints,
    estimate_noise,
    from_dark_frames,
    own_noise,
    own_noise_share,
    plot_noise,
)
from rawaug.noise.levels import EldLevels, FixedLevels, Iso, NoiseLevels, PmridLevels, Preset, SiddLevels
from rawaug.noise.models import NoiseModel, Params, PoissonGaussianNoise, ShotReadModel, ShotReadNoise
from rawaug.noise.sensor import (
    BlackOffset,
    ColourBias,
    ColumnNoise,
    Compose,
    DarkFrames,
    DefectPixels,
    EldNoise,
    GreenImbalance,
    Quantisation,
    RowNoise,
    SensorNoise,
    TukeyLambdaNoise,
)

__all__ = [
    "BlackOffset", "CalibratedNoise", "ColourBias", "ColumnNoise", "Compose", "DarkFrames", "DarkNoise",
    "DefectPixels", "EldLevels", "EldNoise", "FixedLevels", "GreenImbalance", "Iso", "IsoLevel", "MeasuredLevels",
    "MeasuredNoise", "NoiseEstimate", "NoiseLevels", "NoiseModel", "NoisePoints", "NoiseSpec", "Params",
    "PmridLevels", "PoissonGaussianNoise", "Preset", "Quantisation", "RowNoise", "ScaledLevels", "SensorNoise",
    "ShotReadModel", "ShotReadNoise", "SiddLevels", "TukeyLambdaNoise", "camera_law", "camera_names",
    "estimate_noise", "from_dark_frames", "noise_levels", "noise_model", "noise_names", "own_noise",
    "own_noise_share", "plot_noise",
]  # fmt: skip
