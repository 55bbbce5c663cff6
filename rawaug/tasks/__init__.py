"""Tasks: kinds of image that are denoised, each an object that says all that is special about it.

Every file here is one value, named after the key ``experiment`` of its recipes: ``raw``, ``rgb`` (networks that
demosaic, too), ``mosaic`` (any pattern) and ``srgb`` (developed pictures). A file elsewhere adds another by
``@TASKS.register("name")``.
"""
