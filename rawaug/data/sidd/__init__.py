"""The Smartphone Image Denoising Dataset: frames, blocks and submissions."""
