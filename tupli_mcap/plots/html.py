"""A report as HTML that stands alone: everything from a file is escaped, and nothing is loaded or run."""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence
from html import escape

from tupli_mcap.plots.gather import Measured
from tupli_mcap.plots.style import number_text

__all__ = ["fragment", "page"]

_STYLE = """
.tupli-report{font:14px/1.45 system-ui,"DejaVu Sans",sans-serif;color:#222;background:#fff;max-width:1150px;
margin:0 auto;padding:12px}
.tupli-report h1{font-size:22px;margin:.2em 0 .5em;overflow-wrap:anywhere}
.tupli-report table{border-collapse:collapse;margin:.5em 0}
.tupli-report td,.tupli-report th{padding:1px 14px 1px 0;text-align:left;vertical-align:top;overflow-wrap:anywhere}
.tupli-report th{font-weight:normal;color:#767676}
.tupli-report .n td+td,.tupli-report .n th+th{text-align:right;font-variant-numeric:tabular-nums}
.tupli-report svg{max-width:100%;height:auto;display:block}
.tupli-report summary{cursor:pointer}
"""
_POLICY = "default-src 'none'; img-src data:; style-src 'unsafe-inline'"
_MOST_ROWS = 600


def page(title: str, body: str) -> str:
    """A document around a fragment. Its policy forbids scripts and everything from elsewhere."""
    return (
        '<!DOCTYPE html>\n<html lang="en"><head><meta charset="utf-8">'
        f'<meta http-equiv="Content-Security-Policy" content="{_POLICY}">'
        '<meta name="viewport" content="width=device-width, initial-scale=1">'
        f"<title>{_text(title)}</title></head><body>\n{body}</body></html>\n"
    )


def fragment(
    title: str, facts: Iterable[tuple[str, str]], notes: Sequence[str], svg: str, measured: Sequence[Measured]
) -> str:
    """The report without a document around it, as notebooks take it. `svg` is our own drawing."""
    rows = "".join(f"<tr><th>{_text(label)}</th><td>{_text(value)}</td></tr>" for label, value in facts)
    said = "".join(f"<li>{_text(note)}</li>" for note in notes)
    return (
        f'<div class="tupli-report"><style>{_STYLE}</style><h1>{_text(title)}</h1><table>{rows}</table>\n'
        f"{_bare(svg)}\n{f'<h2>Notes</h2><ul>{said}</ul>' if said else ''}{_numbers(measured)}</div>\n"
    )


def _bare(svg: str) -> str:
    """The svg element alone: a declaration and a doctype have no place inside a page, metadata no use."""
    element = svg[svg.index("<svg") :]
    return re.sub(r"<metadata>.*?</metadata>", "", element, count=1, flags=re.DOTALL)


def _numbers(measured: Sequence[Measured]) -> str:
    """A table of every dimension, folded."""
    rows = []
    for one in measured:
        for leaf in one.leaves:
            for i, name in enumerate(leaf.names):
                values = (leaf.mean[i], leaf.std[i], leaf.least[i], leaf.most[i])
                cells = [name if len(measured) == 1 else f"{one.name}: {name}"]
                cells += [number_text(float(v)) for v in values] + [
                    f"{leaf.nan[i]:,}",
                    f"{leaf.infinite[i]:,}",
                ]
                rows.append("<tr>" + "".join(f"<td>{_text(cell)}</td>" for cell in cells) + "</tr>")
    if not rows:
        return ""
    left = f"<p>and {len(rows) - _MOST_ROWS} more</p>" if len(rows) > _MOST_ROWS else ""
    titles = "".join(
        f"<th>{t}</th>" for t in ("dimension", "mean", "std", "smallest", "largest", "NaN", "infinite")
    )
    return (
        f'<details><summary>Numbers of each dimension</summary><table class="n"><tr>{titles}</tr>'
        f"{''.join(rows[:_MOST_ROWS])}</table>{left}</details>"
    )


def _text(text: str) -> str:
    """Escaped, without characters that change what is around them (controls, directions)."""
    return escape("".join(c if c.isprintable() else "\N{REPLACEMENT CHARACTER}" for c in text), quote=True)
