"""A drawing of the layers that imports go down, made from those in pyproject.toml."""

from __future__ import annotations

import html
import importlib
import tomllib
from pathlib import Path

ROOT = Path(__file__).parents[2]
_LINE, _WIDTH = 30, 800


def layers() -> str:
    """The layers from the top to the bottom, each room with the first sentence of its door, as SVG in HTML."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))
    contract = project["tool"]["importlinter"]["contracts"][0]
    rows, y = [], 0
    for i, layer in enumerate(contract["layers"]):
        rooms = [name.strip() for name in layer.split("|")]
        height = _LINE * len(rooms)
        rows.append(
            f'<rect x="0" y="{y}" width="{_WIDTH}" height="{height - 3}" rx="4" class="layer-{i % 2}"/>'
        )
        for j, room in enumerate(rooms):
            base = y + _LINE * j + 19
            rows.append(f'<text x="12" y="{base}" class="room">{room.removeprefix("tupli_mcap.")}</text>')
            rows.append(f'<text x="150" y="{base}">{html.escape(_sentence(room))}</text>')
        y += height
    drawing = (
        f'<svg viewBox="0 0 {_WIDTH} {y}" class="house" role="img" aria-label="Layers">{"".join(rows)}</svg>'
    )
    return f'```{{raw}} html\n<div class="house">{drawing}</div>\n```'


def _sentence(room: str) -> str:
    text = " ".join((importlib.import_module(room).__doc__ or "").split("\n\n")[0].split())
    text = text.replace("`", "")
    return text if len(text) <= 92 else text[: text.rfind(" ", 0, 90)] + " …"
