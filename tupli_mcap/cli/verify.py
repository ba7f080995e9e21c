"""The command verify: checks files for damage, and with --rerun runs their episodes again."""

from __future__ import annotations

import shlex
import time
from typing import TYPE_CHECKING, Annotated, Any

import typer

from tupli_mcap.cli.options import Episodes, FilterText, Json, check_there, filter_of
from tupli_mcap.cli.output import number, print_json, print_wrapped
from tupli_mcap.cli.terminal import fail, say, step_progress
from tupli_mcap.errors import RecordingError, TupliError, plural

if TYPE_CHECKING:
    from pathlib import Path

    from tupli_mcap.recording import Recording, VerifyReport
    from tupli_mcap.reexecute import Certificate
    from tupli_mcap.schema import BaseFilter

_STATES = {"unfinished": "not finished", "recording": "being recorded"}
_NOTHING = "nothing to be done"
_PROBLEMS = 20  # how many problems of a file are shown; --json has all
_DIVERGING = 5  # how many diverging episodes after the first are shown; --json has all


def verify(
    paths: Annotated[
        list[str],
        typer.Argument(metavar="PATH|URL", help="Recordings, directories, patterns, storages, URLs."),
    ],
    rerun: Annotated[
        bool, typer.Option("--rerun", help="Also run the episodes again, and compare them bit for bit.")
    ] = False,
    trust: Annotated[
        bool, typer.Option("--trust", help="With --rerun: allow code and reset options from the files.")
    ] = False,
    episodes: Episodes = None,
    filter_text: FilterText = None,
    as_json: Json = False,
) -> None:
    """Check files for damage.

    Checks structure, CRCs, indexes, layouts, alignment and digests: every episode has to
    have a start and an end, and no missing or repeated step. In a storage, artifacts,
    benchmarks and the catalog are checked too. Nothing is executed, nothing is written. A
    file at a URL is downloaded whole, into a temporary file, as every byte is checked. The
    command exits with 1 if something is damaged.

    --rerun rebuilds the environment of each recording, runs every episode again with its
    seed, options and actions, and shows where it differs. The command then also exits with 1
    if an episode differs, or if none could be checked. --episodes and --filter choose the
    episodes; those that they depend on are run again too.
    """
    wanted = filter_of(filter_text)
    reruns = _Reruns(trust, episodes, wanted) if rerun else None
    if reruns is None and (trust or episodes is not None or filter_text is not None):
        raise typer.BadParameter("--trust, --episodes and --filter go with --rerun")
    from tupli_mcap.storage.verify import verify_paths

    reports: list[VerifyReport] = []
    for report, path in verify_paths(paths):
        reports.append(report)
        if not as_json:
            _print_verified(report)
        if reruns is not None and report.kind == "recording" and report.ok:
            reruns.add(report.path, path, quiet=as_json)
    if not reports:
        raise RecordingError("there is nothing to verify; give recordings (.mcap) or directories of them")
    if wanted is not None and reruns is not None and not reruns.tried:
        check_there(paths, wanted)
    damaged = sum(not report.ok for report in reports)
    if as_json:
        told: dict[str, Any] = {"ok": not damaged, "files": len(reports), "damaged": damaged}
        told["reports"] = [report.to_json() for report in reports]
        told["reruns"] = None if reruns is None else reruns.to_json()
        print_json(told)
    elif len(reports) > 1:
        say(f"{number(len(reports) - damaged)} of {number(len(reports))} undamaged")
        if reruns is not None and reruns.tried:
            say(f"{number(reruns.agreeing)} of {number(reruns.tried)} agree when run again")
    if reruns is not None and not reruns.tried:
        fail("no episode was run again: no undamaged recording has such an episode")
    if damaged or (reruns is not None and not reruns.ok):
        raise typer.Exit(1)


def _print_verified(report: VerifyReport) -> None:
    """Prints a line on the file, one for each problem that is no consequence of another, and what to do about them."""
    from tupli_mcap.recording.check.report import RECOVER
    from tupli_mcap.remote import is_url

    unread = report.kind == "recording" and not (report.ok or report.episodes)
    facts = (
        "its episodes cannot be read"
        if unread
        else {
            "recording": f"{plural(report.episodes, 'episode')}, {plural(report.steps, 'step')}",
            "storage": f"{plural(report.attachments, 'artifact')}",
        }[report.kind]
    )
    roots = [problem for problem in report.problems if not problem.follows]
    count = sum(problem.severity == "error" for problem in roots) + report.more
    damage = plural(count, "problem")
    state = "" if report.state == "complete" else f", {_STATES[report.state]}"
    say(f"{report.path}: {'ok' if report.ok else damage} ({facts}{state})")
    if report.signed_by:
        say(f"  signed by {report.signed_by}")
    for problem in roots[:_PROBLEMS]:
        place = f"{problem.place}: " if problem.place else ""
        print_wrapped(f"{problem.severity}: {place}{problem.message}", "  ", "    ")
    if len(roots) > _PROBLEMS or report.more:
        say(f"  ... and {number(len(roots) - min(_PROBLEMS, len(roots)) + report.more)} more; see --json")
    followers = len(report.problems) - len(roots)
    if followers:
        follow = f"{'follows' if followers == 1 else 'follow'} from {'that' if len(roots) == 1 else 'these'}"
        say(f"  ({number(followers)} more {follow}; see --json)")
    for advice in dict.fromkeys(problem.advice for problem in roots if problem.advice != _NOTHING):
        if advice == RECOVER and is_url(report.path):
            advice = f"download it, and {RECOVER} FILE"
        elif advice == RECOVER:
            advice = f"{RECOVER} {shlex.quote(report.path)}"
        print_wrapped(f"→ {advice}", "  ", "    ")


# --- with --rerun ---


class _Reruns:
    """Runs the episodes of recordings again, and goes on after a recording that fails."""

    def __init__(self, trust: bool, episodes: str | None, wanted: BaseFilter | None) -> None:
        if episodes is not None or wanted is not None:  # spares the import
            from tupli_mcap.dataset.which import check_choice

            check_choice("all" if episodes is None else episodes, wanted)
        self._trust = trust
        self._episodes = episodes
        self._wanted = wanted
        self._found: list[tuple[str, Certificate | None, str]] = []

    @property
    def tried(self) -> int:
        """How many recordings had chosen episodes."""
        return len(self._found)

    @property
    def agreeing(self) -> int:
        """How many of these were run again, and agree."""
        return sum(found is not None and found.agrees for _, found, _ in self._found)

    @property
    def ok(self) -> bool:
        """True if at least one recording was run again, and all agree."""
        return 0 < self.agreeing == self.tried

    def add(self, name: str, path: Path, *, quiet: bool) -> None:
        """Runs the chosen episodes of a recording again; prints the outcome unless `quiet`. `name`: its path or URL,
        where `path` is that of a copy."""
        from tupli_mcap.recording import Recording
        from tupli_mcap.reexecute import certify

        began = time.perf_counter()
        try:
            with Recording(path) as recording, step_progress(recording.n_steps, "running again") as progress:
                recording.name = name
                numbers = self._numbers(recording)
                if numbers == []:
                    return
                certificate = certify(recording, trust=self._trust, episodes=numbers, progress=progress)
            seconds = time.perf_counter() - began
        except TupliError as err:
            message = str(err) if name in str(err) else f"{name}: {err}"
            self._found.append((name, None, message))
            fail(message)
            return
        self._found.append((name, certificate, ""))
        if not quiet:
            say(f"{name}: {_outcome(certificate)}")
            for line in _lines(certificate, seconds):
                print_wrapped(line, "  ", "    ")

    def _numbers(self, recording: Recording) -> list[int] | None:
        """The numbers of the chosen episodes; None for all, an empty list if the filter matches none."""
        from tupli_mcap.dataset.which import candidates, named_positions

        if self._episodes is None and self._wanted is None:
            return None
        if self._wanted is not None and not len(candidates(recording, self._wanted)):
            return []
        which = "all" if self._episodes is None else self._episodes
        positions = named_positions(recording, which, self._wanted)
        return [int(number) for number in recording.index["episode"][positions]]

    def to_json(self) -> list[dict[str, Any]]:
        return [
            {
                "path": path,
                "agrees": found is not None and found.agrees,
                "error": error or None,
                "certificate": None if found is None else found.model_dump(),
            }
            for path, found, error in self._found
        ]


def _outcome(c: Certificate) -> str:
    if c.first is not None:
        return str(c.first)
    if not c.agrees:
        return "no episode could be checked" if c.recorded.episodes else "it has no episodes"
    if c.complete:
        return (
            f"all {plural(c.agreed.episodes, 'episode')} ({plural(c.agreed.steps, 'step')}) agree bit for bit"
        )
    steps = f"{number(c.agreed.steps)} of {plural(c.recorded.steps, 'step')}"
    return (
        f"{number(c.agreed.episodes)} of {plural(c.recorded.episodes, 'episode')} ({steps}) agree bit for bit"
    )


def _lines(c: Certificate, seconds: float) -> list[str]:
    lines = []
    first = c.first
    if first is not None:
        lines += _spread(first)
        lines += [first.hint] if first.hint else []
        lines += [str(other) for other in c.divergences[1 : _DIVERGING + 1]]
        hidden = c.diverged.episodes - 1 - _DIVERGING
        lines += [f"... and {number(hidden)} more episodes that diverge; see --json"] if hidden > 0 else []
        lines.append(
            f"{number(c.diverged.episodes)} of {plural(c.chosen.episodes, 'episode')} diverge, "
            f"{number(c.agreed.episodes)} agree bit for bit"
        )
        lines += [
            f"{name} {then} when recorded, {now} now" for name, (then, now) in c.version_differences.items()
        ]
    lines += [
        f"{plural(s.episodes, 'episode')} could not be checked, the first is {s.first}: {s.reason}"
        for s in c.skipped
    ]
    versions = ", ".join(f"{name} {version}" for name, version in c.versions.items())
    machine = " ".join(c.platform.get(name, "") for name in ("system", "machine")).strip()
    lines.append(f"run again in {seconds:.1f} s on {c.environment} with {versions}, {machine}")
    return lines


def _spread(first: Any) -> list[str]:
    if first.kind == "error" or not first.differing_steps:
        return []
    differ = f"{number(first.differing_steps)} of the episode's {plural(first.length, 'step')} differ"
    if first.largest_difference is None:
        return [differ]
    return [
        f"{differ}; of {first.leaf} by at most {first.largest_difference:.3g}, at step {first.largest_step}"
    ]
