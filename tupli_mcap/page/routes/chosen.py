"""Chosen episodes: compares them, draws small lines of them, downloads them."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from itertools import chain
from pathlib import Path
from typing import Annotated, NamedTuple
from urllib.parse import quote

import numpy as np
from fastapi import APIRouter, HTTPException, Query, Request, Response
from fastapi.responses import FileResponse
from markupsafe import Markup
from sqlalchemy import Connection

from tupli_mcap import files, jsonvalue
from tupli_mcap.errors import NotFoundError
from tupli_mcap.page import charts
from tupli_mcap.page.answers import PageRoute, Shown, page
from tupli_mcap.page.copies import MOST_COMPARED, film_file, recording_of, sent
from tupli_mcap.page.curves import Track
from tupli_mcap.page.datasets import of_dataset
from tupli_mcap.page.routes.episode import FIELDS, Seen, look
from tupli_mcap.page.shelf import find_episode, find_some, seen_episodes, seen_recordings
from tupli_mcap.page.sparks import sparks_of
from tupli_mcap.schema import EpisodeHeader, parse_bound
from tupli_mcap.storage.catalog.queries import each_once, find_episodes

router = APIRouter(route_class=PageRoute, include_in_schema=False)
Ids = Annotated[list[str], Query(alias="episode", default_factory=list, max_length=1000)]


class Compared(NamedTuple):
    """One number in several episodes. lines: SVG. ends: the smallest and the largest value of all."""

    name: str
    lines: Markup
    ends: tuple[float, float]


@router.get("/compare")
def compare(request: Request, shelf: Shown, uris: Ids) -> Response:
    """A page with up to eight episodes in the same plots."""
    if not 2 <= len(set(uris)) <= MOST_COMPARED:
        raise HTTPException(400, f"expected 2 to {MOST_COMPARED} episodes to compare, found {len(set(uris))}")
    headers = shelf.ask(lambda connection: find_some(shelf, connection, uris))
    seen = [look(shelf, header, 0) for header in headers]
    steps = max(len(one.episode) for one in seen)
    groups = [(title, _compared(seen, field, steps)) for field, title in FIELDS.items()]
    keys = list(dict.fromkeys(chain.from_iterable(header.metadata for header in headers)))
    facts = {"episodes": [dict(header) for header in headers]}
    return page(
        request, "compare.html", facts, shelf=shelf, headers=headers, seen=seen, steps=steps, keys=keys[:20],
        groups=[(title, tracks) for title, tracks in groups if tracks],
    )  # fmt: skip


def _compared(seen: Sequence[Seen], field: str, steps: int) -> list[Compared]:
    """Overlays the tracks that all episodes have."""
    each = [{track.name: track for track in one.curves.of(field)} for one in seen]
    names = [name for name in each[0] if all(name in tracks for tracks in each)]
    return [_overlaid(name, [tracks[name] for tracks in each], steps) for name in names]


def _overlaid(name: str, tracks: Sequence[Track], steps: int) -> Compared:
    ends = np.array([track.ends for track in tracks])
    known = ends[np.isfinite(ends).all(axis=1)]
    low, high = (float(known[:, 0].min()), float(known[:, 1].max())) if len(known) else (np.nan, np.nan)
    room = 0.04 * (high - low)
    lines = [(track.at, track.values) for track in tracks]
    drawn = charts.lines(lines, (0.0, max(1.0, steps - 1.0)), (low - room, high + room))
    return Compared(name, drawn, (low, high))


@router.get("/sparks")
def sparks(shelf: Shown, uris: Ids) -> Response:
    """The small lines beside the rows of a table, as JSON: the name of their value, and by id the path of each."""
    headers = shelf.ask(lambda connection: find_some(shelf, connection, uris))
    return Response(jsonvalue.dumps(sparks_of(shelf, headers)._asdict()), media_type="application/json")


@router.get("/download")
def download(shelf: Shown, uris: Ids, dataset: str = "", filter: str = "") -> Response:
    """One recording of the chosen episodes; if none are chosen, of all that match the filter."""

    def find(connection: Connection) -> Iterable[EpisodeHeader]:
        if uris:
            return find_some(shelf, connection, uris)
        wanted = parse_bound(filter, EpisodeHeader) if filter.strip() else None
        of = seen_recordings(shelf, *([of_dataset(dataset)] if dataset else []))
        return each_once(find_episodes(connection, wanted, only=seen_episodes(shelf, connection), of=of))

    def ask(connection: Connection) -> tuple[EpisodeHeader | None, dict[str, list[int]]]:
        first: EpisodeHeader | None = None
        numbers_of: dict[str, list[int]] = {}
        for header in find(connection):  # of what may be a million, only the numbers are kept
            first = first or header
            numbers_of.setdefault(header.recording, []).append(header.episode)
        return first, numbers_of

    first, numbers_of = shelf.ask(ask)
    if first is None:
        raise NotFoundError("no episode matches; choose others, or another filter")
    name = str(first.run.get("name", "")) or Path(first.recording).stem
    count = sum(map(len, numbers_of.values()))
    what = f"episode-{first.episode}" if count == 1 else f"{count}-episodes"
    answer = recording_of(shelf, numbers_of)
    answer.headers["Content-Disposition"] = (
        f'attachment; filename="{quote(files.as_file_name(name))}-{what}.mcap"'
    )
    return answer


@router.get("/episode/{uri}/film.mp4")
def film(shelf: Shown, uri: str) -> FileResponse:
    """The pictures of an episode as an MP4."""
    header = shelf.ask(lambda connection: find_episode(shelf, connection, uri))
    return sent(film_file(shelf, header), f"episode-{header.episode}.mp4", "video/mp4")
