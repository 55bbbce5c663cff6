"""The pages of the model cards, docs/cards: each includes the card that lies beside its weights.

    python .ci/cards.py

``make docs`` runs it first. A file of weights without a card stops it.
"""

from __future__ import annotations

from pathlib import Path

ROOT = Path(__file__).parents[1]


def pages() -> dict[str, str]:
    """The content of each page, by its name: a line that includes the card."""
    contents = {}
    for folder in ("denoisers/weights", "rawaug/weights"):
        for weights in sorted((ROOT / folder).glob("*.safetensors")):
            card = weights.with_suffix(".md")
            if not card.is_file():
                raise FileNotFoundError(f"{folder}/{weights.name} has no card: write {card.name} beside it")
            contents[card.name] = f'--8<-- "{folder}/{card.name}"\n'
    return contents


if __name__ == "__main__":
    for name, content in pages().items():
        (ROOT / "docs" / "cards" / name).write_text(content, encoding="utf-8")
