"""The command that saves what is undamaged in a recording: recover."""

from __future__ import annotations

import shlex
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from tupli_mcap.cli.options import DryRun, File, Force, Json
from tupli_mcap.cli.output import Column, number, print_json, print_table, print_wrapped
from tupli_mcap.cli.terminal import say
from tupli_mcap.errors import RecordingError, bytes_of, plural

if TYPE_CHECKING:
    from tupli_mcap.recording import RecoveryReport

_NO_JOURNAL = {
    "missing": "their journal is not beside the file; if the file was cut off, also all after the cut",
    "stale": "the journal beside the file belongs to another recording",
    "damaged": "their journal is damaged",
}
_SHOWN = 20  # how many damaged places or lost episodes are shown; --json has all


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
        each = f"find {shlex.quote(str(file))} -name '*.mcap' -exec tupli-mcap recover --in-place {{}} ';'"
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
    if report.target == report.source:
        where = "as before" if report.finished else "now finished"
    if not report.saved:
        lost = f"none of its {number(report.steps_lost)} steps" if report.steps_lost else "nothing"
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
        ("the start (seed, options, info) of episodes", report.starts_lost),
        ("the end (metadata) of episodes", report.ends_lost),
        ("the final state of episodes", report.final_states_lost),
    ):
        if episodes:
            shown = ", ".join(str(n) for n in episodes[:_SHOWN])
            found.append(f"lost: {what} {shown}{' ...' if len(episodes) > _SHOWN else ''}")
    for count, noun in ((report.infos_lost, "step info"), (report.frames_lost, "frame")):
        found += [f"lost: {plural(count, noun)}"] if count else []
    if report.attachments_lost:
        found.append(f"lost: the attachments {', '.join(report.attachments_lost[:_SHOWN])}")
    if report.journal in _NO_JOURNAL:
        found.append(f"lost: steps not yet in a chunk; {_NO_JOURNAL[report.journal]}")
    return found
