"""The command doctor: checks recorded data before training on it."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import nullcontext
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer

from tupli_mcap.cli.options import Episodes, FilterText, Json, check_there, filter_of, hinting, pair_of
from tupli_mcap.cli.output import Column, number, print_json, print_rows, print_wrapped, short_ids
from tupli_mcap.cli.terminal import say, say_styled, status
from tupli_mcap.errors import RecordingError, plural

if TYPE_CHECKING:
    from tupli_mcap.doctor import Diagnosis, Finding, Severity

_INDENT = 9  # columns: the longest severity and a gap
_OTHERS = 3  # how many recordings with the same finding are named
_STYLES = {"error": "bold red", "warning": "bold yellow", "info": "bold blue"}


_Paths = Annotated[
    list[str] | None,
    typer.Argument(
        metavar="PATH|URL",
        help="Recordings, directories, patterns, storages, URLs; by default, this directory.",
    ),
]
_Checks = Annotated[
    list[str] | None, typer.Option("--check", metavar="ID", help="Run only this check. Repeatable.")
]
_Skipped = Annotated[
    list[str] | None, typer.Option("--skip", metavar="ID", help="Leave this check out. Repeatable.")
]
_Thresholds = Annotated[
    list[str] | None,
    typer.Option(
        "--set", metavar="ID.NAME=N", help="Change a threshold; --list --json names them. Repeatable."
    ),
]


def doctor(
    paths: _Paths = None,
    episodes: Episodes = None,
    filter_text: FilterText = None,
    fail_on: Annotated[
        Literal["error", "warning", "never"],
        typer.Option(help="Exit with 1 if a finding is as bad as this, or worse."),
    ] = "error",
    level: Annotated[
        Literal["error", "warning", "info"], typer.Option(help="Print findings as bad as this, or worse.")
    ] = "info",
    check: _Checks = None,
    skip: _Skipped = None,
    settings: _Thresholds = None,
    list_checks: Annotated[bool, typer.Option("--list", help="List the checks instead.")] = False,
    as_json: Json = False,
) -> None:
    """Check recorded data before training on it.

    Finds NaN and infinities, values outside their space, dimensions that never change,
    actions that never occur, missing terminals, episodes of one step, wrong resets,
    duplicates, frozen cameras, reward outliers (terminal rewards are compared only with each
    other), clock jumps.

    An error is wrong data, a warning is probably wrong data, an info is worth knowing. The
    command exits with 1 if it finds an error (see --fail-on), or cannot read a file; it
    examines the other files all the same.
    """
    from tupli_mcap.dataset.chosen import chosen_from
    from tupli_mcap.doctor import Severity, examine

    if list_checks:
        _print_checks(as_json)
        return
    thresholds = _thresholds(settings or (), [*(check or ()), *(skip or ())])
    wanted, sources = filter_of(filter_text), paths or ["."]
    with (
        hinting(sources, wanted),
        nullcontext(sources) if episodes is None else chosen_from(sources, episodes, wanted) as chosen,
        status("examining") as progress,
    ):
        diagnosis = examine(
            chosen,
            checks=check,
            skip=skip or (),
            thresholds=thresholds,
            episode_filter=wanted,
            progress=progress,
        )
    if not diagnosis.files and wanted is None:
        raise RecordingError(
            "there is nothing to examine; give recordings (.mcap), directories or storages of them"
        )
    if wanted is not None and not diagnosis.episodes:
        check_there(sources, wanted)
    if as_json:
        print_json({key: value for key, value in diagnosis.to_dict().items() if key != "version"})
    else:
        _print(diagnosis, Severity[level.upper()])
    failing = () if fail_on == "never" else diagnosis.at_least(Severity[fail_on.upper()])
    if failing or diagnosis.of("unreadable"):
        raise typer.Exit(1)


def _thresholds(settings: Sequence[str], checks: Sequence[str]) -> dict[str, dict[str, Any]]:
    """Thresholds by check, from texts such as `frozen-frames.frames=50`. BadParameter if one is wrong, or the name of a
    check."""
    from tupli_mcap.doctor.examine import check_settings

    thresholds: dict[str, dict[str, Any]] = {}
    for setting in settings:
        name, value = pair_of(setting)
        check, _, threshold = name.partition(".")
        thresholds.setdefault(check, {})[threshold] = value
    try:
        check_settings(checks, thresholds)
    except RecordingError as err:
        raise typer.BadParameter(str(err)) from err
    return thresholds


def _print_checks(as_json: bool) -> None:
    from tupli_mcap.doctor import CHECKS

    fields = ("id", "summary", "explanation", "thresholds")
    told = [{name: getattr(check, name) for name in fields} for check in CHECKS.values()]
    rows = [(check.id, check.summary) for check in CHECKS.values()]
    print_rows(told, (Column("CHECK"), Column("FINDS", shrink="end")), rows, empty="", as_json=as_json)


def _print(diagnosis: Diagnosis, level: Severity) -> None:
    groups: dict[tuple[object, ...], list[Finding]] = {}
    for finding in diagnosis.at_least(level):
        # Several recordings with the same finding are printed once; unreadable files one by one, with their reasons.
        path = finding.path if finding.check == "unreadable" else ""
        groups.setdefault((finding.severity, finding.check, finding.leaf, path), []).append(finding)
    for group in groups.values():
        _print_group(group, several=diagnosis.files > 1)
        say("")
    good = "healthy" if diagnosis.episodes else "nothing to examine"
    verdict = [good] if diagnosis.healthy else []
    severities = [str(finding.severity) for finding in diagnosis.findings]
    verdict += [
        f"{number(count)} info" if name == "info" else plural(count, name)
        for name in _STYLES
        if (count := severities.count(name))
    ]
    examined = (
        plural(diagnosis.files, "recording"),
        plural(diagnosis.episodes, "episode"),
        plural(diagnosis.steps, "step"),
    )
    say(f"{', '.join(verdict)}: {', '.join(examined)}")


def _print_group(group: Sequence[Finding], *, several: bool) -> None:
    first = group[0]
    severity = str(first.severity)
    title = first.check if first.leaf is None else f"{first.check} · {first.leaf}"
    say_styled((f"{severity:<{_INDENT}}", _STYLES[severity]), (title, "bold"))
    if several and first.check != "unreadable":  # whose message names the file
        _print_wrapped(f"{short_ids(first.path)}:")
    _print_wrapped(first.message)
    if first.places:
        _print_wrapped(_at(first))
    others = list(dict.fromkeys(finding.path for finding in group if finding.path != first.path))
    if others:
        names = ", ".join(short_ids(path) for path in others[:_OTHERS])
        more = f", and {len(others) - _OTHERS:,} more" if len(others) > _OTHERS else ""
        _print_wrapped(f"also in {names}{more}")
    _print_wrapped(f"→ {first.suggestion}", hang=2)


def _at(finding: Finding) -> str:
    """The places of a finding: `at episode:step 3:5, 4:0, ...` or `episode 3, 4`; other recordings are named."""
    steps = finding.places[0].step is not None
    texts = []
    for place in finding.places:
        number = f"{place.episode}:{place.step}" if steps else f"{place.episode}"
        texts.append(number if place.path == finding.path else f"{number} of {short_ids(place.path)}")
    if finding.count > len(texts):
        texts.append("...")
    return f"{'at episode:step' if steps else 'episode'} {', '.join(texts)}"


def _print_wrapped(text: str, hang: int = 0) -> None:
    print_wrapped(text, " " * _INDENT, " " * (_INDENT + hang))
