"""Noise that real sensors make: models, published levels, the estimate of a camera's own, and stabilisation."""

from rawaug.noise.by_name import NoiseSpec, camera_names, noise_levels, noise_model, noise_names
from rawaug.noise.calibrated import CalibratedNoise, ScaledLevels
from rawaug.noise.compose import Compose, EldNoise, SensorNoise
from rawaug.noise.dark import DarkNoise, from_dark_frames
from rawaug.noise.estimate import NoiseEstimate, NoisePoints, estimate_noise
from rawaug.noise.figure import plot_noise
from rawaug.noise.iso import EldLevels, PmridLevels, SiddLevels
from rawaug.noise.levels import FixedLevels, NoiseLevels, Preset
from rawaug.noise.measured import IsoLevel, MeasuredLevels, MeasuredNoise, camera_law
from rawaug.noise.models import NoiseModel, Params, PoissonGaussianNoise, ShotReadModel, ShotReadNoise
from rawaug.noise.sensor import BlackOffset, ColourBias, DefectPixels, Quantisation, RowNoise, TukeyLambdaNoise

__all__ = [
    "BlackOffset",
    "CalibratedNoise",
    "ColourBias",
    "Compose",
    "DarkNoise",
    "DefectPixels",
    "EldLevels",
    "EldNoise",
    "FixedLevels",
    "IsoLevel",
    "MeasuredLevels",
    "MeasuredNoise",
    "NoiseEstimate",
    "NoiseLevels",
    "NoiseModel",
    "NoisePoints",
    "NoiseSpec",
    "Params",
    "PmridLevels",
    "PoissonGaussianNoise",
    "Preset",
    "Quantisation",
    "RowNoise",
    "ScaledLevels",
    "SensorNoise",
    "ShotReadModel",
    "ShotReadNoise",
    "SiddLevels",
    "TukeyLambdaNoise",
    "camera_law",
    "camera_names",
    "estimate_noise",
    "from_dark_frames",
    "noise_levels",
    "noise_model",
    "noise_names",
    "plot_noise",
]
