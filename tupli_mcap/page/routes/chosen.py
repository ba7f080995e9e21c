"""Chosen episodes: compares them, draws small lines of them, downloads them."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterable, Sequence
from typing import Annotated, Any, Final, NamedTuple

import numpy as np
from fastapi import APIRouter, HTTPException, Query, Request, Response
from fastapi.responses import FileResponse
from markupsafe import Markup
from sqlalchemy import Connection

from tupli_mcap import files, jsonvalue
from tupli_mcap.arrays import Array
from tupli_mcap.errors import NotFoundError, TupliError
from tupli_mcap.page import charts
from tupli_mcap.page.answers import PageRoute, Shown, attachment, page
from tupli_mcap.page.copies import MOST_CHOSEN, MOST_COMPARED, film_file, have_same_spaces, recording_of, sent
from tupli_mcap.page.curves import Track
from tupli_mcap.page.datasets import Dataset, dataset_of, seen_in
from tupli_mcap.page.routes.episode import FIELDS, Seen, foxglove_link, look
from tupli_mcap.page.shelf import Shelf, find_episode, find_some, python_line
from tupli_mcap.plots.measure import thinned_to
from tupli_mcap.plots.statistics import drawable_numbers
from tupli_mcap.recording import Recording
from tupli_mcap.recording.about.run import name_after
from tupli_mcap.schema import EpisodeHeader, FilterIN, format_filter, parse_bound
from tupli_mcap.spaces.labels import element_names
from tupli_mcap.storage.catalog.queries import find_episodes

router = APIRouter(route_class=PageRoute, include_in_schema=False)
_MOST_STEPS: Final = 400_000  # most steps that are read for the small lines of one table
_POINTS: Final = 120
_KEYS: Final = 20  # most keys of metadata that are compared
_OF_SEVERAL: Final = "Curve"  # the name of lines of different values
Ids = Annotated[list[str], Query(alias="episode", default_factory=list, max_length=MOST_CHOSEN)]


class Compared(NamedTuple):
    """One number in several episodes. lines: SVG. ends: the smallest and the largest value of all. values: those of the
    episodes at their first step, as texts."""

    name: str
    field: str
    lines: Markup
    ends: tuple[float, float]
    values: Sequence[str]


@router.get("/compare")
def compare(request: Request, shelf: Shown, uris: Ids) -> Response:
    """A page with up to eight episodes in the same plots."""
    if not 2 <= len(set(uris)) <= MOST_COMPARED:
        raise HTTPException(400, f"expected 2 to {MOST_COMPARED} episodes to compare, found {len(set(uris))}")

    def ask(connection: Connection) -> tuple[list[EpisodeHeader], Dataset | None]:
        found = find_some(shelf, connection, uris)
        alike = len({_dataset_key(header) for header in found}) == 1
        return found, dataset_of(shelf, connection, found[0]) if alike else None

    headers, dataset = shelf.ask(ask)
    seen = [look(shelf, header, 0) for header in headers]
    steps = max(len(one.episode) for one in seen)
    groups = [(title, _compared(seen, field, steps)) for field, title in FIELDS.items()]
    facts_of = [[header.metadata for header in headers], [_settings(header) for header in headers]]
    keys = [list(dict.fromkeys(itertools.chain.from_iterable(each)))[:_KEYS] for each in facts_of]
    notes: dict[str, list[int]] = {}  # with the places of their episodes
    for place, one in enumerate(seen):
        for note in one.curves.notes:
            notes.setdefault(note, []).append(place)
    facts = {"episodes": [dict(header) for header in headers]}
    return page(
        request, "compare.html", facts, shelf=shelf, headers=headers, seen=seen, steps=steps,
        metadata=(keys[0], facts_of[0]), settings=(keys[1], facts_of[1]), dataset=dataset,
        groups=[(title, tracks) for title, tracks in groups if tracks], notes=notes,
        replayed=have_same_spaces([one.episode.recording for one in seen]),
        foxglove=foxglove_link(shelf.loader_of([header.id for header in headers])),
        python=python_line(shelf, format_filter(FilterIN(key="id", value=[header.id for header in headers]))),
    )  # fmt: skip


def _settings(header: EpisodeHeader) -> dict[str, Any]:
    """The metadata of an episode's run."""
    return dict(header.run.get("metadata", {}))


def _compared(seen: Sequence[Seen], field: str, steps: int) -> list[Compared]:
    """Overlays the tracks of a field that all episodes have, but those that have none, which may be damaged."""
    each = [{track.name: track for track in one.curves.of(field)} for one in seen]
    some = [tracks for tracks in each if tracks]
    names = [name for name in some[0] if all(name in tracks for tracks in some)] if some else []
    compared = []
    for name in names:
        lines, ends = _overlaid([tracks.get(name) for tracks in each], steps)
        values = [one.values.get(field, {}).get(name, "") for one in seen]
        compared.append(Compared(name, field, lines, ends, values))
    return compared


def _overlaid(tracks: Sequence[Track | None], steps: int) -> tuple[Markup, tuple[float, float]]:
    ends = np.array([track.ends for track in tracks if track is not None])
    known = ends[np.isfinite(ends).all(axis=1)]
    both = (float(known[:, 0].min()), float(known[:, 1].max())) if len(known) else (np.nan, np.nan)
    nothing = np.empty(0), np.empty(0)
    lines = [nothing if track is None else (track.at, track.values) for track in tracks]
    return charts.lines(lines, steps, both), both


@router.get("/sparks")
def sparks(shelf: Shown, uris: Ids) -> Response:
    """The small lines beside the rows of a table, as JSON: the name of their value, and by id the path of each."""
    headers = shelf.ask(lambda connection: find_some(shelf, connection, uris))
    return Response(jsonvalue.dumps(_sparks(shelf, headers)), media_type="application/json")


@router.get("/download")
def download(shelf: Shown, uris: Ids, dataset: str = "", filter: str = "") -> Response:
    """One recording of the chosen episodes; if none are chosen, of all that match the filter."""

    def find(connection: Connection) -> Iterable[EpisodeHeader]:
        if uris:
            return find_some(shelf, connection, uris)
        wanted = parse_bound(filter, EpisodeHeader) if filter.strip() else None
        return find_episodes(connection, wanted, **seen_in(shelf, connection, dataset))

    def ask(connection: Connection) -> tuple[str, dict[str, list[int]]]:
        runs = set[str]()
        datasets: dict[tuple[str, str], EpisodeHeader] = {}  # with an episode of each
        numbers_of: dict[str, list[int]] = {}
        for header in find(connection):  # of what may be a million, only the numbers are kept
            runs.add(_run_name(header))
            datasets.setdefault(_dataset_key(header), header)
            numbers_of.setdefault(header.recording, []).append(header.episode)
        if len(runs) == 1:
            return runs.pop(), numbers_of
        one = next(iter(datasets.values())) if len(datasets) == 1 else None
        return "" if one is None else dataset_of(shelf, connection, one).name, numbers_of

    name, numbers_of = shelf.ask(ask)
    if not numbers_of:
        raise NotFoundError("no episode matches; choose others, or another filter")
    numbers = list(itertools.chain.from_iterable(numbers_of.values()))
    what = f"episode-{numbers[0]}" if len(numbers) == 1 else f"{len(numbers)}-episodes"
    answer = recording_of(shelf, numbers_of)
    answer.headers.update(attachment(_file_name(name, f"{what}.mcap")))
    return answer


@router.get("/episode/{uri}/film.mp4")
def film(shelf: Shown, uri: str) -> FileResponse:
    header = shelf.ask(lambda connection: find_episode(shelf, connection, uri))
    name = _file_name(_run_name(header), f"episode-{header.episode}.mp4")
    return sent(film_file(shelf, header), name, "video/mp4")


def _dataset_key(header: EpisodeHeader) -> tuple[str, str]:
    """Equal for episodes of the same dataset."""
    return header.benchmark_id, str(header.run.get("environment"))


def _run_name(header: EpisodeHeader) -> str:
    return str(header.run.get("name", "")) or name_after(header.recording)


def _file_name(of: str, what: str) -> str:
    """The name of a file to download: of a run or a dataset (empty for several), and what it holds of it."""
    return "-".join(filter(None, (files.as_file_name(of), what)))


# --- small lines ---


def _sparks(shelf: Shelf, headers: Sequence[EpisodeHeader]) -> dict[str, Any]:
    """Draws the rewards of some episodes; if all rewards are equal, the first number of the states instead. Each line
    is an SVG path (`d`) in a drawing of 1000 x 100."""
    for column in (_rewards, _first_state):
        found, name = _read(shelf, headers, column)
        if len(np.unique(np.concatenate([values[:-1] for values in found.values()] or [np.empty(0)]))) > 1:
            break
    lines = {}
    for uri, values in found.items():
        known = values[np.isfinite(values)]
        if len(known):
            thin = thinned_to(_POINTS, values)
            at = np.arange(len(thin), dtype=np.float64)
            up = float(known.min()), float(known.max())
            lines[uri] = charts.line_path(at, thin, (0.0, max(1.0, len(thin) - 1.0)), up)
    return {"name": name if lines else "", "lines": lines}


_Column = Callable[[Recording, Array], tuple[Any, str]]


def _read(shelf: Shelf, headers: Sequence[EpisodeHeader], column: _Column) -> tuple[dict[str, Array], str]:
    found: dict[str, Array] = {}
    names, left = set[str](), _MOST_STEPS
    for recording_name, group in itertools.groupby(headers, key=lambda header: header.recording):
        some = []
        for header in group:
            if header.n_tuples <= left:  # a longer one has no line
                some.append(header)
                left -= header.n_tuples
        if not some:
            continue
        try:
            recording = shelf.open(recording_name)
            numbers, wanted = recording.index["episode"], [header.episode for header in some]
            positions = numbers.searchsorted(wanted)
            if not np.array_equal(numbers[np.minimum(positions, len(numbers) - 1)], wanted):
                continue  # the file has changed since the query
            values, name = column(recording, positions)
        except TupliError:
            continue
        if values is not None:
            names.add(name)
            lengths = recording.index["length"][positions].astype(np.int64)
            parts = np.split(drawable_numbers(values), np.cumsum(lengths)[:-1])
            found |= {header.id: part for header, part in zip(some, parts, strict=True)}
    return found, names.pop() if len(names) == 1 else _OF_SEVERAL


def _rewards(recording: Recording, positions: Array) -> tuple[Any, str]:
    leaf = recording.layout.reward[0]
    if leaf.size != 1 or leaf.kind == "variable":
        return None, ""
    return np.asarray(leaf.get(recording.read(["rewards"], episodes=positions).rewards)).reshape(-1), "reward"


def _first_state(recording: Recording, positions: Array) -> tuple[Any, str]:
    leaf = next(
        (leaf for leaf in recording.layout.state if leaf.kind in ("array", "scalar") and leaf.size), None
    )
    if leaf is None:
        return None, ""
    column = leaf.get(recording.read(["states"], episodes=positions, images=False).states)
    return np.asarray(column).reshape(len(column), -1)[:, 0], element_names(leaf, recording.labels, [0])[0]
