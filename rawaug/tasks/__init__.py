"""Tasks: kinds of image that are denoised, each as an object that holds everything special about it.

Every file here is one value of the key ``experiment`` in recipes, and has its name: ``raw``, ``rgb`` (networks that
also demosaic), ``mosaic`` (any pattern) and ``srgb`` (developed pictures). A file elsewhere adds another by
``@TASKS.register("name")``.
"""
