"""Built-in data: photographs and dead leaves, developed and captured by a known camera."""
