"""Turn noisy RAW into clean RAW: denoisers by any name, the noise levels that they are given, frames and files."""
