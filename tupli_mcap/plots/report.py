"""`report`: recordings in, one page of pictures out."""

from __future__ import annotations

import io
import os
from collections import Counter
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from tupli_mcap.dataset.choose import choose_among
from tupli_mcap.dataset.subjects import Examinable, Subject, subjects_of
from tupli_mcap.errors import RecordingError, os_reason
from tupli_mcap.plots.card import card, notes_of, title_of
from tupli_mcap.plots.compose import compose
from tupli_mcap.plots.gather import Measured, measure
from tupli_mcap.plots.html import fragment, page
from tupli_mcap.plots.style import styled
from tupli_mcap.plots.trace import Trace, trace
from tupli_mcap.schema import BaseFilter
from tupli_mcap.storage.atomic import write_bytes

if TYPE_CHECKING:
    from matplotlib.figure import Figure

__all__ = ["FORMATS", "Report", "check_goal", "report"]

FORMATS = (".png", ".svg", ".html")
_MOST_TRACES = 4


def report(
    source: Examinable | Iterable[Examinable],
    *,
    episode: str | int = "best",
    episode_filter: BaseFilter | None = None,
) -> Report:
    """Returns, lengths, states, actions, rewards and one episode of a recording, or of several compared.

    Each recording is read once, a few megabytes at a time; nothing in a file is executed. Of very long recordings,
    some episodes are read; the report says so.

    Args:
        source: the path of a recording or of a directory (a storage, too), a URL, an open `Recording`, a
            `TupliDataset`, a storage, or several of those. Episodes that a storage has deleted are left out.
        episode: whose steps are shown: a number, "best", "worst", "first" or "last"; with one recording also
            several, such as "3,7".
        episode_filter: show only episodes that it is true of.

    Raises:
        MissingExtraError: matplotlib is not installed.
        RecordingError: there is no recording or no such episode.
        FilterError: the filter names an unknown field, or `episode` is none of these words.
        FormatError: a recording is damaged.
    """
    with styled():  # before anything is read: matplotlib may be missing
        subjects = list(subjects_of(source, episode_filter))
        if not subjects:
            raise RecordingError("expected a recording (.mcap), found none; give a path")
        measured = [_measured(subject) for subject in subjects]
        if episode_filter is not None and not any(len(one.rows) for one in measured):
            raise RecordingError(f"there is no episode that {episode_filter} is true of; use another filter")
        _shorten_names(measured)
        traces = _traces(subjects, measured, str(episode))
        compared = _comparable(measured)
        return Report(measured, traces, compared)


class Report:
    """A page of pictures.

    figure: matplotlib's, to be changed or saved in other ways. measured: the numbers behind it, a recording each.
    traces: the episodes that are shown step by step, each with its recording.
    notes: what is not shown, and what is a sample.
    """

    def __init__(
        self,
        measured: Sequence[Measured],
        traces: Sequence[tuple[Measured, Trace]],
        notes: Sequence[str] = (),
    ) -> None:
        self.measured = list(measured)
        self.title = title_of(measured)
        self.facts = card(measured)
        self.notes = [*notes, *notes_of(measured)]
        self.traces = list(traces)
        with styled():
            self.figure: Figure = compose(measured, traces, notes=self.notes)

    def save(self, path: str | os.PathLike[str], *, overwrite: bool = False) -> Path:
        """Write a .png, .svg or .html file, whole or not at all; the same report gives the same bytes.

        Raises:
            RecordingError: another extension, the file is there already, or it cannot be written.
        """
        goal = check_goal(path, overwrite=overwrite)
        suffix = goal.suffix.lower()
        data = self.png() if suffix == ".png" else self.svg() if suffix == ".svg" else self.html()
        try:
            write_bytes(goal, data, replace=overwrite)
        except FileExistsError as err:
            raise RecordingError(f"{goal} exists; choose another name, or overwrite it") from err
        except OSError as err:
            raise RecordingError(f"{goal} cannot be written: {os_reason(err)}") from err
        return goal

    def png(self) -> bytes:
        """The bytes of a PNG."""
        return self._drawn(self.figure, "png", {"Software": None})

    def svg(self) -> bytes:
        """The bytes of an SVG; its texts are outlines, so that it looks the same everywhere."""
        return self._drawn(self.figure, "svg", {"Date": None, "Creator": None})

    def html(self) -> bytes:
        """A page that needs nothing else: no network, no script."""
        return page(self.title, self._fragment()).encode()

    def _fragment(self) -> str:
        with styled():
            figure = compose(self.measured, self.traces, head=False)
        picture = self._drawn(figure, "svg", {"Date": None, "Creator": None})
        return fragment(self.title, self.facts, self.notes, picture.decode(), self.measured)

    @staticmethod
    def _drawn(figure: Figure, format: str, metadata: dict[str, Any]) -> bytes:
        with styled():
            out = io.BytesIO()
            figure.savefig(out, format=format, metadata=metadata)
            return out.getvalue()

    def _repr_png_(self) -> bytes:
        return self.png()

    def _repr_html_(self) -> str:
        return self._fragment()

    def __repr__(self) -> str:
        return f"<Report of {self.title}>"


def check_goal(path: str | os.PathLike[str], *, overwrite: bool) -> Path:
    """The path of a report that may be written.

    Raises:
        RecordingError: another extension, no such directory, or the file is there already.
    """
    goal = Path(path)
    if goal.suffix.lower() not in FORMATS:
        raise RecordingError(f"expected a file that ends in {', '.join(FORMATS)}, found {goal.name!r}")
    if not goal.parent.is_dir():
        raise RecordingError(f"there is no directory {str(goal.parent)!r}; make it first")
    if goal.is_dir() or (goal.exists() and not overwrite):
        what = "is a directory" if goal.is_dir() else "exists"
        raise RecordingError(f"{goal} {what}; choose another name, or overwrite it")
    return goal


def _measured(subject: Subject) -> Measured:
    if subject.error is not None:
        raise subject.error
    with subject.open() as recording:
        return measure(recording, subject.choose(recording))


def _shorten_names(measured: Sequence[Measured]) -> None:
    """File names without directories and extension; longer where two would be the same."""
    parts = [Path(one.name).with_suffix("").parts for one in measured]
    for depth in range(1, max(map(len, parts)) + 1):
        names = ["/".join(part[-depth:]) for part in parts]
        if max(Counter(names).values()) == 1:
            break
    for one, name in zip(measured, names, strict=True):
        one.name = name


def _traces(
    subjects: Sequence[Subject], measured: Sequence[Measured], episode: str
) -> list[tuple[Measured, Trace]]:
    """The chosen episodes, step by step."""
    filled = [i for i, one in enumerate(measured) if len(one.rows)]
    if not filled:
        return []
    at = filled[0]
    if len(filled) > 1:
        at = _choose_recording(measured, filled, episode)
    subject, one = subjects[at], measured[at]
    with subject.open() as recording:
        positions = choose_among(recording, subject.choose(recording), episode)
        if len(positions) > _MOST_TRACES:
            raise RecordingError(
                f"expected at most {_MOST_TRACES} episodes to show in full, found {len(positions)}"
            )
        return [(one, trace(recording, int(position), one.leaves)) for position in positions]


def _choose_recording(measured: Sequence[Measured], filled: Sequence[int], episode: str) -> int:
    """Which of several recordings the best, worst, first or last episode is in."""
    word = episode.strip().lower()
    if word == "best":
        return max(filled, key=lambda i: np.nan_to_num(measured[i].rows["return"], nan=-np.inf).max())
    if word == "worst":
        return min(filled, key=lambda i: np.nan_to_num(measured[i].rows["return"], nan=np.inf).min())
    if word not in ("first", "last"):
        raise RecordingError(
            f"expected best, worst, first or last of {len(measured)} recordings, found {episode[:40]!r}; "
            "give one recording to choose an episode by its number"
        )
    return filled[0] if word == "first" else filled[-1]


def _comparable(measured: Sequence[Measured]) -> list[str]:
    """Takes the values away where spaces differ; what to say about it."""
    known = [one.layout for one in measured if one.layout is not None]
    if not known or all(
        layout.observation_space == known[0].observation_space
        and layout.action_space == known[0].action_space
        for layout in known
    ):
        return []
    for one in measured:
        one.states, one.actions = [], []
    return ["The recordings have different spaces, so that their states and actions are not compared."]
