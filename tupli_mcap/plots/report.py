"""`report`: draws recordings as one page of plots."""

from __future__ import annotations

import io
import os
from collections import Counter
from collections.abc import Iterable, Sequence
from functools import cached_property
from pathlib import Path
from typing import Any, get_args

import numpy as np

from tupli_mcap.dataset.chosen import Examinable, Subject, subjects_once
from tupli_mcap.dataset.which import named_places, text_of
from tupli_mcap.errors import RecordingError, asking, os_reason
from tupli_mcap.files import is_directory, is_there, write_bytes
from tupli_mcap.plots import texts
from tupli_mcap.plots.draw_episodes import add_episodes
from tupli_mcap.plots.draw_trace import add_trace
from tupli_mcap.plots.draw_values import add_coverage, add_values
from tupli_mcap.plots.groups import X, groups_of, shown_numbers
from tupli_mcap.plots.measure import READ_BYTES, Measured, Trace, measure, trace
from tupli_mcap.plots.style import Page, styled
from tupli_mcap.progress import progress
from tupli_mcap.schema import BaseFilter

FORMATS = (".png", ".svg", ".pdf", ".html")
_LONGEST_NAME = 200  # characters of a run's name that are shown
_MOST_TRACES = 4

Traces = Sequence[tuple[Measured, Trace]]


def report(
    source: Examinable | Iterable[Examinable],
    *,
    episode: str | int = "best",
    episode_filter: BaseFilter | None = None,
    x: X | None = None,
) -> Report:
    """Numbers of the episodes of a recording, its states, actions and rewards, and one episode; or several compared.

    The numbers are returns, lengths, success, and some of infos (their means) and of metadata. Their lines leave out
    episodes that the end of a recording cut off: the last ones of its sub-environments, if they are interrupted.
    Runs that differ only by their seeds are drawn as one: their mean, and its 95% interval (a percentile bootstrap over
    the runs, see `plots.statistics.mean_interval`), up to the end of the shortest. Two runs differ only by their seeds
    if their names are equal without `seed3`, or without the `seed` of their settings, and all settings (`metadata`)
    are equal but those named seed, seeds or something_seed. If more than 32 lines are left, runs whose names differ
    only by numbers are drawn as one, too, or else all of an environment.

    At most 128 MiB of steps and 20,000 infos of a recording are read. Of a longer one, randomly chosen episodes are
    read, and the report says so. Nothing in a file is executed.

    Args:
        source: the path of a recording or of a directory (a storage, too), a URL, an open `Recording`, a
            `Dataset`, a `TupliDataset`, a storage, or several of those. Deleted episodes are left out, and so, with a
            warning, are those that another file of the same directory has.
        episode: the episode whose steps are shown: a number, "best", "worst", "first" or "last"; also up to four, such
            as "3,7" or "best,worst". Of several recordings, a number is that of each which has it.
        episode_filter: show only episodes that match it.
        x: the horizontal axis of returns, lengths and the like: "steps" of the run, "episodes" (their numbers), or
            "time" since its start; each at the end of an episode. By default, "episodes" for one recording, and "steps"
            for several.

    Raises:
        MissingExtraError: matplotlib is not installed.
        RecordingError: there is no recording, no episode or no such episode, or `x` is not valid.
        FilterError: the filter names an unknown field, or `episode` is not valid.
        FormatError: a recording is damaged.
    """
    if x is not None and x not in get_args(X):
        raise RecordingError(f"expected {', '.join(get_args(X))} as x, found {x!r:.80}")
    with styled():  # before anything is read: matplotlib may be missing
        subjects = list(subjects_once(source, episode_filter))
        if not subjects and episode_filter is None:
            raise RecordingError(
                "expected episodes to draw, found none; give a recording (.mcap), or choose others"
            )
        runs: list[tuple[Subject, Measured]] = []
        with progress(len(subjects), "measuring recordings") as bar:
            for subject in subjects:
                if subject.error is not None:
                    raise subject.error
                with subject.open() as recording:
                    found = measure(recording, subject.choose(recording), READ_BYTES // len(subjects))
                runs += [(subject, one) for one in found]
                bar.advance(1)
        if not any(len(one.rows) for _, one in runs):
            if episode_filter is not None:
                raise RecordingError(f"no episode matches {text_of(episode_filter)}; use another filter")
            where = ", ".join(subject.name for subject in subjects)
            raise RecordingError(f"there is no episode to draw in {where:.300}")
        if episode_filter is not None:
            runs = [(subject, one) for subject, one in runs if len(one.rows)]
        measured = [one for _, one in runs]
        _shorten_names(measured)
        traces = _traces(runs, str(episode))
        return Report(measured, traces, _make_comparable(measured), x)


class Report:
    """A page of pictures.

    measured: its numbers, by recording.
    groups: each has a colour of its own: a recording, or runs that differ only by their seeds; of many, see `report`.
    traces: the episodes that are shown step by step, each with its recording.
    notes: sentences on what is not shown, and what is a sample.
    """

    def __init__(
        self, measured: Sequence[Measured], traces: Traces, notes: Sequence[str] = (), x: X | None = None
    ) -> None:
        self.measured = list(measured)
        self.groups = groups_of(measured)
        self.title = texts.title_of(measured)
        self.facts = texts.facts_of(self.groups)
        self.traces = list(traces)
        self._x: X = x or ("episodes" if len(measured) == 1 else "steps")
        self.notes = [*notes, *(shown_numbers(self.groups)[1]), *texts.notes_of(measured)]

    @cached_property
    def figure(self) -> Any:
        """The matplotlib figure, which you may change, or save in other ways; drawn when it is first asked for."""
        with styled():
            return self._draw(whole=True)

    def save(self, path: str | os.PathLike[str], *, overwrite: bool = False) -> Path:
        """Write a .png, .svg, .pdf or .html file, whole or not at all; the same report gives the same bytes.

        Raises:
            RecordingError: another extension, the file is there already, or it cannot be written.
        """
        goal = check_goal(path, overwrite=overwrite)
        data = {".png": self.png, ".svg": self.svg, ".pdf": self.pdf, ".html": self.html}[
            goal.suffix.lower()
        ]()
        try:
            write_bytes(goal, data, overwrite=overwrite)
        except OSError as err:
            raise RecordingError(f"{goal} cannot be written: {os_reason(err)}") from err
        return goal

    def png(self) -> bytes:
        """The bytes of a PNG."""
        return _saved(self.figure, "png")

    def svg(self) -> bytes:
        """The bytes of an SVG; its texts are outlines, so that it looks the same everywhere."""
        return _saved(self.figure, "svg")

    def pdf(self) -> bytes:
        """The bytes of a PDF of one long page; its texts can be selected."""
        return _saved(self.figure, "pdf")

    def html(self) -> bytes:
        """A self-contained page, without network or scripts."""
        return texts.html_page(self.title, self._fragment()).encode()

    def _fragment(self) -> str:
        with styled():
            svg = _saved(self._draw(whole=False), "svg").decode()
        return texts.html_fragment(self.title, self.facts, self.notes, svg, self.measured)

    def _draw(self, *, whole: bool) -> Any:
        """Draws the page; unless `whole`, without its head and its notes."""
        page = Page()
        if whole:
            texts.add_facts(page, self.title, self.facts, several=len(self.measured) > 1)
        filled = [group for group in self.groups if len(group.rows)]
        if filled:
            add_episodes(page, filled, self._x)
        valued = [group for group in filled if any(one.read_steps for one in group.recordings)]
        if valued:
            states, actions, rewards = (
                list(zip(*leaves, strict=True))  # the same leaf of every group together
                for leaves in zip(*((one.states, one.actions, one.rewards) for one in valued), strict=True)
            )
            add_values(page, "States", states)
            add_coverage(page, states, [group.name for group in valued])
            add_values(page, "Actions and rewards", actions, rewards)
        for one, shown in self.traces:
            add_trace(page, one, shown, several=len(self.measured) > 1)
        if whole:
            texts.add_notes(page, self.notes)
        return page.draw()

    def _repr_png_(self) -> bytes:
        return self.png()

    def _repr_html_(self) -> str:
        return self._fragment()

    def __getstate__(self) -> dict[str, Any]:
        """All but the figure, which is drawn anew: matplotlib's cannot be pickled."""
        return {name: value for name, value in vars(self).items() if name != "figure"}

    def __repr__(self) -> str:
        return f"<Report of {self.title}>"


def check_goal(path: str | os.PathLike[str], *, overwrite: bool) -> Path:
    """The path of a report that may be written.

    Raises:
        RecordingError: another extension, no such directory, or the file is there already (without `overwrite`).
    """
    goal = Path(path)
    if goal.suffix.lower() not in FORMATS:
        raise RecordingError(f"expected a file that ends in {', '.join(FORMATS)}, found {goal.name!r}")
    if not is_directory(goal.parent):
        raise RecordingError(f"there is no directory {str(goal.parent)!r}; make it first")
    if is_directory(goal) or (is_there(goal) and not overwrite):
        what = "is a directory" if is_directory(goal) else "exists"
        raise RecordingError(
            f"{goal} {what}; choose another name, or pass {asking('overwrite=True', '--force')}"
        )
    return goal


def _saved(figure: Any, format: str) -> bytes:
    """The bytes of a picture, without date and author, so that the same report gives the same bytes."""
    unnamed = {"png": {"Software": None}, "svg": {"Date": None, "Creator": None}}
    unnamed["pdf"] = {"CreationDate": None, "Creator": None, "Producer": None}
    with styled():
        out = io.BytesIO()
        figure.savefig(out, format=format, metadata=unnamed[format])
        return out.getvalue()


def _shorten_names(measured: Sequence[Measured]) -> None:
    """Of several runs, the name of each that no other one has; else the file's name without directories and extension,
    or a longer part of its path if two would be equal."""
    given = [one.run.name[:_LONGEST_NAME] for one in measured]
    counts = Counter(given)
    own = [name if len(measured) > 1 and counts[name] == 1 else "" for name in given]
    parts = [Path(one.name).with_suffix("").parts for one in measured]
    for depth in range(1, max(map(len, parts)) + 1):
        names = [name or "/".join(part[-depth:]) for name, part in zip(own, parts, strict=True)]
        if len(set(names)) == len(names):
            break
    for one, name in zip(measured, names, strict=True):
        one.name = name


def _traces(runs: Sequence[tuple[Subject, Measured]], episode: str) -> Traces:
    """The chosen episodes, step by step. Of several recordings, a number is that of each which has it."""
    filled = [(subject, one) for subject, one in runs if len(one.rows)]
    if not filled:
        return []
    rows = np.concatenate([one.rows for _, one in filled])
    names = list(dict.fromkeys(subject.name for subject, _ in filled))
    where = names[0] if len(names) == 1 else f"the set of {len(names)} recordings"
    named = named_places(where, rows["episode"], rows["return"], episode)
    if len(named) > _MOST_TRACES:
        raise RecordingError(f"expected at most {_MOST_TRACES} episodes to show in full, found {len(named)}")
    each = [(i, int(number)) for i, (_, one) in enumerate(filled) for number in one.rows["episode"]]
    traces: list[tuple[Measured, Trace]] = []
    for i, number in map(each.__getitem__, named):
        subject, one = filled[i]
        with subject.open() as recording:
            traces.append((one, trace(recording, number, one)))
    return traces


def _make_comparable(measured: Sequence[Measured]) -> list[str]:
    """Removes values whose spaces differ between recordings; returns sentences about it."""
    spaces = [one.spaces for one in measured if one.spaces]
    if all(pair == spaces[0] for pair in spaces):
        return []
    for one in measured:
        one.states, one.actions = [], []
    return ["The recordings have different spaces, so that their states and actions are not compared."]
