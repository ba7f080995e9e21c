"""One recording whose process is killed several times: checked after each kill, continued, finished at the end."""

from __future__ import annotations

import random
import shutil
import warnings
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import gymnasium as gym
import numpy as np
from environments import same
from recovered import differences

from killing.check import Found, check_recording, found_in
from killing.child import Job, Told, record_and_die
from killing.kinds import KINDS, open_recorder
from killing.moments import MOMENTS
from tupli_mcap import FileStorage, Recording, TupliEnvWrapper, TupliError, journal_path
from tupli_mcap.recording.write.rotation import series

__all__ = ["Death", "lives", "moments_of"]

_lengths: dict[tuple[str, str], int] = {}  # instructions of a moment, by kind


class Death(NamedTuple):
    """One kill: the number of checked steps, and what was wrong; not `killed` if the moment never came."""

    kind: str
    moment: str
    steps: int
    problems: list[str]
    killed: bool
    appended: bool = False


def moments_of(kind: str, *, appends: bool) -> list[str]:
    """The moments at which a kind can be killed, in a new recording or in a continued one."""
    about = KINDS[kind]
    names = []
    for moment in MOMENTS.values():
        if moment.appends and (not appends or about.storage):
            continue
        if moment.told and not about.silent:
            continue
        if moment.threaded and not about.threaded:
            continue
        if moment.syncs and "durability" not in about.options:
            continue
        if moment.grows and not about.large:
            continue
        if moment.rotates and not about.rotates:
            continue
        names.append(moment.name)
    return names


def lives(kind: str, moments: Sequence[str], seed: int, directory: Path, breakage: str = "") -> list[Death]:
    """A recording whose process dies at each of the moments, one after another."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)  # killed before its first step, it has no journal
        chain = _StorageChain if KINDS[kind].storage else _RotatingChain if KINDS[kind].rotates else _Chain
        return chain(kind, seed, directory, breakage).run(moments)


class _Chain:
    def __init__(self, kind: str, seed: int, directory: Path, breakage: str) -> None:
        self._name, self._kind = kind, KINDS[kind]
        self._random = random.Random(seed)
        self._path = directory / "r.mcap"
        self._breakage = breakage
        self._known: list[Found] = []
        self._infos = self._kind.options.get("record_info")
        if self._kind.elsewhere:
            (directory / "journals").mkdir()

    def run(self, moments: Sequence[str]) -> list[Death]:
        deaths = []
        for moment in moments:
            appended = bool(self._known)
            told = self._die(moment)
            try:
                steps, problems = self._check(told)
            except TupliError as err:
                steps, problems = 0, [f"{type(err).__name__}: {err}"]
            if told.trouble:
                problems.insert(0, told.trouble)
            deaths.append(Death(self._name, moment, steps, problems, told.killed, appended))
            if problems:
                return deaths
        try:
            problems = self._finish()
        except TupliError as err:
            problems = [f"{type(err).__name__}: {err}"]
        if problems:
            deaths[-1].problems.extend(f"finishing: {problem}" for problem in problems)
        return deaths

    def _job(self, moment: str, path: Path, mode: str) -> Job:
        chunk, seed = self._random.choice(self._kind.chunks), self._random.randrange(1 << 30)
        return Job(
            self._name, moment, path, mode, chunk, seed, _lengths.get((self._name, moment)),
            breakage=self._breakage,
        )  # fmt: skip

    def _die(self, moment: str) -> Told:
        mode = "a" if self._known else "w"
        return self._record(self._job(moment, self._path, mode))

    def _record(self, job: Job) -> Told:
        told = record_and_die(job)
        for name, value in told.reports:
            if name == "length":
                _lengths[self._name, job.moment] = value
        return told

    def _check(self, told: Told) -> tuple[int, list[str]]:
        if not self._path.exists():
            return 0, ["it is gone"] if self._known else []
        try:
            found, index = self._read(self._path)
        except TupliError:
            done = any(name == "step" for name, _ in told.reports)
            if self._known or done:
                raise
            return 0, []  # it died before the file had its first records
        steps, problems = self._compare(found, told)
        again, same_index = self._read(self._path)
        if not _same(found, again) or not np.array_equal(index, same_index):
            problems.append("reading it twice differs")
        self._known = found
        if found and not problems and not self._kind.elsewhere and self._random.random() < 0.3:
            problems = [f"a copy, finished: {problem}" for problem in self._finish_copy()]
        return steps, problems or differences(self._path, self._path.parent, killed=True)

    def _compare(self, found: list[Found], told: Told) -> tuple[int, list[str]]:
        before, new = found[: len(self._known)], found[len(self._known) :]
        steps, problems = check_recording(
            new,
            told.reports,
            vector=self._kind.vector is not None,
            infos=self._infos,
            metadata="metadata_callback" in self._kind.options,
        )
        if not _same(before, self._known):
            problems.append("what was there before has changed")
        return steps, problems

    def _read(self, path: Path) -> tuple[list[Found], np.ndarray]:
        with Recording(path) as recording:
            if recording.n_steps == 0:
                return [], recording.index
            if not np.array_equal(recording.read().terminals, _flags(found := found_in(recording))):
                raise TupliError("columns and steps differ")
            return found, recording.index

    def _finish(self) -> list[str]:
        return self._finish_at(self._path) if self._known else []

    def _finish_copy(self) -> list[str]:
        """Finishes a copy, in a directory of its own: the next process goes on with the original."""
        directory = self._path.parent / "copy"
        directory.mkdir()
        try:
            for path in (self._path, journal_path(self._path)):
                if path.exists():
                    shutil.copy(path, directory)
            return self._finish_at(directory / self._path.name)
        finally:
            shutil.rmtree(directory)

    def _finish_at(self, path: Path) -> list[str]:
        open_recorder(self._kind, path, "a", 4000, 1, lambda *_: None).close()
        return self._finished(path, self._known)

    def _finished(self, path: Path, known: list[Found]) -> list[str]:
        with Recording(path) as recording:
            problems = [] if recording.complete else ["it is not complete"]
        if not _same(self._read(path)[0], known):
            problems.append("what was there before has changed")
        place = path.parent / "journals" if self._kind.elsewhere else path.parent
        left = [p.name for p in place.iterdir() if ".journal" in p.name]
        if self._kind.elsewhere:  # of this recording, that is; one that was replaced may have left its own
            left = [name for name in left if recording.uuid in name]
        return problems + [f"{name} stays behind" for name in left]


class _RotatingChain(_Chain):
    """A recording that goes on in other files: all of them are one."""

    def _read(self, path: Path) -> tuple[list[Found], np.ndarray]:
        found: list[Found] = []
        indexes = []
        for number, file in enumerate(_files(path)):
            new, index = super()._read(file)
            indexes.append(index)
            found += [replace(one, number=one.number + 1_000_000 * number) for one in new]
        return found, np.concatenate(indexes)

    def _finish_copy(self) -> list[str]:
        directory = self._path.parent / "copy"
        directory.mkdir()
        try:
            for file in _files(self._path):
                for path in (file, journal_path(file)):
                    if path.exists():
                        shutil.copy(path, directory)
            return self._finish_at(directory / self._path.name)
        finally:
            shutil.rmtree(directory)

    def _finished(self, path: Path, known: list[Found]) -> list[str]:
        problems = [] if _same(self._read(path)[0], known) else ["what was there before has changed"]
        for file in _files(path):
            with Recording(file) as recording:
                if recording.n_steps and not recording.complete:
                    problems.append(f"{file.name} is not complete")
                if recording.n_steps and journal_path(file).exists():
                    problems.append(f"the journal of {file.name} stays behind")
        return problems


def _files(path: Path) -> list[Path]:
    base, later = series(path)
    return [base, *later.values()]


class _StorageChain(_Chain):
    """Each process records a file of its own into one storage."""

    def __init__(self, kind: str, seed: int, directory: Path, breakage: str) -> None:
        super().__init__(kind, seed, directory, breakage)
        self._path = directory / "storage"
        self._storage = FileStorage(self._path)
        self._id = TupliEnvWrapper(gym.make("CartPole-v1"), self._storage).store(name="cartpole")
        self._files: dict[Path, list[Found]] = {}

    def _die(self, moment: str) -> Told:
        return self._record(self._job(moment, self._path, "x")._replace(benchmark_id=self._id))

    def _check(self, told: Told) -> tuple[int, list[str]]:
        new = sorted(set(self._path.glob("recordings/**/*.mcap")) - set(self._files))
        problems, steps = [], 0
        done = any(name == "step" for name, _ in told.reports)
        if len(new) != 1:
            return 0, [f"expected one new recording, found {len(new)}"] if done or len(new) > 1 else []
        try:
            found = self._read(new[0])[0]
        except TupliError:
            if done:
                raise
            new[0].unlink()
            return 0, []
        steps, problems = check_recording(found, told.reports, vector=False, infos=False)
        self._files[new[0]] = found
        listed = sorted(
            (h.metadata is not None, h.recording, h.episode) for h in self._storage.list_episodes()
        )
        wanted = sorted(
            (True, str(path.relative_to(self._path)), e.number)
            for path, es in self._files.items()
            for e in es
        )
        if listed != wanted:
            problems.append(f"the storage lists {len(listed)} episodes, not {len(wanted)}")
        return steps, problems

    def _finish(self) -> list[str]:
        self._storage.close()
        shutil.rmtree(self._path)
        return []


def _flags(found: Sequence[Found]) -> np.ndarray:
    return np.array([step[3] for episode in found for step in episode.steps], dtype=np.bool_)


def _same(a: Sequence[Found], b: Sequence[Found]) -> bool:
    return len(a) == len(b) and all(same(vars(x), vars(y)) for x, y in zip(a, b, strict=True))
