"""The texts of a report: its title, facts and notes, as texts, as panels, and as self-contained HTML."""

from __future__ import annotations

import re
import textwrap
from collections.abc import Sequence
from html import escape
from typing import Any

import numpy as np

from tupli_mcap.arrays import Array
from tupli_mcap.errors import bytes_of, plural
from tupli_mcap.messages.episodes import END_NAMES
from tupli_mcap.plots import style
from tupli_mcap.plots.groups import Group
from tupli_mcap.plots.measure import SUCCESS, Measured
from tupli_mcap.plots.style import Cell, Page, cut
from tupli_mcap.recording.describe.description import RecordingDescription, nan_text, spread_of
from tupli_mcap.schema.times import local_text

_MOST_SEEDS, _LONGEST_SEEDS = 6, 56  # that are listed; characters
_MOST_LISTED = 12  # recordings
_HEAD, _LINE = 0.25, 0.175  # inches
_VALUE = 56  # characters of a fact in two columns
_STYLE = """
.tupli-report{font:14px/1.45 system-ui,"DejaVu Sans",sans-serif;color:#222;background:#fff;max-width:1150px;
margin:0 auto;padding:12px}
.tupli-report h1{font-size:22px;margin:.2em 0 .5em;overflow-wrap:anywhere}
.tupli-report table{border-collapse:collapse;margin:.5em 0;color:#222}
.tupli-report tr{background:none!important}
.tupli-report td,.tupli-report th{padding:1px 14px 1px 0;text-align:left!important;vertical-align:top;
overflow-wrap:anywhere}
.tupli-report th{font-weight:normal;color:#767676;min-width:5.5em}
.tupli-report th i{display:inline-block;width:1.3em;height:.25em;margin-right:.6em;vertical-align:middle}
.tupli-report .n td+td,.tupli-report .n th+th{text-align:right!important;font-variant-numeric:tabular-nums}
.tupli-report svg{max-width:100%;height:auto;display:block} .tupli-report summary{cursor:pointer}
"""
_POLICY = "default-src 'none'; img-src data:; style-src 'unsafe-inline'"
_MOST_ROWS = 600  # of the table of numbers


def title_of(measured: Sequence[Measured]) -> str:
    """The environment, and the recording or how many there are."""
    environments = {one.facts.environment or "" for one in measured}
    parts = [*environments] if len(environments) == 1 else []
    files = len({one.facts.name for one in measured})
    parts += [f"{files} recordings" if files > 1 else f"{len(measured)} runs"] if len(measured) > 1 else []
    return ": ".join(filter(None, parts)) or measured[0].name


def facts_of(groups: Sequence[Group]) -> list[tuple[str, str]]:
    """Labels and values: of one recording all there is to say, of several a line for each group."""
    recordings = [one for group in groups for one in group.recordings]
    if len(recordings) > 1:
        return [(group.name, _group_text(group)) for group in groups]
    (one,) = recordings
    about, rows = one.facts, one.rows
    chosen = "" if len(rows) == len(one.index) else f" of {len(one.index):,}"
    counts = np.bincount(rows["end"], minlength=len(END_NAMES))
    ends = ", ".join(f"{count:,} {name}" for count, name in zip(counts, END_NAMES, strict=True) if count)
    found = {
        "recording": one.name + ("" if about.state == "complete" else f" ({about.state})"),
        **_run_facts(about),
        "environment": (about.environment or "none attached")
        + (f", {about.num_envs} sub-environments" if about.num_envs > 1 else ""),
        "recorded": _times_text(one),
        "size": bytes_of(about.size),
        "episodes": f"{len(rows):,}{chosen}{f' ({ends})' if ends else ''}",
        "steps": f"{one.steps:,}",
        "return": _spread_text(rows["return"]),
        "length": _spread_text(rows["length"]),
        "success": _success_text(groups[0]),
        "seeds": _seeds_text(one.seeds),
        "benchmark": about.benchmark_id[:12] or "none",
        "observation": _space_text(about.observation),
        "action": _space_text(about.action),
    }
    return [(label, value) for label, value in found.items() if value]


def _run_facts(about: RecordingDescription) -> dict[str, str]:
    """The run's name, split and settings; of several, their names."""
    if len(about.runs) > 1:
        return {"runs": ", ".join(str(run["name"]) for run in about.runs)}
    split, settings = about.run.get("split", ""), about.run.get("metadata", {})
    return {
        "run": about.run.get("name", "") + (f" ({split})" if split else ""),
        "settings": ", ".join(f"{key}={value!s:.{_VALUE}}" for key, value in settings.items()),
    }


def _group_text(group: Group) -> str:
    spread, success = _spread_text(group.rows["return"]), _success_text(group)
    parts = [plural(len(group.runs), "run")] if len(group.runs) > 1 else []
    parts += [plural(len(group.rows), "episode"), plural(int(group.rows["length"].sum()), "step")]
    parts += [f"return {spread}"] if spread else []
    return ", ".join([*parts, *([f"success {success}"] if success else [])])


def _success_text(group: Group) -> str:
    said = group.numbers(SUCCESS)
    known = said[np.isfinite(said)]
    of = f" of {len(known):,}" if len(known) < len(said) else ""
    return f"{known.mean():.0%}{of}" if len(known) else ""


def _space_text(lines: Sequence[str]) -> str:
    """As many of `space_lines` as have room."""
    return textwrap.shorten(", ".join(lines), _VALUE, placeholder=" …") or "not known before the first step"


def notes_of(measured: Sequence[Measured]) -> list[str]:
    """Sentences, each once; one that is not about all recordings begins with the name of its own."""
    each = [(f"{one.name}: ", one.notes()) for one in measured]
    shared = [note for note in each[0][1] if all(note in notes for _, notes in each)]
    own = [prefix + note for prefix, notes in each for note in notes if note not in shared]
    return list(dict.fromkeys([*shared, *own]))


def _spread_text(values: Array) -> str:
    """Mean, standard deviation and range of the finite values; empty if they are all infinite."""
    bounded = values[~np.isinf(values)]
    spread = spread_of(bounded)
    if spread is None:
        return ""
    if np.isnan(spread.mean):
        return nan_text(spread.nan, len(values))
    mean, std, least, most = map(style.number_text, spread[:4])
    return mean if len(bounded) - spread.nan == 1 else f"{mean} ± {std}, from {least} to {most}"


def _seeds_text(seeds: Sequence[int]) -> str:
    listed = ", ".join(map(str, seeds))
    if len(seeds) <= _MOST_SEEDS and len(listed) <= _LONGEST_SEEDS:
        return listed or "none known"
    return f"{len(seeds):,} from {style.seed_text(seeds[0])} to {style.seed_text(seeds[-1])}"


def _times_text(one: Measured) -> str:
    """When it was recorded, and how long that took."""
    start = int(one.rows["start_time"].min()) if len(one.rows) else one.facts.created_ns
    if start <= 0:
        return "at an unknown time"
    text = local_text(start)
    if not len(one.rows):
        return text
    seconds = (int(one.rows["end_time"].max()) - start) / 1e9
    unit, size = ("h", 3600) if seconds >= 7200 else ("min", 60) if seconds >= 120 else ("s", 1)
    return f"{text}, {seconds / size:.1f} {unit}"


def add_facts(page: Page, title: str, facts: Sequence[tuple[str, str]], *, several: bool) -> None:
    """The title and the facts: of one recording in two columns, of several a line in the colour of each group."""
    shades = style.colours(len(facts)) if several else []
    if several and len(facts) > _MOST_LISTED:
        facts = [*facts[:_MOST_LISTED], ("…", f"and {len(facts) - _MOST_LISTED:,} more")]
    lines = len(facts) if several else -(-len(facts) // 2)
    height = _HEAD + _LINE * lines

    def draw(axes: Any) -> None:
        axes.set_axis_off()
        axes.set(xlim=(0, 9.5), ylim=(height, 0))
        axes.text(0, 0.0, cut(title, 80), fontsize=13, fontweight="bold", va="center")
        for i, (label, value) in enumerate(facts):
            x, y = 4.9 * (i // lines), 0.32 + _LINE * (i % lines)
            if i < len(shades):
                axes.plot([x + 0.02, x + 0.2], [y, y], color=shades[i], linewidth=2.5)
                x += 0.28
            axes.text(x, y, cut(label, 34), color=style.INK if several else style.GREY, va="center")
            axes.text(x + (2.4 if several else 0.85), y, cut(value, 110 if several else _VALUE), va="center")

    page.add([Cell(draw, height, left=0, right=0)], 1, tight=True)


def add_notes(page: Page, notes: Sequence[str]) -> None:
    """The notes, in lines; nothing without any."""
    if notes:
        page.heading("Notes")
        page.text(notes)


def html_page(title: str, body: str) -> str:
    """A document around a fragment. Its policy forbids scripts and everything from elsewhere."""
    return (
        '<!DOCTYPE html>\n<html lang="en"><head><meta charset="utf-8">'
        f'<meta http-equiv="Content-Security-Policy" content="{_POLICY}">'
        '<meta name="viewport" content="width=device-width, initial-scale=1">'
        f"<title>{_text(title)}</title></head><body>\n{body}</body></html>\n"
    )


def html_fragment(
    title: str, facts: Sequence[tuple[str, str]], notes: Sequence[str], svg: str, measured: Sequence[Measured]
) -> str:
    """The report without a document around it, as notebooks take it; all texts escaped. `svg` is our own drawing.

    Its tables look the same in every notebook: a dark one would paint their rows, and set their cells to the right.
    """
    # A declaration and a doctype have no place inside a page, metadata no use.
    element = re.sub(r"<metadata>.*?</metadata>", "", svg[svg.index("<svg") :], count=1, flags=re.DOTALL)
    shades = style.colours(len(facts)) if len(measured) > 1 else [""] * len(facts)
    rows = "".join(
        f"<tr><th>{_mark(shade)}{_text(label)}</th><td>{_text(value)}</td></tr>"
        for shade, (label, value) in zip(shades, facts, strict=True)
    )
    said = "".join(f"<li>{_text(note)}</li>" for note in notes)
    return (
        f'<div class="tupli-report"><style>{_STYLE}</style><h1>{_text(title)}</h1><table>{rows}</table>\n'
        f"{element}\n{f'<h2>Notes</h2><ul>{said}</ul>' if said else ''}{_numbers(measured)}</div>\n"
    )


def _mark(colour: str) -> str:
    """The line in the colour of a group before its name; nothing without a colour."""
    return colour and f'<i style="background:{colour}"></i>'


def _numbers(measured: Sequence[Measured]) -> str:
    """A table of every dimension, folded."""
    rows = []
    for one in measured:
        prefix = f"{one.name}: " if len(measured) > 1 else ""
        for leaf in one.leaves:
            for name, *numbers, nan, infinite in zip(
                leaf.names, leaf.mean, leaf.std, leaf.least, leaf.most, leaf.nan, leaf.infinite, strict=True
            ):
                cells = [prefix + name, *map(style.number_text, numbers), f"{nan:,}", f"{infinite:,}"]
                rows.append("".join(f"<td>{_text(cell)}</td>" for cell in cells))
    if not rows:
        return ""
    titles = ("dimension", "mean", "std", "smallest", "largest", "NaN", "infinite")
    rows.insert(0, "".join(f"<th>{title}</th>" for title in titles))
    table = "".join(f"<tr>{row}</tr>" for row in rows[: _MOST_ROWS + 1])
    left = len(rows) - 1 - _MOST_ROWS
    more = f"<p>and {left} more</p>" if left > 0 else ""
    return f'<details><summary>Numbers of each dimension</summary><table class="n">{table}</table>{more}</details>'


def _text(text: str) -> str:
    """Escaped, without characters that change what is around them (controls, directions)."""
    return escape("".join(c if c.isprintable() else "\N{REPLACEMENT CHARACTER}" for c in text), quote=True)
