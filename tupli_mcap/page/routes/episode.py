"""The page of an episode: its pictures, its curves, and its facts."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import partial
from typing import Any, Final, NamedTuple
from urllib.parse import urlencode

from fastapi import APIRouter, Request, Response
from markupsafe import Markup
from sqlalchemy import Connection

from tupli_mcap import jsonvalue
from tupli_mcap.errors import FilterError, NotFoundError
from tupli_mcap.page import charts
from tupli_mcap.page.answers import PageRoute, Shown, page
from tupli_mcap.page.curves import Curves, Track, curves_of, readable, values_at
from tupli_mcap.page.datasets import Dataset, dataset_of, of_recording, seen_in
from tupli_mcap.page.pictures import Camera, cameras_of
from tupli_mcap.page.shelf import Shelf, find_episode, opened, python_line
from tupli_mcap.page.texts import iso
from tupli_mcap.recording import Episode
from tupli_mcap.schema import EpisodeHeader, FilterEQ, format_filter, parse_bound
from tupli_mcap.storage.catalog.order import After, Sort
from tupli_mcap.storage.catalog.queries import find_episodes

router = APIRouter(route_class=PageRoute, include_in_schema=False)


FIELDS: Final = {"reward": "Reward", "action": "Actions", "state": "States", "info": "Infos"}
"""The fields of tracks, with their titles, in the order in which they are shown."""


class Neighbours(NamedTuple):
    """The ids of the episodes before and after one, in the list that the reader came from."""

    before: str | None
    after: str | None


@router.get("/episode/{uri}")
def episode(
    request: Request,
    shelf: Shown,
    uri: str,
    step: int = 0,
    dataset: str = "",
    filter: str = "",
    sort: str = "",
) -> Response:
    """The page of an episode. dataset, filter, sort: the list of its neighbours; by default, its recording."""

    def ask(connection: Connection) -> tuple[EpisodeHeader, Dataset, Neighbours]:
        found = find_episode(shelf, connection, uri)
        of = dataset_of(shelf, connection, found)
        return found, of, _neighbours(shelf, connection, found, dataset, filter, sort)

    header, of, neighbours = shelf.ask(ask)
    seen = look(shelf, header, step)
    facts = {
        **dict(header),
        "reset": _reset(seen.episode, header),
        "annotations": [
            {"by": note.by, "at": note.at, "values": note.values}
            for note in seen.episode.recording.annotations.of(header.episode)
        ],
        "cameras": [{"name": camera.name, "steps": camera.steps.tolist()} for camera in seen.cameras],
        "step": {"number": seen.step, **seen.values},
        **neighbours._asdict(),
    }
    context = {"dataset": dataset, "filter": filter, "sort": sort}
    return page(
        request, "episode.html", facts, shelf=shelf, header=header, seen=seen, dataset=of, around=neighbours,
        context=context, python=python_line(shelf, format_filter(FilterEQ(key="id", value=uri))) + "[0]",
        foxglove=_foxglove(request, shelf, header, seen.episode),
    )  # fmt: skip


@router.get("/episode/{uri}/step/{step}")
def one_step(shelf: Shown, uri: str, step: int) -> Response:
    """The values at a step as JSON: texts by field and name."""
    shown = opened(shelf, shelf.ask(lambda connection: find_episode(shelf, connection, uri)))
    if not 0 <= step < len(shown):
        raise NotFoundError(f"expected a step from 0 to {len(shown) - 1}, found {step}")
    return Response(jsonvalue.dumps(values_at(shown, step)), media_type="application/json")


def _reset(shown: Episode, header: EpisodeHeader) -> dict[str, Any]:
    """What its reset was told and said; if that is damaged, only the seed that the header has."""
    start = readable("reset", lambda: shown.start, [])
    if start is None:
        return {"seed": header.seed, "options": None, "info": {}}
    return {"seed": shown.seed, "options": shown.options, "info": shown.reset_info}


def _foxglove(request: Request, shelf: Shelf, header: EpisodeHeader, shown: Episode) -> str:
    """A link that opens the recording in Foxglove, where the episode begins. Of a file, Foxglove asks for the index,
    which an unfinished one lacks, and then for ranges; a remote data loader needs neither. Empty if there is no way."""
    place = shelf.address_of(header.recording) if shown.recording.complete else None
    if place is None:
        return foxglove_link(shelf.loader_of([header.id]))
    url = str(request.base_url).rstrip("/") + place
    return foxglove_link({"ds": "remote-file", "ds.url": url, "time": iso(shown.start_time)})


def foxglove_link(told: Mapping[str, str]) -> str:
    """The address of a view in Foxglove; empty without parameters."""
    return f"https://app.foxglove.dev/~/view?{urlencode(told)}" if told else ""


class Seen(NamedTuple):
    """The content of an episode's page. values: the values at `step`, by field and name."""

    episode: Episode
    curves: Curves
    cameras: Sequence[Camera]
    step: int
    values: Mapping[str, Mapping[str, str]]

    @property
    def id_and_steps(self) -> tuple[str, int]:
        """The id of the episode, and how many steps it has."""
        return self.episode.id, len(self.episode)

    @property
    def groups(self) -> list[tuple[str, Sequence[Track]]]:
        """The titles of the fields that have tracks, each with its tracks."""
        found = ((title, self.curves.of(field)) for field, title in FIELDS.items())
        return [(title, tracks) for title, tracks in found if tracks]

    @property
    def untracked(self) -> list[tuple[str, str, str]]:
        """The values at the step that have no track: field, name, value."""
        tracked = {(track.field, track.name) for track in self.curves.tracks}
        return [
            (field, name, value)
            for field, named in self.values.items()
            for name, value in named.items()
            if (field, name) not in tracked and field != "end"
        ]

    def drawn(self, track: Track) -> Markup:
        """A track as SVG, over all steps: the cursor moves over these, also beyond those that were read."""
        return charts.lines([(track.at, track.values)], len(self.episode), track.ends)


def look(shelf: Shelf, header: EpisodeHeader, step: int) -> Seen:
    """Reads what the page shows of an episode. NotFoundError if it is gone."""
    episode = opened(shelf, header)
    step = min(max(0, step), len(episode) - 1)
    return Seen(episode, curves_of(episode), cameras_of(episode), step, values_at(episode, step))


def _neighbours(
    shelf: Shelf, connection: Connection, header: EpisodeHeader, dataset: str, filter: str, sort: str
) -> Neighbours:
    try:
        wanted = parse_bound(filter, EpisodeHeader) if filter.strip() else None
        order = Sort.parse(sort)
    except FilterError:
        wanted, order = None, None
    own = [] if dataset or filter or sort else [of_recording(header.recording)]
    seen = seen_in(shelf, connection, dataset, *own)
    place = After(header.recording, header.episode)
    find = partial(find_episodes, connection, wanted, limit=1, after=place, sort=order, **seen)
    before, after = (next(find(backwards=backwards), None) for backwards in (True, False))
    return Neighbours(None if before is None else before.id, None if after is None else after.id)
