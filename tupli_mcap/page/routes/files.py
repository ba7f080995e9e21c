"""Pictures of episodes, and the static files of the pages."""

from __future__ import annotations

from functools import partial
from pathlib import Path

from fastapi import APIRouter, Response
from fastapi.responses import FileResponse
from sqlalchemy import Connection

from tupli_mcap.errors import NotFoundError
from tupli_mcap.page import charts
from tupli_mcap.page.answers import PageRoute, Shown
from tupli_mcap.page.curves import curves_of, readable
from tupli_mcap.page.datasets import find_dataset
from tupli_mcap.page.pictures import cameras_of, picture_at
from tupli_mcap.page.routes.dataset import shown_first
from tupli_mcap.page.shelf import Shelf, find_episode, opened
from tupli_mcap.recording import Episode
from tupli_mcap.schema import EpisodeHeader

router = APIRouter(route_class=PageRoute, include_in_schema=False)
_STATIC = {path.name: path for path in (Path(__file__).parent.parent / "static").iterdir()}
_MOST_CURVES = 5
_DRAWING = {
    "Content-Security-Policy": "default-src 'none'; style-src 'unsafe-inline'; frame-ancestors 'none'"
}
# Not for who signs in next in the same browser.
_KEPT = {"Cache-Control": "private, max-age=3600", "Vary": "Cookie"}


@router.get("/static/{name}")
def static(name: str) -> FileResponse:
    """The style sheet, the scripts and the icon."""
    if name not in _STATIC:
        raise NotFoundError(f"there is no file {name[:80]!r}")
    return FileResponse(_STATIC[name], headers={"Cache-Control": "private, max-age=300"})


@router.get("/cover/{key:path}")
def cover(shelf: Shown, key: str) -> Response:
    """The picture of a dataset in lists: one of its newest episode, or else curves of it; if nothing of that can be
    read, of its best or worst episode."""

    def ask(show: str, connection: Connection) -> EpisodeHeader | None:
        return shown_first(shelf, connection, find_dataset(shelf, connection, key), show)

    for show in ("newest", "best", "worst"):
        header = shelf.ask(partial(ask, show))
        answer = None if header is None else readable("picture", partial(_cover, shelf, header), [])
        if answer is not None:
            return answer
    if header is None:
        raise NotFoundError("this benchmark has no episodes yet")
    return _drawing([])


def _cover(shelf: Shelf, header: EpisodeHeader) -> Response | None:
    """A picture or curves of an episode; None if there are none, FormatError if what they show is damaged."""
    episode = opened(shelf, header)
    cameras = cameras_of(episode)
    if cameras:
        data, media = picture_at(episode, cameras, 0, len(cameras[0].steps) // 2)
        return Response(data, media_type=media, headers=_KEPT)
    lines = _curves(episode)
    return _drawing(lines) if lines else None


def _drawing(lines: list[charts.Line]) -> Response:
    return Response(charts.cover(lines), media_type="image/svg+xml", headers=_KEPT | _DRAWING)


def _curves(episode: Episode) -> list[charts.Line]:
    """Some curves of an episode, each scaled to 0 … 1."""
    curves = curves_of(episode)
    moving = [
        track for field in ("state", "reward") for track in curves.of(field) if track.ends[1] > track.ends[0]
    ]
    return [
        (track.at / max(1, curves.read - 1), (track.values - track.ends[0]) / (track.ends[1] - track.ends[0]))
        for track in moving[:_MOST_CURVES]
    ]


@router.get("/episode/{uri}/picture/{camera}/{place}")
def picture(shelf: Shown, uri: str, camera: int, place: int) -> Response:
    """A picture of an episode. camera, place: the index of the camera, and of the picture among its pictures."""
    shown = opened(shelf, shelf.ask(lambda connection: find_episode(shelf, connection, uri)))
    data, media = picture_at(shown, cameras_of(shown), camera, place)
    return Response(data, media_type=media, headers=_KEPT)
