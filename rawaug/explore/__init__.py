"""A page on your own machine that shows pictures as RAW of a camera."""
