"""A page on your own machine that shows what pictures become as RAW of a camera."""
