"""The command that saves what is undamaged in recordings: recover."""

from __future__ import annotations

import shlex
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from tupli_mcap.cli.options import DryRun, Force, Json, local_path
from tupli_mcap.cli.output import Column, number, print_json, print_table, print_wrapped
from tupli_mcap.cli.terminal import fail, say
from tupli_mcap.errors import RecordingError, TupliError, bytes_of, plural

if TYPE_CHECKING:
    from tupli_mcap.recording import RecoveryReport

_NO_JOURNAL = {
    "missing": "their journal is not beside the file; if the file was cut off, also all after the cut",
    "stale": "the journal beside the file belongs to another recording",
    "damaged": "their journal is damaged",
}
_SHOWN = 20  # how many damaged places or lost episodes are shown; --json has all


def recover(
    files: Annotated[
        list[Path],
        typer.Argument(
            metavar="FILE", help="Recordings; with --in-place, also directories of them.", parser=local_path
        ),
    ],
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
    """Save what is undamaged in recordings into new ones.

    Works on damaged recordings, and on those that their writers did not finish. A FILE is
    only read; with --in-place, it is finished instead. The command prints the lost steps of
    each episode. An episode that lost steps in the middle becomes several. Deleted episodes
    stay deleted in the new one, and restore brings them back. The command exits with 1 if
    nothing of a file could be saved, or if it had steps and none could be saved.
    """
    if in_place and (output is not None or force):
        raise typer.BadParameter("--in-place writes no other file; leave out --output and --force")
    several = len(files) > 1 or files[0].is_dir()
    if output is not None and len(files) > 1:
        raise typer.BadParameter(f"--output names one new recording; leave it out for {len(files)} files")
    from tupli_mcap.recording import RecoveryReport

    told: list[dict[str, Any]] = []
    saved, unchanged = True, 0
    for file in _recordings_in(files, in_place=in_place):
        try:
            report = _recover(file, output, force=force, in_place=in_place, dry_run=dry_run)
        except TupliError as err:
            if not several:
                raise
            fail(str(err))
            told.append(
                {**dict.fromkeys(RecoveryReport("").to_json()), "source": str(file), "error": str(err)}
            )
            saved = False
            continue
        told.append({**report.to_json(), "error": None})
        saved = saved and report.saved
        if several and in_place and report.intact:
            unchanged += 1
        elif not as_json:
            _print_recovery(report, in_place=in_place)
    if as_json:
        print_json(told if several else told[0])
    elif unchanged:
        say(f"nothing was wrong with {number(unchanged)} of {plural(len(told), 'recording')}")
    if not saved:
        raise typer.Exit(1)


def _recordings_in(files: Sequence[Path], *, in_place: bool) -> Iterator[Path]:
    """The files, and those in directories. RecordingError for a directory, whose files are only finished: new ones
    would be among them."""
    from tupli_mcap.storage.listing import recordings_at

    for file in files:
        if not file.is_dir():
            yield file
        elif in_place:
            yield from map(Path, recordings_at(file))
        else:
            each = f"tupli-mcap recover --in-place {shlex.quote(str(file))}"
            raise RecordingError(
                f"{file} is a directory; give recordings (.mcap), or finish all in it with: {each}"
            )


def _recover(
    file: Path, output: Path | None, *, force: bool, in_place: bool, dry_run: bool
) -> RecoveryReport:
    from tupli_mcap.dataset import recover_recording
    from tupli_mcap.recording import finish_recording

    if in_place:
        return finish_recording(file, dry_run=dry_run)
    return recover_recording(file, output, overwrite=force, dry_run=dry_run)


def _print_recovery(report: RecoveryReport, *, in_place: bool) -> None:
    print_wrapped(_summary(report, in_place=in_place), "", "  ")
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
        if report.target is not None and Path(report.target).parent == Path(report.source).parent:
            say("")
            print_wrapped(
                f"Delete {report.source}, or move it away: who opens its directory would read it first.",
                "",
                "  ",
            )


def _print_some(columns: Sequence[Column], rows: Sequence[Sequence[str]]) -> None:
    say("")
    print_table(columns, rows[:_SHOWN], empty="")
    if len(rows) > _SHOWN:
        say(f"... and {number(len(rows) - _SHOWN)} more; see --json")


def _summary(report: RecoveryReport, *, in_place: bool) -> str:
    verb = "finished" if in_place else "saved"
    where = f"can be {verb} (nothing was written)" if report.target is None else f"saved to {report.target}"
    if in_place and report.finished:
        where = "as before"
    elif report.target == report.source:
        where = "now finished"
    if not report.saved:
        nothing = "no steps" if report.attachments else "nothing"
        lost = f"none of its {number(report.steps_lost)} steps" if report.steps_lost else nothing
        files = "attachment" if report.attachments == 1 else "attachments"
        also = f"; {number(report.attachments)} {files} {where}" if report.attachments else ""
        return f"{report.source}: {lost} could be saved{also}"
    what = f"{plural(report.episodes, 'episode')}, {plural(report.steps, 'step')}"
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
            f"lost: {plural(report.steps_lost, 'step')}, {plural(report.episodes_lost, 'whole episode')}"
        )
    for what, episodes in (
        ("the start (seed, options, info)", report.starts_lost),
        ("the end (metadata)", report.ends_lost),
        ("the final state", report.final_states_lost),
    ):
        if episodes:
            shown = ", ".join(str(n) for n in episodes[:_SHOWN])
            of = "episode" if len(episodes) == 1 else "episodes"
            found.append(f"lost: {what} of {of} {shown}{' ...' if len(episodes) > _SHOWN else ''}")
    for count, noun in ((report.infos_lost, "step info"), (report.frames_lost, "frame")):
        found += [f"lost: {plural(count, noun)}"] if count else []
    if report.attachments_lost:
        found.append(f"lost: the attachments {', '.join(report.attachments_lost[:_SHOWN])}")
    if report.journal in _NO_JOURNAL:
        found.append(f"lost: steps not yet in a chunk; {_NO_JOURNAL[report.journal]}")
    return found
