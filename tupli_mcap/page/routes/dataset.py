"""The page of a dataset: one of its episodes, then statistics of all, and their recordings."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from typing import Annotated, Any, Final, NamedTuple

import numpy as np
from fastapi import APIRouter, Query, Request, Response
from markupsafe import Markup
from sqlalchemy import Connection

from tupli_mcap.arrays import Array
from tupli_mcap.errors import NotFoundError, TupliError, plural
from tupli_mcap.page import charts, texts
from tupli_mcap.page.answers import PageRoute, Shown, page
from tupli_mcap.page.datasets import Dataset, dataset_filter, find_dataset, of_recording, seen_in
from tupli_mcap.page.routes.episode import Seen, look
from tupli_mcap.page.samples import (
    SampledEpisodes,
    SampledValues,
    sample_episodes,
    sample_numbers,
    sample_values,
)
from tupli_mcap.page.shelf import Shelf, python_line
from tupli_mcap.plots.statistics import LeafValues, bands, bin_edges, drawable_numbers
from tupli_mcap.recording import Recording
from tupli_mcap.recording.describe.description import describe
from tupli_mcap.schema import EpisodeHeader
from tupli_mcap.storage.catalog.order import Sort
from tupli_mcap.storage.catalog.queries import find_episodes

router = APIRouter(route_class=PageRoute, include_in_schema=False)
_RECORDINGS: Final = 100  # on a page
_HISTOGRAMS: Final = 24  # most histograms of a field
_BINS: Final = 24
_GROUPS: Final = 60  # groups of episodes along the time, whose means make a line
_GROUPS_EACH: Final = 30  # the same, for one of several lines
_LINES: Final = 8  # most recordings that get a line each
_LEAST: Final = 10  # episodes of a recording that has a line of its own


class Histogram(NamedTuple):
    """How often values occur. name: what the values are of."""

    name: str
    drawn: Markup


@router.get("/dataset/{key:path}")
def dataset(
    request: Request,
    shelf: Shown,
    key: str,
    show: Annotated[str, Query(pattern="newest|best|worst")] = "newest",
    number: Annotated[int, Query(alias="page", ge=1)] = 1,
) -> Response:
    """The page of a dataset. show: which of its episodes is shown at its top. number: of a page of its recordings."""

    def ask(connection: Connection) -> tuple[Dataset, EpisodeHeader | None, SampledEpisodes, Any]:
        found = find_dataset(shelf, connection, key)
        header = shown_first(shelf, connection, found, show)
        return (
            found,
            header,
            sample_episodes(shelf, connection, found),
            sample_numbers(shelf, connection, found),
        )

    of, header, episodes, numbers = shelf.ask(ask)
    first = (number - 1) * _RECORDINGS
    if first and first >= len(of.recordings):
        raise NotFoundError(f"there is no page {number} of the recordings of this dataset")
    values = sample_values(shelf, numbers)
    seen = None if header is None else _look(shelf, header)
    facts = {
        **of.facts(),
        "files": [_file_facts(item) for item in of.recordings],
        "episode": None if header is None else header.id,
        "environment_facts": _environment(seen.episode.recording) if seen else {},
    }
    drawn: dict[str, Any] = {
        "over_time": list(_over_time(episodes, _lines_apart(episodes, of))),
        "python": python_line(shelf, dataset_filter(key)),
        "seeds": _ends(episodes.seeds),
        "histograms": _histograms(values),
        "files": sorted(of.recordings, key=lambda item: -item.last)[first : first + _RECORDINGS],
        "number": number,
        "more": len(of.recordings) > first + _RECORDINGS,
    }
    return page(
        request, "dataset.html", facts, shelf=shelf, dataset=of, show=show, seen=seen, header=header,
        episodes=episodes, values=values, **drawn,
    )  # fmt: skip


def _look(shelf: Shelf, header: EpisodeHeader) -> Seen | None:
    try:
        return look(shelf, header, header.n_tuples // 3)  # a step at which most environments are in motion
    except TupliError:  # the other recordings of the dataset may be sound
        return None


def shown_first(shelf: Shelf, connection: Connection, dataset: Dataset, show: str) -> EpisodeHeader | None:
    """The newest episode, or the one with the highest or the lowest return."""
    known = [item for item in dataset.recordings if show == "newest" or item.return_most is not None]
    if show == "newest":
        known.sort(key=lambda item: -item.last)
        order = Sort("ended", descending=True)
    elif show == "best":
        known.sort(key=lambda item: -(item.return_most or 0.0))
        order = Sort("return", descending=True)
    else:
        known.sort(key=lambda item: item.return_least or 0.0)
        order = Sort("return")
    for item in known:  # all episodes of one may be copies of others that are shown instead
        seen = seen_in(shelf, connection, dataset.key, of_recording(item.recording))
        for header in find_episodes(connection, None, limit=1, sort=order, **seen):
            return header
    return None


def _ends(values: Array) -> str:
    known = values[np.isfinite(values)]
    return texts.spread(float(known.min()), float(known.max())) if len(known) else ""


class Chart(NamedTuple):
    """A number of episodes over time, and its distribution; instead, `alike` says which value all episodes have
    of which it is known, and how many these are."""

    title: str
    over_time: Markup = Markup("")
    distribution: Markup = Markup("")
    alike: str = ""


def _over_time(episodes: SampledEpisodes, names: Mapping[str, str]) -> Iterator[Chart]:
    """Charts of return, length and success. names: by recording, the name of its line; empty for one line of all."""
    for title, values in (
        ("Return", episodes.returns),
        ("Length", episodes.steps),
        ("Success", episodes.success),
    ):
        drawable = drawable_numbers(values)
        known = drawable[np.isfinite(drawable)]
        if len(known) and known.min() == known.max():
            which = "every episode" if len(known) == len(values) else plural(len(known), "episode")
            yield Chart(title, alike=f"{texts.number(float(known[0]))} in {which}")
        elif len(known):
            what = f"{title} of episodes over time"
            drawn = (
                _by_recording(episodes, drawable, names, what) if names else _as_one(episodes, drawable, what)
            )
            yield Chart(title, drawn, _bars(known, title.lower()))


def _bars(values: Array, of: str) -> Markup:
    """A histogram of finite values; those far away from all others have no bar, and are counted at its ends."""
    edges, _ = bin_edges(values, _BINS)
    counts, _ = np.histogram(values, edges)
    shown = values[(values >= edges[0]) & (values <= edges[-1])]
    least, most = map(texts.number, (shown.min(), shown.max()) if len(shown) else (None, None))
    below, above = int((values < edges[0]).sum()), int((values > edges[-1]).sum())
    ends = (f"{least}; {below:,} below" if below else least, f"{most}; {above:,} above" if above else most)
    return charts.histogram(counts, edges, ends, label=f"Distribution of {of}, from {ends[0]} to {ends[1]}")


def _as_one(episodes: SampledEpisodes, values: Array, what: str) -> Markup:
    at = np.arange(len(values), dtype=np.float64)
    middle, mean, _, low, high, _ = bands(values, min(len(values), _GROUPS))
    ends = texts.moment(int(episodes.ended[0])), texts.moment(int(episodes.ended[-1]))
    if set(values[np.isfinite(values)].tolist()) <= {0.0, 1.0}:  # points and band of flags would show nothing
        return charts.over_time([(middle, mean)], ends, what)
    return charts.over_time([(middle, mean)], ends, what, points=(at, values), band=(low, high))


def _by_recording(episodes: SampledEpisodes, values: Array, names: Mapping[str, str], what: str) -> Markup:
    of = np.array(episodes.recordings)
    lines = []
    for recording in names:
        own = values[of == recording]
        middle, mean, *_ = bands(own, min(len(own), _GROUPS_EACH))
        lines.append((middle / max(1, len(own) - 1), mean))
    return charts.over_time(lines, ("first", "last"), what, names=list(names.values()))


def _lines_apart(episodes: SampledEpisodes, dataset: Dataset) -> dict[str, str]:
    """The names of the runs by recording, if there are few recordings and each has enough episodes for a line."""
    counts = Counter(episodes.recordings)
    if (
        not 1 < len(counts) <= _LINES
        or min(counts.values()) < _LEAST
        or len(counts) < len(dataset.recordings)
    ):
        return {}
    named = {item.recording: (str(run.get("name", "")) for run in item.runs) for item in dataset.recordings}
    return {
        recording: (", ".join(dict.fromkeys(names)) or recording)[:40] for recording, names in named.items()
    }


def _histograms(values: SampledValues) -> list[tuple[str, Sequence[Histogram], int]]:
    """For each field: its title, its histograms, and how many were left out."""
    found: list[tuple[str, Sequence[Histogram], int]] = []
    for title, leaves in (
        ("States", values.states),
        ("Actions", values.actions),
        ("Rewards", values.rewards),
    ):
        drawn = [(leaf, i) for leaf in leaves for i in range(len(leaf.names)) if len(leaf.values)]
        if drawn:
            shown = [_histogram(leaf, i) for leaf, i in drawn[:_HISTOGRAMS]]
            found.append((title, shown, len(drawn) - len(shown)))
    return found


def _histogram(leaf: LeafValues, i: int) -> Histogram:
    name = leaf.names[i]
    if leaf.kind == "choices":
        start, counts = int(leaf.starts[i]), leaf.counts[i]
        names = list(leaf.value_names) or [str(start + k) for k in range(len(counts))]
        edges, label = np.arange(len(counts) + 1.0), f"How often each value of {name} occurred"
        return Histogram(name, charts.histogram(counts, edges, (names[0], names[-1]), names, label))
    return Histogram(name, _bars(leaf.column(i), name))


def _file_facts(item: Any) -> dict[str, Any]:
    return {
        "recording": item.recording,
        "uuid": item.uuid,
        "owner": item.owner,
        "bytes": item.size,
        "episodes": item.episodes,
        "steps": item.steps,
        "return_mean": item.return_sum / item.returns if item.returns else None,
        "runs": item.runs,
    }


def _environment(recording: Recording) -> Mapping[str, Any]:
    """A recording's facts about its environment and the program that made it."""
    facts = describe(recording, np.empty(0, np.int64))
    return {
        "observation": facts.observation,
        "action": facts.action,
        "step_seconds": recording.labels.step_seconds,
        "num_envs": facts.num_envs,
        "library": facts.library,
        "command": facts.run.get("command", ()),
        "git": facts.run.get("git", {}),
        "host": facts.run.get("host", ""),
        "versions": facts.run.get("versions", {}),
        "attachments": facts.attachments,
        "made_of": facts.made_of,
        "signed_by": facts.signed_by,
    }
