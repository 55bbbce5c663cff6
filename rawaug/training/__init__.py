"""Training a RAW denoiser, with clean targets or from noisy frames alone."""
