"""Commands that change what a recording says of its episodes and runs: tag, edit. Its steps are not touched."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from tupli_mcap.cli.options import DryRun, Episodes, FilterText, Json, chosen_in, local_path, pair_of
from tupli_mcap.cli.output import pairs_of, print_facts, print_json
from tupli_mcap.cli.terminal import say
from tupli_mcap.errors import Gathered, RecordingError, plural
from tupli_mcap.remote import is_url

if TYPE_CHECKING:
    from tupli_mcap.recording import Recording, Run


def tag(
    places: Annotated[
        list[str],
        typer.Argument(
            metavar="PATH|KEY=VALUE",
            help="Recordings, directories, patterns, storages; then the values to note.",
        ),
    ],
    episodes: Episodes = None,
    filter_text: FilterText = None,
    undo: Annotated[bool, typer.Option("--undo", help="Take back the last note of each recording.")] = False,
    dry_run: DryRun = False,
    as_json: Json = False,
) -> None:
    """Note something about episodes, such as success=true.

    Filters and tables use a note in place of recorded metadata of the same key. A value that
    is JSON is read as JSON, any other as text; KEY= removes a key. The file keeps who noted
    it and when. Its steps are not touched. A signature is dropped. If one recording cannot be
    changed, none is. With --undo, --filter chooses recordings that have an episode which
    matches; of a directory, those without a note stay as they are.
    """
    from tupli_mcap.files import is_there
    from tupli_mcap.recording import undo_annotation
    from tupli_mcap.recording.edit.annotate import change_all

    given = [text for text in places if "=" not in text or is_url(text) or is_there(text)]
    paths = [local_path(text) for text in given]
    values = dict(pair_of(text) for text in places if text not in given)
    if not paths or bool(values) == undo:
        raise typer.BadParameter(
            "expected recordings or directories, then KEY=VALUE or --undo, such as: run.mcap --episodes 3,7 good=true"
        )
    if undo and episodes is not None:
        raise typer.BadParameter("--undo takes a note back from all its episodes; leave out --episodes")
    if not undo and episodes is None and filter_text is None:
        raise typer.BadParameter(
            "say which episodes: --episodes 3,7, --filter 'return < 10' or --episodes all"
        )
    done: list[dict[str, Any]] = []
    if undo:
        gathered = Gathered()
        files = _files_in(paths, filter_text, gathered)
        files = _changed_in(paths, files, "note", lambda _, recording: recording.annotations.said, gathered)
        lasts = change_all(
            files, lambda file, dry: undo_annotation(file, dry_run=dry), dry_run=dry_run, gathered=gathered
        )
        for file, last in zip(files, lasts, strict=True):
            done.append({"path": file, "episodes": last.episodes, "values": last.values})
    else:
        noted = _note(paths, episodes, filter_text, values, dry_run=dry_run)
        done = [{"path": file, "episodes": numbers, "values": values} for file, numbers in noted.items()]
    if as_json:
        print_json([{"dry_run": dry_run, "undone": undo, **one} for one in done])
        return
    for one in done:
        _tell_note(one, undo=undo, dry_run=dry_run)


def _note(
    places: Sequence[Path],
    episodes: str | None,
    filter_text: str | None,
    values: dict[str, Any],
    *,
    dry_run: bool,
) -> dict[str, list[int]]:
    """Notes values of the chosen episodes; returns the numbers of these by recording."""
    from tupli_mcap.recording import annotate_episodes
    from tupli_mcap.recording.edit.annotate import change_all

    gathered = Gathered()
    named = chosen_in(places, episodes, filter_text, gathered)
    chosen = {file: numbers for (file, _), numbers in named.items()}
    change_all(
        chosen,
        lambda file, dry: annotate_episodes(file, values, chosen[file], dry_run=dry),
        dry_run=dry_run,
        gathered=gathered,
    )
    return chosen


def _tell_note(note: dict[str, Any], *, undo: bool, dry_run: bool) -> None:
    from tupli_mcap.jsonvalue import spelled

    values = {key: "" if value is None else spelled(value) for key, value in note["values"].items()}
    noted = ", ".join(f"{key}={value}" for key, value in values.items())
    count = plural(len(note["episodes"]), "episode")
    if undo:
        say(f"{note['path']}: {'would take' if dry_run else 'took'} {noted} back from {count}")
    else:
        say(f"{note['path']}: {count} {'would be ' if dry_run else ''}annotated: {noted}")


def edit(
    places: Annotated[
        list[Path],
        typer.Argument(
            metavar="PATH", help="Recordings, directories, patterns, storages.", parser=local_path
        ),
    ],
    filter_text: FilterText = None,
    name: Annotated[str | None, typer.Option(help="The new name of the run.")] = None,
    settings: Annotated[
        list[str] | None,
        typer.Option("--set", metavar="KEY=VALUE", help="Metadata of the run; KEY= removes it. Repeatable."),
    ] = None,
    tags: Annotated[
        list[str] | None,
        typer.Option(
            "--tag", metavar="WORD", help="A tag of the run. Replaces all earlier tags. Repeatable."
        ),
    ] = None,
    run_split: Annotated[
        str | None, typer.Option("--split", metavar="WORD", help="What the run is for: train, eval, …")
    ] = None,
    undo: Annotated[bool, typer.Option("--undo", help="Take back the last edit of each run.")] = False,
    dry_run: DryRun = False,
    as_json: Json = False,
) -> None:
    """Change the name, metadata, tags or split of runs.

    All runs of the recordings are changed; with --filter, those that have an episode which
    matches. A value that is JSON is read as JSON, any other as text: version=1.10 is the
    number 1.1, and 'version="1.10"' a text. --undo takes the last edit of each of them back.
    The recordings keep their ids, and their steps are not touched. A signature is dropped. If
    one recording cannot be changed, none is.
    """
    from tupli_mcap.recording import edit_runs, undo_edit
    from tupli_mcap.recording.edit.annotate import change_all

    _demand_no_settings(places)
    if undo == any(given is not None for given in (name, settings, tags, run_split)):
        raise typer.BadParameter(
            "expected a change (--name, --set KEY=VALUE, --tag or --split) or --undo, and not both"
        )
    metadata, gathered = dict(pair_of(text) for text in settings or ()), Gathered()
    chosen = _runs_in(places, filter_text, gathered)
    files = list(chosen)
    if undo:
        files = _changed_in(places, files, "edit", partial(_edits_of, chosen), gathered)

    def change(file: str, dry: bool) -> list[Run]:
        if undo:
            return undo_edit(file, chosen[file], dry_run=dry)
        return edit_runs(
            file, chosen[file], name=name, metadata=metadata, tags=tags, split=run_split, dry_run=dry
        )

    edited = zip(files, change_all(files, change, dry_run=dry_run, gathered=gathered), strict=True)
    changed = [(file, run) for file, runs in edited for run in runs]
    if as_json:
        print_json([{"dry_run": dry_run, "path": file, "run": run.as_dict()} for file, run in changed])
        return
    for file, run in changed:
        _tell_run(file, run, dry_run=dry_run)


def _demand_no_settings(places: Sequence[Path]) -> None:
    """Says what is meant by KEY=VALUE, which `tag` takes without an option."""
    from tupli_mcap.files import is_there

    for place in places:
        if "=" in str(place) and not is_there(place):
            raise typer.BadParameter(
                f"{place} is no recording; to change metadata of the run, give --set {place}"
            )


def _runs_in(
    places: Sequence[Path], filter_text: str | None, gathered: Gathered
) -> dict[str, list[int] | None]:
    """The recordings of paths, and the places of the runs that have an episode which matches; None for all."""
    from tupli_mcap.recording import Recording

    if filter_text is None:
        return dict.fromkeys(_files_in(places, None, gathered))
    found: dict[str, list[int] | None] = {}
    for (file, _), numbers in chosen_in(places, None, filter_text, gathered).items():
        with Recording(file) as recording:
            place_of = dict(zip(recording.index["episode"].tolist(), recording.run_places, strict=True))
            found[file] = sorted({place_of[number] for number in numbers})
    return found


def _edits_of(chosen: Mapping[str, list[int] | None], file: str, recording: Recording) -> list[int]:
    """The places of the chosen runs of a recording that were edited."""
    some = chosen[file]
    return [place for place, _ in recording.recorded_runs.before if some is None or place in some]


def _tell_run(file: str, run: Run, *, dry_run: bool) -> None:
    facts = {
        "would change" if dry_run else "recording": file,
        "run": run.name,
        "split": run.split,
        "tags": ", ".join(run.tags),
        "settings": pairs_of(run.metadata),
    }
    print_facts(facts.items())


def _files_in(places: Sequence[Path], filter_text: str | None, gathered: Gathered) -> list[str]:
    """The recordings of paths, or those that have an episode which matches; see `chosen_in`."""
    from tupli_mcap.storage.listing import recordings_at

    if filter_text is not None:
        return [file for file, _ in chosen_in(places, None, filter_text, gathered)]
    files = list(dict.fromkeys(file for place in places for file in recordings_at(place)))
    if not files:
        raise RecordingError(f"there is no recording in {', '.join(map(str, places))}")
    return files


def _changed_in(
    places: Sequence[Path],
    files: Iterable[str],
    what: str,
    changes_of: Callable[[str, Recording], Sequence[object]],
    gathered: Gathered,
) -> list[str]:
    """The recordings of paths whose last change is taken back: those that are named, and of directories those that
    have one. RecordingError if none has."""
    from tupli_mcap.recording import Recording

    named, found = set(map(str, places)), []
    for file in files:
        with gathered.keep(), Recording(file) as recording:
            if file in named or changes_of(file, recording):
                found.append(file)
    if not found:
        gathered.raise_all()
        raise RecordingError(f"there is no {what} to take back in {', '.join(map(str, places))}")
    return found
