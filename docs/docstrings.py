"""Docstrings as the site's Markdown: sections called Example, roles and formulas are reStructuredText in the source.

Formulas become MathML, which browsers draw without a script.
"""

from __future__ import annotations

import re
from typing import Any

import griffe
from latex2mathml.converter import convert

_ROLE = re.compile(r":(?:class|func|meth|mod|data|attr):`~?([^`]+)`")
_INLINE = re.compile(r":math:`([^`]+)`")
_FORMULA = re.compile(r"\.\. math::[ ]?(.*?)(?=\n\s*\n|\Z)", re.DOTALL)


class Markdown(griffe.Extension):
    """Rewrites each docstring before it is parsed."""

    def on_instance(self, *, obj: griffe.Object, **_: Any) -> None:
        """``Example:`` is a section of code, a role is code, a formula is MathML."""
        if obj.docstring is not None:
            text = re.sub(r"^(\s*)Example:$", r"\1Examples:", obj.docstring.value, flags=re.MULTILINE)
            text = _ROLE.sub(r"`\1`", text)
            text = _INLINE.sub(lambda found: convert(found[1]), text)
            obj.docstring.value = _FORMULA.sub(lambda found: f"{convert(_one_line(found[1]), display='block')}\n", text)


def _one_line(tex: str) -> str:
    """On one line, with the space after a logarithm that TeX sets by itself."""
    return re.sub(r"\\(log|ln) (?=\\)", r"\\\1\\, ", " ".join(tex.split()))
