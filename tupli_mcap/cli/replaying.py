"""What `verify --replay` prints."""

from __future__ import annotations

import textwrap
import time
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import typer

from tupli_mcap.cli.output import counted, number
from tupli_mcap.cli.terminal import fail, say, step_progress, terminal_width, visible
from tupli_mcap.errors import TupliError

if TYPE_CHECKING:
    from tupli_mcap.replay import Certificate

__all__ = ["Replays", "episode_numbers"]

_SHOWN = 5  # diverging episodes beside the first; what is beyond is in --json
_MAX_NUMBERS = 10_000_000


def episode_numbers(text: str | None) -> list[int] | None:
    """Numbers such as "0,4,10-19"; None for all."""
    if text is None:
        return None
    numbers: list[int] = []
    for part in text.split(","):
        first, dash, last = (word.strip() for word in part.partition("-"))
        if not first.isdecimal() or (dash and not last.isdecimal()) or len(first + last) > 20:
            raise typer.BadParameter(f"expected episodes such as 0,4,10-19, found {text[:80]!r}")
        stop = int(last or first) + 1
        if stop - int(first) + len(numbers) > _MAX_NUMBERS:
            raise typer.BadParameter(f"expected at most {number(_MAX_NUMBERS)} episodes, found {text[:80]!r}")
        numbers += range(int(first), stop)
    return numbers


class Replays:
    """Recordings replayed one after another; one that cannot be stops nothing."""

    def __init__(self, trust: bool, episodes: Sequence[int] | None) -> None:
        self._trust = trust
        self._episodes = episodes
        self._found: list[tuple[Path, Certificate | None, str]] = []

    @property
    def tried(self) -> bool:
        """Whether there was a recording to replay."""
        return bool(self._found)

    @property
    def ok(self) -> bool:
        """True if something was replayed, and all of it agrees."""
        certificates = [certificate for _, certificate, _ in self._found]
        return bool(certificates) and all(found is not None and found.agrees for found in certificates)

    def add(self, path: Path, *, quiet: bool) -> None:
        """Replays a recording; says the outcome unless `quiet`."""
        from tupli_mcap.recording import Recording
        from tupli_mcap.replay import certify

        began = time.perf_counter()
        try:
            with Recording(path) as recording, step_progress(recording.num_steps, "replaying") as progress:
                found = certify(recording, trust=self._trust, episodes=self._episodes, progress=progress)
            seconds = time.perf_counter() - began
        except TupliError as err:
            self._found.append((path, None, str(err)))
            if not quiet:
                fail(str(err))
            return
        self._found.append((path, found, ""))
        if not quiet:
            _print_lines(f"{path}: {_outcome(found)}", _lines(found, seconds))

    def to_json(self) -> list[dict[str, Any]]:
        return [
            {"path": str(path)}
            | ({"error": error} if found is None else {"agrees": found.agrees, **found.model_dump()})
            for path, found, error in self._found
        ]


def _print_lines(head: str, lines: Sequence[str]) -> None:
    width = terminal_width()
    say(head)
    for line in map(visible, lines):
        parts = [line] if width is None else textwrap.wrap(line, max(40, width - 4), break_on_hyphens=False)
        for i, part in enumerate(parts):
            say(f"{'  ' if i == 0 else '    '}{part}")


def _outcome(c: Certificate) -> str:
    if c.first is not None:
        return str(c.first)
    if not c.agrees:
        return "nothing could be checked" if c.recorded.episodes else "there is no episode to replay"
    if c.complete:
        return f"all {counted(c.agreed.episodes, 'episode')} ({counted(c.agreed.steps, 'step')}) agree bit for bit"
    steps = f"{number(c.agreed.steps)} of {counted(c.recorded.steps, 'step')}"
    return f"{number(c.agreed.episodes)} of {counted(c.recorded.episodes, 'episode')} ({steps}) agree bit for bit"


def _lines(c: Certificate, seconds: float) -> list[str]:
    lines = []
    first = c.first
    if first is not None:
        lines += _spread(first)
        lines += [first.hint] if first.hint else []
        lines += [str(other) for other in c.divergences[1 : _SHOWN + 1]]
        hidden = c.diverged.episodes - 1 - _SHOWN
        lines += [f"... and {number(hidden)} more episodes that diverge; see --json"] if hidden > 0 else []
        lines.append(
            f"{number(c.diverged.episodes)} of {counted(c.chosen.episodes, 'episode')} diverge, "
            f"{number(c.agreed.episodes)} agree bit for bit"
        )
        lines += [
            f"{name} {then} when recorded, {now} now" for name, (then, now) in c.version_differences.items()
        ]
    lines += [
        f"{counted(s.episodes, 'episode')} could not be checked, the first is {s.first}: {s.reason}"
        for s in c.skipped
    ]
    versions = ", ".join(f"{name} {version}" for name, version in c.versions.items())
    machine = " ".join(c.platform.get(name, "") for name in ("system", "machine")).strip()
    lines.append(f"replayed in {seconds:.1f} s on {c.environment} with {versions}, {machine}")
    return lines


def _spread(first: Any) -> list[str]:
    if first.kind == "error" or not first.differing_steps:
        return []
    differ = f"{number(first.differing_steps)} of the episode's {counted(first.length, 'step')} differ"
    if first.largest_difference is None:
        return [differ]
    return [
        f"{differ}; of {first.leaf} by at most {first.largest_difference:.3g}, at step {first.largest_step}"
    ]
