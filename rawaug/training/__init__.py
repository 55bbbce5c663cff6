"""Fitting a camera's ISP, and training a RAW denoiser, with clean targets or from noisy frames alone."""
