"""What ``rawaug run`` does with a recipe.

``recipe`` finds and reads the file, ``settings`` has its keys, ``data`` opens its frames, ``run`` fits, trains and
scores, and ``report`` writes tables and the page. A ``task`` is whatever differs between kinds of image: ``raw``,
``full_colour`` (networks that also demosaic, and networks for any mosaic) and ``srgb`` (developed pictures). A file
elsewhere adds another one by ``@TASKS.register("name")``.
"""
