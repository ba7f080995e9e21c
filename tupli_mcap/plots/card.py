"""The head and the foot of a report as texts: what was recorded, and what is left out of the pictures."""

from __future__ import annotations

from collections.abc import Sequence
from datetime import UTC, datetime

import numpy as np

from tupli_mcap.arrays import Array
from tupli_mcap.messages.episodes import END_NAMES
from tupli_mcap.plots.gather import Measured
from tupli_mcap.plots.style import number_text, seed_text
from tupli_mcap.recording.description import nan_text

__all__ = ["card", "notes_of", "title_of"]

_MOST_SEEDS, _LONGEST_SEEDS = 6, 56  # that are listed; characters


def title_of(measured: Sequence[Measured]) -> str:
    """The environment, and the recording or how many there are."""
    names = list(dict.fromkeys(one.facts.environment or "" for one in measured))
    environment = names[0] if len(names) == 1 else ""
    if len(measured) == 1:
        return environment or measured[0].name
    return f"{environment}: {len(measured)} recordings" if environment else f"{len(measured)} recordings"


def card(measured: Sequence[Measured]) -> list[tuple[str, str]]:
    """Labels and values."""
    if len(measured) > 1:
        return [(one.name, _in_short(one)) for one in measured]
    (one,) = measured
    facts, rows = one.facts, one.rows
    chosen = "" if len(rows) == one.all_episodes else f" of {one.all_episodes:,}"
    ends = ", ".join(
        f"{count:,} {END_NAMES[i]}" for i, count in enumerate(np.bincount(rows["end"], minlength=3)) if count
    )
    state = "" if facts.state == "complete" else f" ({facts.state})"
    envs = f", {facts.num_envs} sub-environments" if facts.num_envs > 1 else ""
    found = [
        ("recording", one.name + state),
        ("environment", (facts.environment or "none attached") + envs),
        ("recorded", _times(one)),
        ("size", _bytes(facts.size)),
        ("episodes", f"{len(rows):,}{chosen}{f' ({ends})' if ends else ''}"),
        ("steps", f"{one.steps:,}"),
        ("return", _spread(rows["return"])),
        ("length", _spread(rows["length"])),
        ("seeds", _seeds(one.seeds)),
        ("benchmark", facts.benchmark_id[:12] or "none"),
        ("observation", facts.observation_space or "not known before the first step"),
        ("action", facts.action_space or "not known before the first step"),
    ]
    return [(label, value) for label, value in found if value]


def notes_of(measured: Sequence[Measured]) -> list[str]:
    """Sentences, each once."""
    found: dict[str, None] = {}
    for one in measured:
        prefix = f"{one.name}: " if len(measured) > 1 else ""
        found.update((prefix + note, None) for note in one.notes())
        odd = int(np.isnan(one.rows["return"]).sum())
        if odd:
            found[f"{prefix}return: {nan_text(odd, len(one.rows))}."] = None
        if not len(one.rows):
            found[f"{prefix}There is no episode."] = None
    return list(found)


def _in_short(one: Measured) -> str:
    text = f"{_counted(len(one.rows), 'episode')}, {_counted(one.steps, 'step')}"
    spread = _spread(one.rows["return"])
    return f"{text}, return {spread}" if spread else text


def _spread(values: Array) -> str:
    numbers = values.astype(np.float64)
    none = np.isnan(numbers)
    numbers = numbers[np.isfinite(numbers)]
    if not len(numbers):
        return nan_text(len(none), len(none)) if none.all() else ""
    if len(numbers) == 1:
        return number_text(float(numbers[0]))
    with np.errstate(over="ignore", invalid="ignore"):
        mean, std = number_text(float(numbers.mean())), number_text(float(numbers.std()))
    return f"{mean} ± {std}, from {number_text(float(numbers.min()))} to {number_text(float(numbers.max()))}"


def _counted(count: int, noun: str) -> str:
    return f"{count:,} {noun}{'' if count == 1 else 's'}"


def _seeds(seeds: Sequence[int]) -> str:
    if not seeds:
        return "none known"
    listed = ", ".join(map(str, seeds))
    if len(seeds) <= _MOST_SEEDS and len(listed) <= _LONGEST_SEEDS:
        return listed
    return f"{len(seeds):,} from {seed_text(seeds[0])} to {seed_text(seeds[-1])}"


def _times(one: Measured) -> str:
    if not len(one.rows):
        return _time(one.facts.created_ns)
    start, end = int(one.rows["start_time"].min()), int(one.rows["end_time"].max())
    return f"{_time(start)}, {_duration((end - start) / 1e9)}"


def _time(ns: int) -> str:
    """In UTC: a report says the same wherever it is made."""
    return (
        datetime.fromtimestamp(ns // 10**9, UTC).strftime("%Y-%m-%d %H:%M UTC")
        if ns > 0
        else "at an unknown time"
    )


def _duration(seconds: float) -> str:
    for unit, size in (("h", 3600), ("min", 60)):
        if seconds >= 2 * size:
            return f"{seconds / size:.1f} {unit}"
    return f"{seconds:.1f} s"


def _bytes(size: int) -> str:
    value = float(size)
    for unit in ("B", "kB", "MB"):
        if value < 999.5:
            return f"{value:.0f} {unit}" if unit == "B" else f"{value:.1f} {unit}"
        value /= 1000
    return f"{value:.1f} GB"
