"""Commands that change metadata (tag, edit), or write new recordings (merge, split, filter, trim, recover)."""

from __future__ import annotations

import shlex
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from tupli_mcap.cli.options import (
    DryRun,
    Episodes,
    File,
    FilterText,
    Force,
    Json,
    Output,
    Sources,
    chosen_in,
    dataset_of,
    filter_of,
    local_path,
    none_in,
    pair_of,
    recordings_of,
)
from tupli_mcap.cli.output import (
    Column,
    counted,
    number,
    pairs_of,
    print_facts,
    print_json,
    print_result,
    print_rows,
    print_table,
    print_wrapped,
)
from tupli_mcap.cli.terminal import say
from tupli_mcap.errors import Gathered, RecordingError, bytes_of
from tupli_mcap.remote import is_url, shown_name

if TYPE_CHECKING:
    from tupli_mcap.recording import Recording, RecoveryReport, Run

_NO_JOURNAL = {
    "missing": "their journal is not beside the file; if the file was cut off, also all after the cut",
    "stale": "the journal beside the file belongs to another recording",
    "damaged": "their journal is damaged",
}
_SHOWN = 20  # how many damaged places or lost episodes are shown; --json has all


def merge(
    sources: Annotated[
        list[str],
        typer.Argument(metavar="PATH|URL", help="Recordings with the same spaces, or directories of them."),
    ],
    output: Output,
    force: Force = False,
    dry_run: DryRun = False,
    as_json: Json = False,
) -> None:
    """Write the episodes of several recordings into one.

    Episodes keep their times, and get new numbers and ids. Recordings that were made at the
    same time, or that have different numbers of sub-environments, become sub-environments of
    the new one. Each episode keeps its run. The new recording has the environment of the
    first one, and no signature.
    """
    from tupli_mcap.dataset import merge_recordings

    report = merge_recordings(recordings_of(sources), output, overwrite=force, dry_run=dry_run)
    _print_made(report, dry_run=dry_run, as_json=as_json)


def split(
    source: Annotated[str, typer.Argument(metavar="FILE|URL", help="A recording.")],
    output: Annotated[
        Path,
        typer.Option(
            "--output", "-o", metavar="FILE", help="The first new recording; others are FILE_0001.mcap, …"
        ),
    ],
    episodes: Annotated[int | None, typer.Option(min=1, help="Episodes in each file.")] = None,
    max_bytes: Annotated[int | None, typer.Option(min=1, help="Bytes in each file, roughly.")] = None,
    dry_run: DryRun = False,
    as_json: Json = False,
) -> None:
    """Write the episodes of a recording into several.

    Episodes stay whole, and keep their numbers. The new recordings have new ids, and no
    signature.
    """
    if (episodes is None) == (max_bytes is None):
        raise typer.BadParameter("expected either --episodes or --max-bytes")
    from tupli_mcap.dataset import split_recording

    found = recordings_of([source])
    if len(found) != 1:
        raise typer.BadParameter(
            f"expected one recording, found {len(found)} at {shown_name(source)}; give one of them"
        )
    parts = split_recording(found[0], output, episodes=episodes, max_bytes=max_bytes, dry_run=dry_run)
    columns = (
        Column("WOULD WRITE" if dry_run else "RECORDING", shrink="start"),
        Column("EPISODES", "right"),
        Column("STEPS", "right"),
    )
    rows = [(str(part.path), number(part.episodes), number(part.steps)) for part in parts]
    told = {"dry_run": dry_run, "recordings": parts}
    print_rows(told, columns, rows, empty="nothing to split", as_json=as_json)


def tag(
    places: Annotated[
        list[str],
        typer.Argument(
            metavar="PATH|KEY=VALUE", help="Recordings, directories, storages; then the values to note."
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
    from tupli_mcap.recording import undo_annotation
    from tupli_mcap.recording.about.success import KEYS, success_of
    from tupli_mcap.recording.edit.annotate import change_all

    given = [text for text in places if "=" not in text or is_url(text) or Path(text).exists()]
    paths = [local_path(text) for text in given]
    values = dict(pair_of(text) for text in places if text not in given)
    for key in set(KEYS).intersection(values):
        if values[key] is not None and success_of({key: values[key]}) is None:
            raise typer.BadParameter(f"expected {key}=true or {key}=false, found {values[key]!r:.40}")
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
    count = counted(len(note["episodes"]), "episode")
    if undo:
        say(f"{note['path']}: {'would take' if dry_run else 'took'} {noted} back from {count}")
    else:
        say(f"{note['path']}: {count} {'would be ' if dry_run else ''}annotated: {noted}")


def edit(
    places: Annotated[
        list[Path],
        typer.Argument(metavar="PATH", help="Recordings, directories, storages.", parser=local_path),
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
    matches. --undo takes the last edit of each of them back. The recordings keep their ids,
    and their steps are not touched. A signature is dropped. If one recording cannot be
    changed, none is.
    """
    from tupli_mcap.recording import edit_runs, undo_edit
    from tupli_mcap.recording.edit.annotate import change_all

    meant = [str(place) for place in places if "=" in str(place) and not place.exists()]
    if meant:
        raise typer.BadParameter(
            f"{meant[0]} is no recording; to change metadata of the run, give --set {meant[0]}"
        )
    if undo == any(given is not None for given in (name, settings, tags, run_split)):
        raise typer.BadParameter(
            "expected a change (--name, --set KEY=VALUE, --tag or --split) or --undo, and not both"
        )
    metadata, gathered = dict(pair_of(text) for text in settings or ()), Gathered()
    chosen = _runs_in(places, filter_text, gathered)

    def edits(file: str, recording: Recording) -> list[int]:
        """The places of the chosen runs that were edited."""
        some = chosen[file]
        return [place for place, _ in recording.recorded_runs.before if some is None or place in some]

    def change(file: str, dry: bool) -> list[Run]:
        if undo:
            return undo_edit(file, chosen[file], dry_run=dry)
        return edit_runs(
            file, chosen[file], name=name, metadata=metadata, tags=tags, split=run_split, dry_run=dry
        )

    files = _changed_in(places, chosen, "edit", edits, gathered) if undo else list(chosen)
    edited = zip(files, change_all(files, change, dry_run=dry_run, gathered=gathered), strict=True)
    changed = [(file, run) for file, runs in edited for run in runs]
    if as_json:
        print_json([{"dry_run": dry_run, "path": file, "run": run.as_dict()} for file, run in changed])
        return
    for file, run in changed:
        _tell_run(file, run, dry_run=dry_run)


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


def _tell_run(file: str, run: Run, *, dry_run: bool) -> None:
    facts = {
        "would change" if dry_run else "recording": file,
        "run": run.name,
        "split": run.split,
        "tags": ", ".join(run.tags),
        "settings": pairs_of(run.metadata),
    }
    print_facts([(key, text) for key, text in facts.items() if text])


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


def filter_(
    sources: Sources,
    filter_text: Annotated[
        str,
        typer.Option(
            "--filter", metavar="FILTER", help="Which episodes, such as 'return > 100 and metadata.success'."
        ),
    ],
    output: Output,
    sort: Annotated[
        str,
        typer.Option(metavar="KEY", help="With --limit: by which key; of -return, the best come first."),
    ] = "",
    limit: Annotated[int | None, typer.Option(min=1, help="Write only the first so many of them.")] = None,
    force: Force = False,
    dry_run: DryRun = False,
    as_json: Json = False,
) -> None:
    """Write the episodes that match a filter into a new file.

    Episodes of one recording keep their ids; those of several get new ones. They lie in the
    order of their times. A signature is dropped.
    """
    from tupli_mcap.dataset.curate import filter_dataset

    report = filter_dataset(
        dataset_of(sources), output, filter_text, sort=sort, limit=limit, overwrite=force, dry_run=dry_run
    )
    _print_made(report, dry_run=dry_run, as_json=as_json)


def trim(
    sources: Sources,
    steps: Annotated[
        str, typer.Option("--steps", metavar="10:-5", help="The steps to keep, as a Python slice.")
    ],
    output: Output,
    episodes: Episodes = None,
    filter_text: FilterText = None,
    force: Force = False,
    dry_run: DryRun = False,
    as_json: Json = False,
) -> None:
    """Cut steps off the ends of episodes, into a new recording.

    10:-5 leaves out the first ten and the last five steps, :200 all steps from 200 on.
    Episodes that are not chosen stay whole, also those of other recordings, so all must have
    the same spaces; to leave episodes out, filter them first. An episode that loses its end
    is marked as interrupted, the state after its last step becomes its final state, and its
    recorded success is dropped. An episode that loses its beginning loses its seed. The new
    recording has a new id, and no signature.
    """
    from tupli_mcap.dataset import curate
    from tupli_mcap.dataset.chosen import chosen_ids

    begin, colon, stop = steps.partition(":")
    try:
        kept = slice(int(begin) if begin else None, int(stop) if stop else None)
    except ValueError:
        colon = ""
    if not colon:
        raise typer.BadParameter(f"--steps: expected a slice such as 10:-5, 10: or :200, found {steps!r:.80}")
    dataset, wanted = dataset_of(sources), filter_of(filter_text)
    if episodes is not None:
        ids = chosen_ids(sources, episodes, wanted)
    else:
        ids = {header.id for header in (dataset if wanted is None else dataset.filter(wanted)).headers}
        if not ids:
            raise none_in(sources, filter_text)
    report = curate.trim(dataset, kept, output, chosen=ids, overwrite=force, dry_run=dry_run)
    _print_made(report, dry_run=dry_run, as_json=as_json)


def _print_made(report: Any, *, dry_run: bool, as_json: bool) -> None:
    size = "" if dry_run else f", {bytes_of(report.size)}"
    would = "would write " if dry_run else ""
    print_result(
        {"dry_run": dry_run, **report._asdict()},
        f"{would}{report.path}: {counted(report.episodes, 'episode')}, {counted(report.steps, 'step')}{size}",
        as_json=as_json,
    )


def recover(
    file: File,
    output: Annotated[
        Path | None,
        typer.Option(
            "--output", "-o", metavar="FILE", help="The new recording; by default, FILE.recovered.mcap."
        ),
    ] = None,
    force: Force = False,
    in_place: Annotated[
        bool, typer.Option("--in-place", help="Finish the file itself instead, if nothing of it is lost.")
    ] = False,
    dry_run: DryRun = False,
    as_json: Json = False,
) -> None:
    """Save what is undamaged in a recording into a new one.

    Works on damaged recordings, and on those that their writers did not finish. FILE is only
    read; with --in-place, it is finished instead. The command prints the lost steps of each
    episode. An episode that lost steps in the middle becomes several. Deleted episodes stay
    deleted in the new one, and restore brings them back. The command exits with 1 if nothing
    could be saved, or if the recording had steps and none could be saved.
    """
    from tupli_mcap.dataset import recover_recording
    from tupli_mcap.recording import finish_recording

    if in_place and (output is not None or force):
        raise typer.BadParameter("--in-place writes no other file; leave out --output and --force")
    if file.is_dir():
        each = f'for file in {shlex.quote(str(file))}/*.mcap; do tupli-mcap recover --in-place "$file"; done'
        raise RecordingError(
            f"{file} is a directory; give one recording (.mcap), or finish each with: {each}"
        )
    if in_place:
        report = finish_recording(file, dry_run=dry_run)
    else:
        report = recover_recording(file, output, overwrite=force, dry_run=dry_run)
    if as_json:
        print_json(report.to_json())
    else:
        _print_recovery(report)
        if report.damaged and report.target is not None and Path(report.target).parent == Path(file).parent:
            say("")
            print_wrapped(
                f"Delete {file}, or move it away: who opens its directory would read it first.", "", "  "
            )
    if not report.saved:
        raise typer.Exit(1)


def _print_recovery(report: RecoveryReport) -> None:
    print_wrapped(_summary(report), "", "  ")
    for line in [*_losses(report), *report.notes]:
        print_wrapped(line, "  ", "    ")
    if report.lost:
        pieces: dict[int, list[str]] = {}
        for cut in report.cut:
            last = cut.first_step + cut.steps - 1
            pieces.setdefault(cut.episode, []).append(f"{cut.becomes} (steps {cut.first_step}-{last})")
        rows = []
        for episode in sorted({lost.episode for lost in report.lost}):
            steps = [
                f"{lost.first}-{'?' if lost.stop is None else lost.stop - 1}"
                for lost in report.lost
                if lost.episode == episode
            ]
            rows.append((str(episode), ", ".join(steps), ", ".join(pieces.get(episode, [])) or "nothing"))
        _print_some(
            [Column("EPISODE", "right"), Column("STEPS LOST", shrink="end"), Column("KEPT AS", shrink="end")],
            rows,
        )
    if report.damaged:
        places = [(str(place.offset), bytes_of(place.size), place.why) for place in report.damaged]
        _print_some(
            [Column("OFFSET", "right"), Column("SIZE", "right"), Column("DAMAGE", shrink="end")], places
        )


def _print_some(columns: Sequence[Column], rows: Sequence[Sequence[str]]) -> None:
    say("")
    print_table(columns, rows[:_SHOWN], empty="")
    if len(rows) > _SHOWN:
        say(f"... and {number(len(rows) - _SHOWN)} more; see --json")


def _summary(report: RecoveryReport) -> str:
    where = "can be saved (nothing was written)" if report.target is None else f"saved to {report.target}"
    if not report.saved:
        lost = f"none of its {number(report.steps_lost)} steps" if report.steps_lost else "nothing"
        files = "attachment" if report.attachments == 1 else "attachments"
        also = f"; {number(report.attachments)} {files} {where}" if report.attachments else ""
        return f"{report.source}: {lost} could be saved{also}"
    what = f"{counted(report.episodes, 'episode')}, {counted(report.steps, 'step')}"
    if report.intact:
        return f"{report.source}: {what} {where}; nothing was wrong with it"
    if not _losses(report) and report.journal in ("none", "used") and not report.notes:
        return f"{report.source}: {what} {where}; nothing was lost"
    return f"{report.source}: {what} {where}"


def _losses(report: RecoveryReport) -> list[str]:
    """A line for each kind of loss."""
    found = []
    if report.steps_lost or report.episodes_lost:
        found.append(
            f"lost: {counted(report.steps_lost, 'step')}, {counted(report.episodes_lost, 'whole episode')}"
        )
    for what, episodes in (
        ("the start (seed, options, info) of episodes", report.starts_lost),
        ("the end (metadata) of episodes", report.ends_lost),
        ("the final state of episodes", report.final_states_lost),
    ):
        if episodes:
            shown = ", ".join(str(n) for n in episodes[:_SHOWN])
            found.append(f"lost: {what} {shown}{' ...' if len(episodes) > _SHOWN else ''}")
    for count, noun in ((report.infos_lost, "step info"), (report.frames_lost, "frame")):
        found += [f"lost: {counted(count, noun)}"] if count else []
    if report.attachments_lost:
        found.append(f"lost: the attachments {', '.join(report.attachments_lost[:_SHOWN])}")
    if report.journal in _NO_JOURNAL:
        found.append(f"lost: steps not yet in a chunk; {_NO_JOURNAL[report.journal]}")
    return found
