"""Joins recordings to runs, and runs that differ only by their seeds to groups, of many runs also others; places
episodes on the x axis."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, Literal, NamedTuple, TypeAlias

import numpy as np

from tupli_mcap.arrays import Array
from tupli_mcap.plots.measure import INFO, METADATA, SUCCESS, Measured
from tupli_mcap.plots.statistics import LeafValues, drawable_numbers
from tupli_mcap.recording import Run
from tupli_mcap.recording.about.run import name_after
from tupli_mcap.recording.index import cut_off
from tupli_mcap.schema.keys import leaves_of

X: TypeAlias = Literal["steps", "episodes", "time"]
_MOST_NUMBERS = 4  # of infos, and of metadata, that get a panel
_LONGEST = 200  # characters of a run's name that are looked at
_MOST_GROUPS = 32  # that are drawn in colours of their own: eyes tell no more apart
_SEED = re.compile(r"[-_. ]*seed[-_=. ]*\d+", re.IGNORECASE)
_SEED_KEY = re.compile(r"(.*[_.])?seeds?", re.IGNORECASE | re.DOTALL)
_STARTED = re.compile(r"[-_. ]+\d{10}$")  # the time (s) at the end of CleanRL's names


class PlottedRun(NamedTuple):
    """The recordings of a run: several if it went on in a new file, or recorded in several processes."""

    recordings: list[Measured]

    @property
    def rows(self) -> Array:
        """The index rows of the chosen episodes."""
        return np.concatenate([one.rows for one in self.recordings])

    def numbers(self, name: str) -> Array:
        """A number of each of `rows` that can be drawn, NaN where there is none."""
        if name in ("return", "length"):
            return drawable_numbers(self.rows[name])
        missing = [np.full(len(one.positions), np.nan) for one in self.recordings]
        return np.concatenate(
            [one.numbers.get(name, nan) for one, nan in zip(self.recordings, missing, strict=True)]
        )

    @property
    def cut_off(self) -> Array:
        """Those of `rows` that the end of a recording cut off (bool); none, if nothing else was recorded."""
        masks = [cut_off(one.index, np.zeros(len(one.index)))[one.positions] for one in self.recordings]
        mask: Array = np.concatenate(masks)
        return mask if not mask.all() else np.zeros_like(mask)

    def places(self, x: X) -> Array:
        """The place of each of `rows` on the x axis: its number, or the steps or seconds of the run until its end.

        Steps of episodes that were not chosen count.
        """
        index = np.concatenate([one.index for one in self.recordings])
        by_end = np.argsort(index["end_time"], kind="stable")
        places: Array = np.empty(len(index))
        if x == "time":
            places = (index["end_time"] - index["start_time"].min(initial=2**62)) / 1e9
        elif x == "steps":
            places[by_end] = np.cumsum(index["length"][by_end])
        elif len(self.recordings) == 1 and len(index) == self.recordings[0].facts.episodes:
            places = index["episode"]
        else:
            places[by_end] = np.arange(len(index))
        starts = np.cumsum([0, *(len(one.index) for one in self.recordings)])
        chosen = [one.positions + start for one, start in zip(self.recordings, starts, strict=False)]
        found: Array = places[np.concatenate(chosen)]
        return found


class Group:
    """A run, or several that differ only by their seeds, or that are `alike` in another way (a part of a sentence):
    drawn in one colour, with all values together."""

    def __init__(self, name: str, runs: Sequence[PlottedRun], alike: str = "") -> None:
        self.name, self.runs, self.alike = name, runs, alike
        self.recordings = [one for run in runs for one in run.recordings]
        self.rows: Array = np.concatenate([run.rows for run in runs])
        parts = [one for one in self.recordings if one.read_steps]
        self.states, self.actions, self.rewards = (
            [LeafValues.pooled(leaves) for leaves in zip(*each, strict=True)]
            for each in zip(*((one.states, one.actions, one.rewards) for one in parts), strict=True)
        ) if parts else ([], [], [])  # fmt: skip

    def numbers(self, name: str) -> Array:
        """A number of each of `rows` that can be drawn, NaN where there is none."""
        return np.concatenate([run.numbers(name) for run in self.runs])


def groups_of(measured: Sequence[Measured]) -> list[Group]:
    """Groups in the order of their first recordings: of runs that differ only by their seeds; if these are too many to
    be told apart, of runs whose names differ only by numbers; if these are, too, of all runs of an environment."""
    groups = _by_seeds(measured)
    if len(groups) > _MOST_GROUPS:
        groups = _pooled(groups, _without_numbers, "whose names differ only by numbers")
    if len(groups) > _MOST_GROUPS:
        groups = _pooled(groups, lambda run: run.environment or "all runs", "of one environment")
    return groups


def _without_numbers(run: Run) -> str:
    return re.sub(r"\d+", "*", _SEED.sub("", run.name).strip("-_. ") or run.name)


def _pooled(groups: Sequence[Group], name_of: Callable[[Run], str], alike: str) -> list[Group]:
    """Joins groups whose first runs have the same name, environment, split, and number of rewards."""
    found: dict[Any, list[Group]] = {}
    for group in groups:
        first = group.recordings[0]
        parts = [name_of(first.run), first.run.environment, first.run.split]
        found.setdefault((*parts, len(first.rewards)), []).append(group)
    names = Counter(name for name, *_ in found)
    pooled = []
    for (name, *parts, _), same in found.items():
        if len(same) > 1:
            whole = ", ".join(dict.fromkeys(filter(None, (name, *parts)))) if names[name] > 1 else name
            pooled.append(Group(whole, [run for group in same for run in group.runs], alike))
        else:
            pooled += same
    return pooled


def _by_seeds(measured: Sequence[Measured]) -> list[Group]:
    """Groups in the order of their first recordings.

    Recordings are of one group if their runs have the same name without `seed3`, or without the `seed` of their
    settings, the same other settings, and the same environment and split. A run that names no seed is a group by
    itself, with all its files, also those it was split into. The runs of a recording that was made of others in another
    way, and may repeat them, are only of a group with each other.
    """
    found: dict[Any, dict[Any, list[Measured]]] = {}
    known = set()
    for place, one in enumerate(measured):
        key: tuple[Any, ...] = ("", "", place)
        seedless, same = _seedless(one), (one.facts.uuid, one.run.id, one.run.name)
        if same not in known and one.is_recorded:
            key = seedless or (("", one.run.name, one.run.id) if one.run.id else key)
        elif same not in known and seedless:
            key = (one.facts.name, *seedless[1:])
        known.add(same)
        found.setdefault(key, {}).setdefault(one.run.id or place, []).append(one)
    alike: dict[str, list[tuple[Any, ...]]] = {}
    for key, runs in found.items():
        if sum(map(len, runs.values())) > 1:
            alike.setdefault(key[1] or Path(key[0]).name or "runs", []).append(key)
    names = {key: _told_apart(name, key, keys) for name, keys in alike.items() for key in keys}
    return [
        Group(names.get(key) or next(iter(runs.values()))[0].name, [PlottedRun(run) for run in runs.values()])
        for key, runs in found.items()
    ]


def _told_apart(name: str, key: tuple[Any, ...], keys: Sequence[tuple[Any, ...]]) -> str:
    """The name of a group, with the parts of its key, and the settings, that differ from other groups of that name."""
    # The settings are a set, of which only the differing ones are told, unless a part says the same (env=CartPole-v1).
    differing = [
        parts for parts in zip(*(one[:4] for one in (key, *keys)), strict=False) if len(set(parts)) > 1
    ]
    told = [Path(str(own)).name for own, *_ in differing if own]
    settings = [one[4] for one in (key, *keys) if len(one) > 4]
    differing_settings = sorted(key[4] - frozenset.intersection(*settings)) if len(key) > 4 else []
    told += [setting for setting in differing_settings if setting.partition("=")[2] not in told]
    return f"{name} ({', '.join(told)})" if told else name


def _seedless(one: Measured) -> tuple[Any, ...] | None:
    """The key that runs of a group share: the name without the seed (with the directory, if the run is named after its
    file), the environment, the split, and the settings that are no seeds. None if the run names no seed."""
    told = {".".join(keys): value for keys, value in leaves_of(one.run.metadata)}
    settings = frozenset(f"{key}={value}" for key, value in told.items() if not _SEED_KEY.fullmatch(key))
    seed, path, given = one.run.metadata.get("seed"), Path(one.facts.name), one.run.name[:_LONGEST]
    name = _SEED.sub("", given)
    if name == given and len(settings) == len(told):
        return None
    if name == given and isinstance(seed, int):
        name = re.sub(rf"[-_. ]+s?{seed}(?!\d)", "", _STARTED.sub("", name), count=1)
    own = one.run.name != name_after(one.facts.name)
    folder = "" if own else _SEED.sub("", str(path.parent))
    return folder, name.strip("-_. "), one.run.environment, one.run.split, settings


def shown_numbers(groups: Sequence[Group]) -> tuple[list[str], list[str]]:
    """The numbers of episodes that get a panel (success, then some that vary of infos and metadata), and notes."""
    known = dict.fromkeys(key for group in groups for one in group.recordings for key in one.numbers)
    shown, notes = [SUCCESS] if SUCCESS in known else [], []
    for start in (INFO, METADATA):
        names = []
        for key in (key for key in known if key.startswith(start)):
            values = np.concatenate([group.numbers(key) for group in groups])
            values = values[np.isfinite(values)]
            if len(values) and values.min() < values.max():
                names.append(key)
        shown += names[:_MOST_NUMBERS]
        if len(names) > _MOST_NUMBERS:
            notes.append(f"Of the {len(names)} numbers in {start.strip('.')}, {_MOST_NUMBERS} are shown.")
    if alike := next(filter(None, (group.alike for group in groups)), ""):
        notes.append(
            f"Of more than {_MOST_GROUPS} runs, those {alike} are drawn as one. To compare single ones, choose them "
            'with a filter, such as run.name ~ "ppo".'
        )
    if any(len(group.runs) > 1 for group in groups):
        notes.append(
            "Shades are 95% intervals of the mean over runs, as far as all of a group go (bootstrap)."
        )
    return shown, notes
