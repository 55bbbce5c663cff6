"""Panels as HTML: pictures inside of it as data, so that the page loads nothing else."""

from __future__ import annotations

import base64
import html
import io
import re
from collections.abc import Sequence

import numpy as np

from rawaug.explore.views import Panel
from rawaug.extras import extra

STYLE = """
.panels {display: grid; grid-template-columns: repeat(auto-fit, minmax(min(100%, 240px), 1fr)); gap: 12px}
.panels figure {margin: 0; min-width: 0}
.panels img {width: 100%; height: auto; display: block; border-radius: 4px}
.panels figcaption {font-size: 13px; line-height: 1.4; padding: 4px 0; overflow-wrap: anywhere}
.panels .number {white-space: nowrap}
#message:not(:has(.message)) {display: none}
.message {border: 1px solid #c0392b; border-radius: 4px; padding: 8px 12px; overflow-wrap: anywhere}
#controls {max-width: 420px}
#views {min-width: 0 !important}
@media (max-width: 768px) {
  #layout {flex-direction: column-reverse; align-items: stretch}
  #controls, #views {max-width: none; width: 100%; flex: none}
}
"""


def as_html(panels: Sequence[Panel]) -> str:
    """A grid of pictures with their titles."""
    figures = "".join(
        f'<figure><img src="{data_url(panel.image)}" alt="{html.escape(panel.title)}">'
        f"<figcaption>{_caption(panel.title)}</figcaption></figure>"
        for panel in panels
    )
    return f'<div class="panels">{figures}</div>'


def _caption(title: str) -> str:
    """The title; numbers such as 2.9e-03 stay on one line."""
    return re.sub(r"\S+e-\d+", r'<span class="number">\g<0></span>', html.escape(title))


def message(text: str) -> str:
    """What went wrong, or nothing."""
    return f'<div class="message" role="alert">{html.escape(text)}</div>' if text else ""


def data_url(image: np.ndarray) -> str:
    """uint8 ``(H, W, 3)`` as a JPEG of full colour resolution: noise stays noise."""
    with extra("explore"):
        from PIL import Image

    content = io.BytesIO()
    Image.fromarray(image).save(content, "JPEG", quality=92, subsampling=0)
    return f"data:image/jpeg;base64,{base64.b64encode(content.getvalue()).decode()}"
