"""Annotates episodes of a finished recording, and edits its runs. All chunks stay unchanged, byte for byte."""

from __future__ import annotations

import getpass
import os
import time
import warnings
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import replace
from typing import Any, TypeVar

from tupli_mcap import jsonvalue
from tupli_mcap.errors import Gathered, RecordingError, TupliError, warn
from tupli_mcap.progress import progress
from tupli_mcap.recording.about.annotations import (
    ANNOTATIONS_MEDIA_TYPE,
    ANNOTATIONS_NAME,
    Annotation,
    Annotations,
)
from tupli_mcap.recording.about.run import RUN_MEDIA_TYPE, RUN_NAME, Run
from tupli_mcap.recording.edit.attach import attach, check_attachable, held
from tupli_mcap.recording.index import chosen_numbers, whole_numbers
from tupli_mcap.recording.recording import Recording
from tupli_mcap.recording.signature_file import SIGNATURE_NAME
from tupli_mcap.schema.success import KEYS, success_of
from tupli_mcap.schema.times import iso_utc

_MOST_EDITS = 20  # of a run, that can be undone
_Path = TypeVar("_Path", bound=str | os.PathLike[str])
_Change = TypeVar("_Change")


def annotate_episodes(
    path: str | os.PathLike[str],
    values: Mapping[str, Any],
    episodes: Sequence[int] | None = None,
    *,
    dry_run: bool = False,
) -> list[int]:
    """Gives episodes (their numbers; all by default) values that take precedence over the recorded metadata.

    A value of None removes a key. The annotation keeps the user's name and the time. A signature is removed, since it
    no longer fits. The file is replaced in one rename; `dry_run` only checks.

    Returns:
        The numbers of the episodes.

    Raises:
        RecordingError: there are no such episodes, or no values; JSON cannot hold a value, or `success` is neither
            true nor false; the recording is not finished, or cannot be written.
        FormatError: the recording is damaged.
    """
    if not isinstance(values, Mapping):
        raise RecordingError(f"expected a dict of values for the episodes, found {values!r:.80}")
    if not values:
        raise RecordingError("expected values for the episodes, such as success=True, found none")
    if not all(isinstance(key, str) for key in values):
        raise RecordingError(f"expected keys that are texts, found {list(values)!r:.80}")
    try:
        plain = jsonvalue.loads(jsonvalue.dumps_plain(dict(values), name="annotation"))  # names the value
    except (TypeError, ValueError) as err:
        raise RecordingError(str(err)) from err
    for key in KEYS:  # as readers will see it: an array is a list then
        if plain.get(key) is not None and success_of({key: plain[key]}) is None:
            raise RecordingError(f"expected {key} to be true or false, found {values[key]!r:.40}")
    with _changing(path, dry_run) as (recording, say):
        chosen = sorted(chosen_numbers(recording.index, episodes, str(path)))
        if not chosen:
            raise RecordingError("expected episodes to annotate, found none")
        added = Annotation(chosen, dict(values), user_name(), iso_utc(time.time_ns()))
        said = Annotations([*recording.annotations.said, added])
        say(ANNOTATIONS_NAME, ANNOTATIONS_MEDIA_TYPE, said.to_json())
    return chosen


def undo_annotation(path: str | os.PathLike[str], *, dry_run: bool = False) -> Annotation:
    """Removes the last annotation, and returns it; `dry_run` only returns it.

    Raises:
        RecordingError: there is no annotation. Other errors are those of `annotate_episodes`.
    """
    with _changing(path, dry_run) as (recording, say):
        if not recording.annotations.said:
            raise RecordingError(f"{path} has no annotation to take back")
        *kept, last = recording.annotations.said
        say(ANNOTATIONS_NAME, ANNOTATIONS_MEDIA_TYPE, Annotations(kept).to_json())
    return last


def edit_runs(
    path: str | os.PathLike[str],
    runs: Sequence[int] | None = None,
    *,
    name: str | None = None,
    metadata: Mapping[str, Any] | None = None,
    tags: Sequence[str] | None = None,
    split: str | None = None,
    dry_run: bool = False,
) -> list[Run]:
    """Changes the given parts of a recording's runs, and returns these as they are now.

    The recording keeps its UUID, and the earlier versions of the runs for `undo_edit`.

    Args:
        path: the recording.
        runs: their places in `Recording.runs`; all by default.
        name, tags, split: replace those of the runs; None keeps them.
        metadata: are added to the runs' own; a value of None removes a key.
        dry_run: only check, and return the runs.

    Raises:
        RecordingError: as `annotate_episodes`; or there are no such runs.
    """
    if metadata is not None and not isinstance(metadata, Mapping):
        raise RecordingError(f"metadata: expected a dict with texts as keys, found {metadata!r:.80}")
    tags = list(tags) if isinstance(tags, Iterator) else tags  # more than one run may get them
    with _changing(path, dry_run) as (recording, say):
        said = recording.recorded_runs
        new, before = list(said.runs), list(said.before)
        places = _places(path, recording, runs)
        # what was recorded as None stays
        removed = {key for key, value in (metadata or {}).items() if value is None}
        for place in places:
            run = new[place]
            added = {**run.metadata, **(metadata or {})}
            given = Run.given(
                run.name if name is None else name,
                {key: value for key, value in added.items() if key not in removed},
                run.tags if tags is None else tags,
                run.split if split is None else split,
            )
            before.append((place, _with_given(Run(), run)))
            new[place] = _with_given(run, given)
        say(RUN_NAME, RUN_MEDIA_TYPE, said._replace(runs=new, before=_latest(before)).to_json())
    return [new[place] for place in places]


def undo_edit(
    path: str | os.PathLike[str], runs: Sequence[int] | None = None, *, dry_run: bool = False
) -> list[Run]:
    """Undoes the last edit of each run that was edited, and returns these as they were before.

    Args:
        path: the recording.
        runs: the places in `Recording.runs` of those that may be changed; all by default.
        dry_run: only check, and return the runs.

    Raises:
        RecordingError: as `edit_runs`; or none of the runs was edited.
    """
    with _changing(path, dry_run) as (recording, say):
        said = recording.recorded_runs
        new, before = list(said.runs), list(said.before)
        edited = {place: i for i, (place, _) in enumerate(before)}  # where its latest version is
        last = {place: edited[place] for place in _places(path, recording, runs) if place in edited}
        if not last:
            raise RecordingError(f"{path}: there is no edit to undo")
        for place, i in last.items():
            new[place] = _with_given(new[place], before[i][1])
        kept = [each for i, each in enumerate(before) if i not in last.values()]
        say(RUN_NAME, RUN_MEDIA_TYPE, said._replace(runs=new, before=kept).to_json())
    return [new[place] for place in last]


def change_all(
    paths: Iterable[_Path],
    change: Callable[[_Path, bool], _Change],
    *,
    dry_run: bool,
    gathered: Gathered | None = None,
) -> list[_Change]:
    """Changes several recordings, or none of them if one cannot be changed; returns what `change` returned of each.

    What only shows while they are changed, such as a full disk, ends it; the error names those that were changed.

    Args:
        change: takes a path, and whether it is a dry run, in which it raises the errors of the change itself.
        gathered: errors of other recordings that were to be changed, too.

    Raises:
        RecordingError: some cannot be changed; the message has the reason of each.
        FormatError: the only one that cannot be changed is damaged.
    """
    paths, gathered = list(paths), gathered or Gathered()
    found = []
    with progress((1 if dry_run else 2) * len(paths), "changing recordings") as bar:
        with warnings.catch_warnings():
            if not dry_run:
                warnings.simplefilter("ignore")  # the change itself gives the same ones
            for path in paths:
                with gathered.keep():
                    found.append(change(path, True))
                bar.advance(1)
        gathered.raise_all()
        if dry_run:
            return found
        found = []
        for path in paths:
            try:
                found.append(change(path, False))
            except TupliError as err:
                if not found:
                    raise
                changed = ", ".join(map(str, paths[: len(found)]))
                raise type(err)(f"{err}; changed before that: {changed}") from err
            bar.advance(1)
    return found


def _places(path: str | os.PathLike[str], recording: Recording, runs: Sequence[int] | None) -> Sequence[int]:
    """The places of some of a recording's runs, in their order."""
    known = range(len(recording.runs))
    places = known if runs is None else sorted(set(whole_numbers(runs, "places in Recording.runs")))
    missing = [place for place in places if place not in known]
    if missing or not places:
        found = missing[0] if missing else "none"
        raise RecordingError(f"{path}: expected places of its {len(known)} runs, from 0, found {found}")
    return places


def _with_given(run: Run, given: Run) -> Run:
    """A run with what a user has given of another."""
    return replace(run, name=given.name, metadata=given.metadata, tags=given.tags, split=given.split)


def _latest(before: Sequence[tuple[int, Run]]) -> list[tuple[int, Run]]:
    """The latest of the earlier versions of each run."""
    later = Counter[int]()
    kept = []
    for place, run in reversed(before):
        if later[place] < _MOST_EDITS:
            kept.append((place, run))
        later[place] += 1
    return kept[::-1]


@contextmanager
def _changing(
    path: str | os.PathLike[str], dry_run: bool
) -> Iterator[tuple[Recording, Callable[[str, str, bytes], None]]]:
    """Locks a recording; yields it, and a function that replaces one of its attachments (name, media type, bytes).

    The function warns if it removes a signature. In a dry run it does nothing else.

    Raises:
        RecordingError: the recording is not finished, is being written, or cannot be written; also in a dry run.
        FormatError: it is damaged.
    """
    with held(path) as place, Recording(place) as recording:
        check_attachable(place, finished=recording.complete)

        def say(name: str, media_type: str, data: bytes) -> None:
            if SIGNATURE_NAME in recording.attachments:
                left_out = "would be left out" if dry_run else "is left out"
                message = f"{path}: its signature covers what was said before, and {left_out}"
                warn(message)
            if not dry_run:
                attach(place, {name: (media_type, data)}, without=[SIGNATURE_NAME])

        yield recording, say


def user_name() -> str:
    """The name of this process's user, empty where there is none."""
    try:
        return getpass.getuser()
    except (OSError, KeyError):  # a user without a name, as in a container
        return ""
