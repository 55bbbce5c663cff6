"""A page on your own machine that shows what pictures become as RAW of a camera.

:mod:`rawaug.explore.views` makes pictures of settings, without knowing of a page; :mod:`rawaug.explore.page`
lays them out with Gradio, which the extra ``[explore]`` installs.
"""
