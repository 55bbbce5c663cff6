"""Cameras: their matrices, names and lights, and cameras of the user's own."""
