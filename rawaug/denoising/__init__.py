"""What makes clean RAW of noisy RAW: denoisers by any name, the levels that they are told, frames and files."""
