"""Docstrings as the site's Markdown: sections called Example, roles and formulas are reStructuredText in the source."""

from __future__ import annotations

import re
from typing import Any

import griffe

_ROLE = re.compile(r":(?:class|func|meth|mod|data|attr):`~?([^`]+)`")
_FORMULA = re.compile(r"\.\. math::[ ]?(.*?)(?=\n\s*\n|\Z)", re.DOTALL)


class Markdown(griffe.Extension):
    """Rewrites each docstring before it is parsed."""

    def on_instance(self, *, obj: griffe.Object, **_: Any) -> None:
        """``Example:`` is a section of code, a role is code, a formula is a block."""
        if obj.docstring is not None:
            text = re.sub(r"^(\s*)Example:$", r"\1Examples:", obj.docstring.value, flags=re.MULTILINE)
            text = _ROLE.sub(r"`\1`", text)
            obj.docstring.value = _FORMULA.sub(lambda found: f"```tex\n{found[1].strip()}\n```", text)
