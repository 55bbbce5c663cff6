"""Fitting of a camera's ISP, and training of a RAW denoiser with clean targets or on noisy frames alone."""
