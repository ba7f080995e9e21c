"""Datasets as text and as HTML."""

from __future__ import annotations

import html as _html
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

from tupli_mcap.errors import plural
from tupli_mcap.schema import BaseFilter, EpisodeHeader

_ROWS = 20
_WIDTH = 100


class Facts(NamedTuple):
    """Known facts about a dataset; `headers`, and `steps` after the filter of steps, are None before they are read."""

    source: str
    headers: Sequence[EpisodeHeader] | None
    steps: int | None
    filters: Mapping[str, Any]


def text(name: str, facts: Facts) -> str:
    """One line; reads nothing."""
    return f"<{name} of {facts.source}: {'; '.join([_counts(facts), *_filters(facts)])}>"


def html(name: str, facts: Facts) -> str:
    """A caption and a table of the first episodes."""
    headers = facts.headers or []
    titles = ("", "steps", "return", "end", "seed", "metadata", "run", "recording")
    head = "".join(f"<th>{title}</th>" for title in titles)
    rows = "".join(_row(i, header) for i, header in enumerate(headers[:_ROWS]))
    more = f"<p>… {len(headers) - _ROWS:,} more</p>" if len(headers) > _ROWS else ""
    caption = _html.escape("; ".join([f"{name} of {facts.source}", _counts(facts), *_filters(facts)]))
    return f"<p>{caption}</p><table><thead><tr>{head}</tr></thead><tbody>{rows}</tbody></table>{more}"


def _counts(facts: Facts) -> str:
    if facts.headers is None:
        return "not listed yet"
    listed = sum(header.n_tuples for header in facts.headers)
    episodes = plural(len(facts.headers), "episode")
    if facts.filters.get("steps") is None:
        return f"{episodes}, {plural(listed, 'step')}"
    if facts.steps is None:
        return f"{episodes}, {plural(listed, 'step')} before the filter of steps"
    return f"{episodes}, {facts.steps:,} of {plural(listed, 'step')}"


def _filters(facts: Facts) -> list[str]:
    return [f"{what} where {_filter(test)}" for what, test in facts.filters.items() if test is not None]


def _filter(filter: Any) -> str:
    if isinstance(filter, tuple):
        return " and ".join(map(_filter, filter))
    if isinstance(filter, BaseFilter):
        return str(filter)
    return str(getattr(filter, "__qualname__", None) or repr(filter))


def _row(place: int, header: EpisodeHeader) -> str:
    total = "" if header.episode_return is None else f"{header.episode_return:.6g}"
    metadata = ", ".join(f"{key}: {value}" for key, value in header.metadata.items())
    cells = [place, f"{header.n_tuples:,}", total, header.end, "" if header.seed is None else header.seed]
    cells += [_short(metadata), _short(str(header.run.get("name", ""))), header.recording]
    return "<tr>" + "".join(f"<td>{_html.escape(str(cell))}</td>" for cell in cells) + "</tr>"


def _short(value: str) -> str:
    return value if len(value) <= _WIDTH else value[: _WIDTH - 1] + "…"
