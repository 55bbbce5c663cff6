"""The noise of real sensors: models, published levels, and estimation from a camera's own files."""

from rawaug.noise.calibrated import CalibratedNoise
from rawaug.noise.effects import (
    BlackOffset,
    ColourBias,
    ColumnNoise,
    DefectPixels,
    GreenImbalance,
    Quantisation,
    RowNoise,
    TukeyLambdaNoise,
)
from rawaug.noise.estimate import (
    NoiseEstimate,
    estimate_dark_noise,
    estimate_noise,
    own_noise,
    own_noise_share,
    plot_noise,
)
from rawaug.noise.levels import EldLevels, FixedLevels, Iso, NoiseLevels, PmridLevels, Preset
from rawaug.noise.measured import IsoLevel, MeasuredLevels, camera_law, sidd_levels
from rawaug.noise.models import NOISE, NoiseModel, Params, PoissonGaussianNoise, ShotReadModel, ShotReadNoise
from rawaug.noise.names import NoiseSpec, camera_laws, camera_names, noise_levels, noise_model, noise_names
from rawaug.noise.sensor import Compose, EldNoise, SensorNoise

__all__ = [
    "NOISE", "BlackOffset", "CalibratedNoise", "ColourBias", "ColumnNoise", "Compose", "DefectPixels", "EldLevels",
    "EldNoise", "FixedLevels", "GreenImbalance", "Iso", "IsoLevel", "MeasuredLevels", "NoiseEstimate",
    "NoiseLevels", "NoiseModel", "NoiseSpec", "Params", "PmridLevels", "PoissonGaussianNoise", "Preset",
    "Quantisation", "RowNoise", "SensorNoise", "ShotReadModel", "ShotReadNoise", "TukeyLambdaNoise",
    "camera_law", "camera_laws", "camera_names", "estimate_dark_noise", "estimate_noise", "noise_levels", "noise_model",
    "noise_names", "own_noise", "own_noise_share", "plot_noise", "sidd_levels",
]  # fmt: skip
