"""Commands on files that may be damaged: verify, recover."""

from __future__ import annotations

import shlex
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from tupli_mcap.cli.options import Json
from tupli_mcap.cli.output import Column, bytes_of, counted, number, print_json, print_table, print_wrapped
from tupli_mcap.cli.replaying import Replays, episode_numbers
from tupli_mcap.cli.terminal import fail, say

if TYPE_CHECKING:
    from tupli_mcap.recording.check.report import VerifyReport
    from tupli_mcap.recording.edit.repair import RecoveryReport

__all__ = ["register"]

_STATES = {"unfinished": "not finished", "recording": "being recorded"}
_NO_JOURNAL = {
    "missing": "which is not beside the file; if the file was cut off, all that followed too",
    "stale": "which is not the one beside the file",
    "damaged": "as far as that cannot be read",
}
_NOTHING = "nothing to be done"
_SHOWN = 20  # damaged places, lost episodes: what is beyond is in --json


def register(app: typer.Typer) -> None:
    """Add the commands to the application."""
    app.command("verify")(_verify)
    app.command("recover")(_recover)


def _verify(
    paths: Annotated[
        list[Path],
        typer.Argument(metavar="PATH", help="Recordings, directories, storages.", readable=False),
    ],
    replay: Annotated[
        bool, typer.Option("--replay", help="Also replay recordings and compare, bit for bit.")
    ] = False,
    trust: Annotated[
        bool,
        typer.Option("--trust", help="With --replay: run the code that the files carry, with all options."),
    ] = False,
    episodes: Annotated[
        str | None, typer.Option(metavar="NUMBERS", help="With --replay: only these, such as 0,4,10-19.")
    ] = None,
    as_json: Json = False,
) -> None:
    """Check files for damage.

    Structure, CRCs, indexes, layouts, alignment and digests are checked. Every episode has to start, go on and
    end, without a gap or a step twice. Of a storage, artifacts, benchmarks and the catalog are checked too.
    Nothing is executed, nothing is written. Exit code 1 if something is damaged.

    --replay rebuilds the environment of each recording, takes every episode again with its seed, options and
    actions, and says where something differs. Exit code 1 if something does, or nothing could be checked.
    """
    replays = Replays(trust, episode_numbers(episodes)) if replay else None
    if replays is None and (trust or episodes is not None):
        raise typer.BadParameter("--trust and --episodes go with --replay")
    from tupli_mcap.storage.verify import StorageReport, verify_paths

    found = StorageReport()
    for report in verify_paths(paths):
        found.files.append(report)
        if not as_json:
            _print_verified(report)
        if replays is not None and report.kind == "recording" and report.ok:
            replays.add(Path(report.path), quiet=as_json)
    if as_json:
        print_json({**found.to_json(), **({} if replays is None else {"replays": replays.to_json()})})
    elif not found.files:
        fail("there is nothing to verify; give recordings (.mcap) or directories of them")
        raise typer.Exit(1)
    elif len(found.files) > 1:
        say(f"{number(len(found.files))} verified, {number(len(found.damaged))} damaged")
    if replays is not None and not replays.tried and not as_json:
        fail("nothing was replayed: there is no undamaged recording; recover one first")
    if not found.ok or (replays is not None and not replays.ok):
        raise typer.Exit(1)


def _print_verified(report: VerifyReport) -> None:
    """A line on a file, one on each problem that does not follow from another, and what to do about them."""
    from tupli_mcap.recording.check.report import RECOVER

    unread = report.kind == "recording" and not (report.ok or report.episodes)
    facts = (
        "its episodes cannot be read as it is"
        if unread
        else {
            "recording": f"{counted(report.episodes, 'episode')}, {counted(report.steps, 'step')}",
            "storage": f"{counted(report.attachments, 'artifact')}",
        }[report.kind]
    )
    roots = [problem for problem in report.problems if not problem.follows]
    count = sum(problem.severity == "error" for problem in roots) + report.more
    damage = counted(count, "problem")
    state = "" if report.state == "complete" else f", {_STATES[report.state]}"
    say(f"{report.path}: {'ok' if report.ok else damage} ({facts}{state})")
    for problem in roots[:_SHOWN]:
        place = f"{problem.place}: " if problem.place else ""
        print_wrapped(f"{problem.severity}: {place}{problem.message}", "  ", "    ")
    if len(roots) > _SHOWN or report.more:
        say(f"  ... and {number(len(roots) - min(_SHOWN, len(roots)) + report.more)} more; see --json")
    followers = len(report.problems) - len(roots)
    if followers:
        follow = f"{'follows' if followers == 1 else 'follow'} from {'that' if len(roots) == 1 else 'these'}"
        say(f"  ({number(followers)} more {follow}; see --json)")
    for advice in dict.fromkeys(problem.advice for problem in roots if problem.advice != _NOTHING):
        file = f" {shlex.quote(report.path)}" if advice == RECOVER else ""
        print_wrapped(f"→ {advice}{file}", "  ", "    ")


def _recover(
    file: Annotated[Path, typer.Argument(metavar="FILE", help="A recording.", readable=False)],
    output: Annotated[
        Path | None,
        typer.Option("--output", "-o", metavar="FILE", help="By default FILE.recovered.mcap, beside it."),
    ] = None,
    force: Annotated[bool, typer.Option("--force", help="Replace the output if it exists.")] = False,
    dry_run: Annotated[bool, typer.Option("--dry-run", help="Only say what could be saved.")] = False,
    as_json: Json = False,
) -> None:
    """Save everything good in a damaged recording into a new one.

    One that its writer did not finish is damaged, too. The file itself is only read. What was lost is said by
    episode and step; an episode that lost steps in the middle becomes several. Exit code 1 only if nothing
    could be saved, or no step of a recording that had some.
    """
    from tupli_mcap.recording.edit.repair import recover_recording

    report = recover_recording(file, output, overwrite=force, dry_run=dry_run)
    if as_json:
        print_json(report.to_json())
    else:
        _print_recovery(report)
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
        say("")
        columns = (
            Column("EPISODE", "right"),
            Column("STEPS LOST", shrink="end"),
            Column("KEPT AS", shrink="end"),
        )
        print_table(columns, rows[:_SHOWN], empty="")
        _print_rest(len(rows))
    if report.damaged:
        say("")
        columns = (Column("OFFSET", "right"), Column("SIZE", "right"), Column("DAMAGE", shrink="end"))
        places = [(str(place.offset), bytes_of(place.size), place.why) for place in report.damaged]
        print_table(columns, places[:_SHOWN], empty="")
        _print_rest(len(places))


def _print_rest(count: int) -> None:
    if count > _SHOWN:
        say(f"... and {number(count - _SHOWN)} more; see --json")


def _summary(report: RecoveryReport) -> str:
    where = "can be saved (nothing was written)" if report.target is None else f"saved to {report.target}"
    if not report.saved:
        lost = f"none of its {number(report.steps_lost)} steps" if report.steps_lost else "nothing"
        files = "attachment" if report.attachments == 1 else "attachments"
        also = f"; {number(report.attachments)} {files} {where}" if report.attachments else ""
        return f"{report.source}: {lost} could be saved{also}"
    what = f"{counted(report.episodes, 'episode')}, {counted(report.steps, 'step')}"
    state = (
        "nothing was wrong with it" if report.intact else "nothing was lost" if _lost_nothing(report) else ""
    )
    return f"{report.source}: {what} {where}" + (f"; {state}" if state else "")


def _lost_nothing(report: RecoveryReport) -> bool:
    return not _losses(report) and report.journal in ("none", "used") and not report.notes


def _losses(report: RecoveryReport) -> list[str]:
    """What is lost, a line each."""
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
    if report.infos_lost:
        found.append(f"lost: {counted(report.infos_lost, 'info')} of steps")
    if report.frames_lost:
        found.append(f"lost: {counted(report.frames_lost, 'frame')}")
    if report.attachments_lost:
        found.append(f"lost: the attachments {', '.join(report.attachments_lost[:_SHOWN])}")
    if report.journal in _NO_JOURNAL:
        found.append(f"lost: steps not yet in a chunk, with the journal, {_NO_JOURNAL[report.journal]}")
    return found
