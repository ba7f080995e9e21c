"""What `verify --replay` prints."""

from __future__ import annotations

import time
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import typer

from tupli_mcap.cli.output import number, step_progress

if TYPE_CHECKING:
    from tupli_mcap.replay import Certificate

__all__ = ["episode_numbers", "print_replay", "replay"]

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


def replay(
    path: Path, *, trust: bool, episodes: Sequence[int] | None, write: bool
) -> tuple[Certificate, float]:
    """The certificate of a recording, written into it if asked, and the seconds it took."""
    from tupli_mcap.recording import Recording
    from tupli_mcap.replay import certify, write_certificate

    began = time.perf_counter()
    with Recording(path) as recording, step_progress(recording.num_steps, "replaying") as progress:
        certificate = certify(recording, trust=trust, episodes=episodes, progress=progress)
    seconds = time.perf_counter() - began
    if write:
        write_certificate(path, certificate)
    return certificate, seconds


def print_replay(path: Path, certificate: Certificate, seconds: float, *, written: bool) -> None:
    """A line on the outcome, then what there is to say about it."""
    print(f"{path}: {_outcome(certificate)}")
    for line in _lines(certificate, seconds):
        print(f"  {line}")
    if written:
        print("  the certificate is in the file")


def _outcome(c: Certificate) -> str:
    if c.first is not None:
        return str(c.first)
    if not c.agrees:
        return "nothing could be checked" if c.recorded.episodes else "there is no episode to replay"
    if c.complete:
        return f"all {number(c.agreed.episodes)} episodes ({number(c.agreed.steps)} steps) agree bit for bit"
    steps = f"{number(c.agreed.steps)} of {number(c.recorded.steps)} steps"
    return (
        f"{number(c.agreed.episodes)} of {number(c.recorded.episodes)} episodes ({steps}) agree bit for bit"
    )


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
            f"{number(c.diverged.episodes)} of {number(c.chosen.episodes)} episodes diverge, "
            f"{number(c.agreed.episodes)} agree bit for bit"
        )
        lines += [
            f"{name} {then} when recorded, {now} now" for name, (then, now) in c.version_differences.items()
        ]
    lines += [
        f"{number(s.episodes)} episodes could not be checked, the first is {s.first}: {s.reason}"
        for s in c.skipped
    ]
    versions = ", ".join(f"{name} {version}" for name, version in c.versions.items())
    machine = " ".join(c.platform.get(name, "") for name in ("system", "machine")).strip()
    lines.append(f"replayed in {seconds:.1f} s on {c.environment} with {versions}, {machine}")
    return lines


def _spread(first: Any) -> list[str]:
    if first.kind == "error" or not first.differing_steps:
        return []
    counted = f"{number(first.differing_steps)} of the episode's {number(first.length)} steps differ"
    if first.largest_difference is None:
        return [counted]
    return [
        f"{counted}; of {first.leaf} by at most {first.largest_difference:.3g}, at step {first.largest_step}"
    ]
