"""The figures of the paper, for comparison with those of a run. Source: Conde et al., AAAI 2022."""

from __future__ import annotations

TABLE_1: dict[str, tuple[float, float, float, float, float]] = {
    "UPI": (36.84, 14.87, 57.10, 49.30, 0.0),
    "CycleISP": (37.62, 15.90, 51.65, 49.77, 3.14),
    "U-Net": (39.84, 20.27, 49.61, 49.69, 11.77),
    "Ours": (45.21, 21.58, 66.33, 50.02, 0.59),
}
"""On SIDD: PSNR_r in dB, its worst and best quarter, PSNR_d in dB, and millions of parameters."""
CYCLE = 37.82
"""PSNR in dB of the cycle sRGB to RAW to sRGB."""
TABLE_2: dict[str, tuple[float | None, float | None]] = {
    "UPI": (29.30, None),
    "CycleISP": (29.40, 31.71),
    "InvGrayscale": (33.34, 34.21),
    "U-Net": (38.24, 41.52),
    "InvISP": (43.29, 45.72),
    "InvISP with JPEG": (44.42, 46.78),
    "Ours": (43.62, 50.08),
}
"""On MIT-Adobe FiveK: PSNR_r in dB of the Nikon D700 and of the Canon EOS 5D."""
TABLE_3: dict[str, tuple[float, float]] = {
    "Noisy": (37.18, 0.850),
    "GLIDE": (41.87, 0.949),
    "TNRD": (42.77, 0.945),
    "KSVD": (43.26, 0.969),
    "DnCNN": (43.30, 0.965),
    "NLM": (44.06, 0.971),
    "WNNM": (44.85, 0.975),
    "BM3D": (45.52, 0.980),
    "Ours-u": (49.90, 0.982),
    "DHDN": (52.02, 0.988),
    "Ours-f": (52.05, 0.986),
    "CycleISP": (52.38, 0.990),
    "Ours": (52.48, 0.990),
}
"""On SIDD: PSNR in dB and SSIM."""
ABLATION = {
    "UV": {"x2 gamma": 36.21, "x3 colour": 43.34, "x4 gains": 47.59},
    "Y": {"x4 gains": 39.91, "x5 shading": 51.24},
}
"""PSNR in dB against RAW after a stage, in chrominance and luminance, as far as the text states it."""

ISP_NAMES = {
    "upi-tuned": "UPI",
    "cycleisp": "CycleISP",
    "unet": "U-Net",
    "invgrey": "InvGrayscale",
    "invisp": "InvISP",
    "invisp-jpeg": "InvISP with JPEG",
    "dictionary-encoders": "Ours",
}
"""The paper's names of the reconstruction tables' rows, by ours. Its UPI is tuned to the data by hand."""
DENOISER_NAMES = {
    "GLIDE": "GLIDE",
    "KSVD": "KSVD",
    "WNNM": "WNNM",
    "BM3D": "BM3D",
    "NonLocalMeans": "NLM",
    "tnrd": "TNRD",
    "dncnn": "DnCNN",
    "dhdn": "DHDN",
    "cycleisp": "CycleISP",
    "ours": "Ours",
    "ours_f": "Ours-f",
    "ours_u": "Ours-u",
}
"""The paper's names of the denoising table's rows, by those of filters and arms."""
