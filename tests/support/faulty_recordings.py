"""Small rollouts with faults, and the checks after the k-th call has failed."""

from __future__ import annotations

import copy
import errno
import gc
import itertools
import os
import sys
import threading
import warnings
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

import gymnasium as gym
import numpy as np
from environments import Sampler, same
from faults import FITS, Faults
from gymnasium import spaces

from tupli_mcap import RecordEpisodes, Recording, RecordingError, TupliError
from tupli_mcap.vector import RecordEpisodes as RecordVector

CODES = (errno.ENOSPC, errno.EDQUOT, errno.EIO, errno.EROFS, errno.EMFILE, errno.ENOMEM, errno.EFBIG)
_BOX = spaces.Box(-1, 1, (3,), np.float32)
_IMAGE = spaces.Dict({"camera": spaces.Box(0, 255, (8, 8, 3), np.uint8), "x": _BOX})


class Workload(NamedTuple):
    """An environment, how it is recorded, and for how many steps; `start` steps are in the file before (append)."""

    space: gym.Space[Any]
    options: dict[str, Any]
    steps: int = 20
    envs: int = 0
    start: int = 0
    flush: bool = False
    journal_dir: bool = False


WORKLOADS = {
    "box": Workload(_BOX, {"chunk_size": 400}),
    "one-chunk": Workload(_BOX, {"chunk_size": 1 << 16}),
    "uncompressed": Workload(_BOX, {"chunk_size": 300, "compression": "none"}),
    "lz4": Workload(_BOX, {"chunk_size": 300, "compression": "lz4"}),
    "text": Workload(spaces.Dict({"note": spaces.Text(30), "x": spaces.Discrete(5)}), {"chunk_size": 400}),
    "growing": Workload(spaces.Text(3000, min_length=0), {"chunk_size": 400}, 12),
    "image": Workload(_IMAGE, {"chunk_size": 1000}),
    "frames": Workload(spaces.Box(0, 255, (80, 80, 3), np.uint8), {"chunk_size": 40_000, "compression": "none"}),
    "info": Workload(_BOX, {"chunk_size": 400, "record_info": True}),
    "flushed": Workload(_BOX, {"chunk_size": 4000}, flush=True),
    "vector": Workload(_BOX, {"chunk_size": 400}, envs=3),
    "vector-wide": Workload(spaces.Box(-1, 1, (900,), np.float64), {}, envs=3),
    "png": Workload(_IMAGE, {"chunk_size": 1000, "image_format": "png"}),
    "vector-text": Workload(spaces.Text(20), {"chunk_size": 400}, envs=2),
    "vector-image": Workload(_IMAGE, {"chunk_size": 2000}, envs=2),
    "append": Workload(_BOX, {"chunk_size": 400}, start=9),
    "append-killed": Workload(_BOX, {"chunk_size": 4000}, start=-9),
    "append-text": Workload(spaces.Text(20), {"chunk_size": 400}, start=-9),
    "journal-elsewhere": Workload(_BOX, {"chunk_size": 400}, journal_dir=True),
}  # fmt: skip


class Case(NamedTuple):
    """Which call fails, and how."""

    at: int
    code: int
    lasting: bool
    short: bool = False

    def __str__(self) -> str:
        kind = f"{errno.errorcode[self.code]}{' for good' if self.lasting else ''}"
        return f"call {self.at}: {kind}{' after half of the bytes' if self.short else ''}"


class Outcome(NamedTuple):
    """Whether the fault occurred, whether the recorder reported it, and the number of calls."""

    hit: bool
    said: bool
    calls: list[tuple[str, str]]


def cases(calls: list[tuple[str, str]]) -> Iterator[Case]:
    """All faults of a workload that makes these calls."""
    for at, (kind, _) in enumerate(calls):
        for code in CODES:
            if code in FITS[kind]:
                for lasting in (False, True):
                    yield Case(at, code, lasting)
                    if kind == "write":
                        yield Case(at, code, lasting, True)


class Rollout:
    """A rollout, and the steps as its caller saw them: (state, action, reward, ends, next state)."""

    def __init__(self, env: Any, envs: int) -> None:
        self.env, self.envs = env, max(envs, 1)
        self.vector = bool(envs)
        self.seen: list[list[tuple[Any, ...]]] = [[] for _ in range(self.envs)]
        self.state: Any = None
        self._ended = np.zeros(self.envs, np.bool_)
        env.action_space.seed(3)

    def reset(self) -> None:
        self.state = None
        self.state = copy.deepcopy(self.env.reset(seed=1)[0])
        self._ended[:] = False

    def run(self, steps: int, flush: Callable[[], None] | None = None) -> None:
        if self.state is None:
            self.reset()
        for i in range(steps):
            action = self.env.action_space.sample()
            after, reward, terminal, timeout, _ = self.env.step(action)
            after = copy.deepcopy(after)
            before, self.state = self.state, after
            columns = (before, action, reward, terminal, timeout, after)
            each = (
                [_at(column, i) for column in columns for i in range(self.envs)] if self.vector else columns
            )
            table = [each[i :: self.envs] for i in range(self.envs)] if self.vector else [each]
            for env, row in enumerate(table):
                if not self._ended[env]:
                    self.seen[env].append(tuple(row))
            ended = np.atleast_1d(np.logical_or(terminal, timeout)) & ~self._ended
            if self.vector:
                self._ended = ended
            elif ended[0]:
                self.state = None
                self.state = copy.deepcopy(self.env.reset()[0])
            if flush is not None and i % 5 == 4:
                flush()


def _at(column: Any, i: int) -> Any:
    if isinstance(column, dict):
        return {key: _at(value, i) for key, value in column.items()}
    value = column[i]
    return value.item() if isinstance(value, np.bool_) else value


def make_env(workload: Workload) -> Any:
    if not workload.envs:
        return Sampler(workload.space, spaces.Discrete(9), length=5)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)
        makes = [
            lambda i=i: Sampler(workload.space, spaces.Discrete(9), length=4 + i)
            for i in range(workload.envs)
        ]
        return gym.vector.SyncVectorEnv(makes)  # type: ignore[arg-type]


def wrap(env: Any, path: Path, workload: Workload, **options: Any) -> Any:
    if workload.journal_dir:
        options["journal_dir"] = path.parent / "journals"
    wrapper: Any = RecordVector if workload.envs else RecordEpisodes
    if "attachments" not in options:
        options["attachments"] = {"notes.txt": ("text/plain", b"x" * 100)}
    return wrapper(env, path, **{**workload.options, **options})


def recorded(path: Path) -> list[list[tuple[Any, ...]]]:
    """The steps in a file, by sub-environment, in the form of `Rollout.seen`."""
    with Recording(path) as recording:
        found: list[list[tuple[Any, ...]]] = [[] for _ in range(max(recording.num_envs, 1))]
        for i, episode in enumerate(recording.episodes):
            steps = list(episode)
            states = [step.state for step in steps] + [episode.final_state]
            for step, (before, after) in zip(steps, itertools.pairwise(states), strict=True):
                env = int(recording.index["env"][i])
                row = (before, step.action, step.reward, step.terminal, step.timeout, after)
                found[env].append(row)
    return found


def check_recorded(path: Path, expected: list[list[tuple[Any, ...]]], *, more: int) -> None:
    """Checks that the file has all expected steps, bit for bit and in order, and at most `more` others after them."""
    found = recorded(path)
    for ours, theirs in zip(expected, found if any(found) else [[] for _ in expected], strict=True):
        assert len(ours) <= len(theirs) <= len(ours) + more, (
            f"{len(ours)} steps returned, found {len(theirs)}"
        )
        for one, other in zip(ours, theirs[: len(ours)], strict=True):
            for a, b in zip(one, other, strict=True):
                assert same(np.asarray(a), np.asarray(b)) or same(a, b), f"{a!r} is recorded as {b!r}"


class Leaks:
    """Checks that there are no more descriptors below a directory, and no more threads, than before."""

    def __init__(self, directory: Path) -> None:
        gc.collect()
        self._below = str(directory.resolve()) + os.sep
        self._before = self._now()

    def _now(self) -> tuple[list[str], int]:
        found = []
        for name in os.listdir("/proc/self/fd"):  # noqa: PTH208
            try:
                found.append(os.readlink(f"/proc/self/fd/{name}"))  # noqa: PTH115
            except OSError:
                continue
        found = [name for name in found if name.startswith(self._below)]
        return sorted(found), threading.active_count()

    def check(self) -> None:
        gc.collect()
        gc.freeze()  # what is still here was here before: no need to look at it again
        assert self._now() == self._before, f"leaked: {self._now()}, before: {self._before}"


def is_clear(err: BaseException, path: Path, case: Case) -> str:
    """Whether an error is ours, in one sentence that names the file or its journals' directory, the reason, and what to
    do."""
    text = str(err)
    assert isinstance(err, TupliError), f"a raw error: {err!r}"
    assert "\n" not in text
    assert path.name in text or repr(str(path.parent / "journals")) in text, text
    assert os.strerror(case.code) in text, text
    assert "; " in text, f"does not say what to do: {text}"
    return text


def run_case(name: str, directory: Path, case: Case) -> Outcome:
    """Makes one rollout with one fault, and checks everything that must hold then."""
    workload = WORKLOADS[name]
    root = directory / "disk"
    root.mkdir(parents=True)
    path = root / "r.mcap"
    if workload.journal_dir:
        (root / "journals").mkdir()
        (directory / "journals").mkdir()
    env = make_env(workload)
    before = _prepared(env, path, workload)
    faults = Faults(root, case.at, case.code, lasting=case.lasting, short=case.short)
    leaks = Leaks(directory)
    rollout = Rollout(env, workload.envs)
    said, surprises = [], []
    hook = sys.unraisablehook
    sys.unraisablehook = lambda args: surprises.append(args.exc_value)
    try:
        with faults(), warnings.catch_warnings(record=True) as warned:
            warnings.simplefilter("always")
            recorder = _roll(rollout, env, path, workload, said)
            if recorder is not None:
                _use_after_failure(recorder, rollout, said)
                _close(recorder, said)
                recorder.close()
    finally:
        sys.unraisablehook = hook
    rollout.env = env
    del recorder
    said = [is_clear(err, path, case) for err in said]  # an error would hold the frames it went through
    assert not surprises, surprises
    told = [str(w.message) for w in warned if path.name in str(w.message)]
    assert not faults.failed or said or told or not case_matters(faults), f"silent: {faults.failed}"
    expected = [a + b for a, b in zip(before, rollout.seen, strict=True)]
    untidy = any(kind == "unlink" for kind, _ in faults.failed)
    _check_after(env, path, workload, expected, bool(said), untidy)
    leaks.check()
    return Outcome(bool(faults.failed), bool(said), faults.calls)


def case_matters(faults: Faults) -> bool:
    """Whether a fault must be reported: not if only a look, or tidying up, failed."""
    return any(kind in ("write", "allocate", "create", "replace", "map") for kind, _ in faults.failed)


def _prepared(env: Any, path: Path, workload: Workload) -> list[list[tuple[Any, ...]]]:
    """Makes the file to append to; with a negative `start`, its writer was killed."""
    seen: list[list[tuple[Any, ...]]] = [[] for _ in range(max(workload.envs, 1))]
    if not workload.start:
        return seen
    if workload.start > 0:
        recorder = wrap(env, path, workload)
        rollout = Rollout(recorder, workload.envs)
        rollout.run(workload.start)
        recorder.close()
        return rollout.seen
    from tupli_mcap.recording import journal_path

    other = path.with_name("live.mcap")
    recorder = wrap(env, other, workload)
    rollout = Rollout(recorder, workload.envs)
    rollout.run(-workload.start)
    path.write_bytes(other.read_bytes())
    journal_path(path).write_bytes(journal_path(other).read_bytes())
    recorder.close()
    other.unlink()
    return rollout.seen


def _roll(rollout: Rollout, env: Any, path: Path, workload: Workload, said: list[BaseException]) -> Any:
    try:
        recorder = wrap(env, path, workload, mode="a" if workload.start else "x")
    except Exception as err:  # noqa: BLE001 - judged later
        said.append(err)
        return None
    rollout.env = recorder
    try:
        rollout.run(workload.steps, recorder.flush if workload.flush else None)
    except Exception as err:  # noqa: BLE001
        said.append(err)
    return recorder


def _use_after_failure(recorder: Any, rollout: Rollout, said: list[BaseException]) -> None:
    if not said:
        return
    for use in (lambda: recorder.step(rollout.env.action_space.sample()), recorder.reset, recorder.flush):
        try:
            use()
        except Exception as err:  # noqa: BLE001
            said.append(err)
        else:
            raise AssertionError("a failed recorder goes on in silence")


def _close(recorder: Any, said: list[BaseException]) -> None:
    try:
        recorder.close()
    except Exception as err:  # noqa: BLE001
        said.append(err)


def _check_after(
    env: Any,
    path: Path,
    workload: Workload,
    expected: list[list[tuple[Any, ...]]],
    failed: bool,
    untidy: bool,
) -> None:
    if not path.exists() or not path.stat().st_size:
        assert not any(expected)
        assert failed
    else:
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            readable = _opens(path)
            if readable:
                check_recorded(path, expected, more=1 if failed else 0)
                with Recording(path) as recording:
                    assert recording.complete or failed
        assert readable or not any(expected), "what was recorded cannot be read"
    elsewhere = path.parent.parent / "elsewhere.mcap"
    _go_on(env, elsewhere, workload, [[] for _ in expected], "x")
    if path.exists() and path.stat().st_size and _opens(path):
        found = recorded(path)
        _go_on(env, path, workload, found if any(found) else [[] for _ in expected], "a")
        # a name that could not be removed stays
        left = [p.name for p in path.parent.rglob("*") if p.is_file() and not (untidy and p.name[0] == ".")]
        assert left == [path.name], f"left behind: {left}"


def _opens(path: Path) -> bool:
    try:
        Recording(path).close()
    except TupliError:
        return False
    return True


def _go_on(env: Any, path: Path, workload: Workload, before: list[list[tuple[Any, ...]]], mode: str) -> None:
    recorder = wrap(env, path, workload, mode=mode)
    rollout = Rollout(recorder, workload.envs)
    rollout.run(7)
    recorder.close()
    check_recorded(path, [a + b for a, b in zip(before, rollout.seen, strict=True)], more=0)
    assert Recording(path).complete


def calls_of(name: str, directory: Path) -> list[tuple[str, str]]:
    """The calls that a workload makes without a fault."""
    return run_case(name, directory, Case(-1, errno.EIO, False)).calls


__all__ = ["WORKLOADS", "Case", "RecordingError", "calls_of", "cases", "run_case"]
