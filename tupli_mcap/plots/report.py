"""`report`: recordings in, one page of pictures out."""

from __future__ import annotations

import io
import os
from collections import Counter
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from tupli_mcap.dataset.which import Examinable, Subject, named_positions, subjects_of
from tupli_mcap.errors import RecordingError, os_reason
from tupli_mcap.plots import texts
from tupli_mcap.plots.draw_episodes import add_episodes
from tupli_mcap.plots.draw_trace import add_trace
from tupli_mcap.plots.draw_values import add_coverage, add_values
from tupli_mcap.plots.measure import READ_BYTES, Measured, Trace, measure, trace
from tupli_mcap.plots.style import Page, styled
from tupli_mcap.schema import BaseFilter
from tupli_mcap.storage.atomic import write_bytes

__all__ = ["FORMATS", "Report", "check_goal", "report"]

FORMATS = (".png", ".svg", ".html")
_MOST_TRACES = 4

Traces = Sequence[tuple[Measured, Trace]]


def report(
    source: Examinable | Iterable[Examinable],
    *,
    episode: str | int = "best",
    episode_filter: BaseFilter | None = None,
) -> Report:
    """Returns, lengths, states, actions, rewards and one episode of a recording, or of several compared.

    At most 128 MiB of steps are read: of longer recordings, randomly chosen episodes; the report says so. Nothing
    in a file is executed.

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
        measured = []
        for subject in subjects:
            if subject.error is not None:
                raise subject.error
            with subject.open() as recording:
                measured.append(measure(recording, subject.choose(recording), READ_BYTES // len(subjects)))
        if episode_filter is not None and not any(len(one.rows) for one in measured):
            raise RecordingError(f"there is no episode that {episode_filter} is true of; use another filter")
        _shorten_names(measured)
        traces = _traces(subjects, measured, str(episode))
        return Report(measured, traces, _make_comparable(measured))


class Report:
    """A page of pictures.

    figure: matplotlib's, to be changed or saved in other ways. measured: the numbers behind it, a recording each.
    traces: the episodes that are shown step by step, each with its recording.
    notes: what is not shown, and what is a sample.
    """

    def __init__(self, measured: Sequence[Measured], traces: Traces, notes: Sequence[str] = ()) -> None:
        self.measured = list(measured)
        self.title = texts.title_of(measured)
        self.facts = texts.facts_of(measured)
        self.notes = [*notes, *texts.notes_of(measured)]
        self.traces = list(traces)
        with styled():
            self.figure: Any = _figure(measured, traces, self.notes)

    def save(self, path: str | os.PathLike[str], *, overwrite: bool = False) -> Path:
        """Write a .png, .svg or .html file, whole or not at all; the same report gives the same bytes.

        Raises:
            RecordingError: another extension, the file is there already, or it cannot be written.
        """
        goal = check_goal(path, overwrite=overwrite)
        data = {".png": self.png, ".svg": self.svg, ".html": self.html}[goal.suffix.lower()]()
        try:
            write_bytes(goal, data, replace=overwrite)
        except OSError as err:
            raise RecordingError(f"{goal} cannot be written: {os_reason(err)}") from err
        return goal

    def png(self) -> bytes:
        """The bytes of a PNG."""
        return _saved(self.figure, "png")

    def svg(self) -> bytes:
        """The bytes of an SVG; its texts are outlines, so that it looks the same everywhere."""
        return _saved(self.figure, "svg")

    def html(self) -> bytes:
        """A page that needs nothing else: no network, no script."""
        return texts.html_page(self.title, self._fragment()).encode()

    def _fragment(self) -> str:
        with styled():
            svg = _saved(_figure(self.measured, self.traces, None), "svg").decode()
        return texts.html_fragment(self.title, self.facts, self.notes, svg, self.measured)

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


def _figure(measured: Sequence[Measured], traces: Traces, notes: Sequence[str] | None) -> Any:
    """The whole page; without notes (None), it leaves out the head, too."""
    page = Page()
    if notes is not None:
        texts.add_facts(page, measured)
    filled = [one for one in measured if len(one.rows)]
    if filled:
        add_episodes(page, filled)
    valued = [one for one in filled if one.read_steps]
    if valued:
        states, actions, rewards = (
            list(zip(*leaves, strict=True))  # the same leaf of every recording together
            for leaves in zip(*((one.states, one.actions, one.rewards) for one in valued), strict=True)
        )
        add_values(page, "States", states)
        add_coverage(page, states, [one.name for one in valued])
        add_values(page, "Actions and rewards", actions, rewards)
    for one, shown in traces:
        add_trace(page, one, shown, several=len(measured) > 1)
    if notes is not None:
        texts.add_notes(page, notes)
    return page.draw()


def _saved(figure: Any, format: str) -> bytes:
    """A picture's bytes, without its date and who made it: the same report gives the same bytes."""
    unnamed = {"png": {"Software": None}, "svg": {"Date": None, "Creator": None}}
    with styled():
        out = io.BytesIO()
        figure.savefig(out, format=format, metadata=unnamed[format])
        return out.getvalue()


def _shorten_names(measured: Sequence[Measured]) -> None:
    """File names without directories and extension; longer where two would be the same."""
    parts = [Path(one.name).with_suffix("").parts for one in measured]
    for depth in range(1, max(map(len, parts)) + 1):
        names = ["/".join(part[-depth:]) for part in parts]
        if max(Counter(names).values()) == 1:
            break
    for one, name in zip(measured, names, strict=True):
        one.name = name


def _traces(subjects: Sequence[Subject], measured: Sequence[Measured], episode: str) -> Traces:
    """The chosen episodes, step by step."""
    filled = [i for i, one in enumerate(measured) if len(one.rows)]
    if not filled:
        return []
    word, at = episode.strip().lower(), filled[0]
    if len(filled) > 1 and word not in ("best", "worst", "first", "last"):
        raise RecordingError(
            f"expected best, worst, first or last of {len(measured)} recordings, found {episode[:40]!r}; "
            "give one recording to choose an episode by its number"
        )
    if word == "last":
        at = filled[-1]
    elif word in ("best", "worst"):
        sign = 1 if word == "best" else -1
        at = max(filled, key=lambda i: np.nan_to_num(sign * measured[i].rows["return"], nan=-np.inf).max())
    with subjects[at].open() as recording:
        positions = named_positions(recording, subjects[at].choose(recording), episode)
        if len(positions) > _MOST_TRACES:
            raise RecordingError(
                f"expected at most {_MOST_TRACES} episodes to show in full, found {len(positions)}"
            )
        return [(measured[at], trace(recording, int(position), measured[at])) for position in positions]


def _make_comparable(measured: Sequence[Measured]) -> list[str]:
    """Takes the values away where spaces differ; what to say about it."""
    spaces = [(one.layout.observation_space, one.layout.action_space) for one in measured if one.layout]
    if all(pair == spaces[0] for pair in spaces):
        return []
    for one in measured:
        one.states, one.actions = [], []
    return ["The recordings have different spaces, so that their states and actions are not compared."]
