"""Operations on a storage with faults: afterwards, it has the old state or the new one, and there was one clear
error."""

from __future__ import annotations

import gc
import os
import shutil
import sys
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import gymnasium as gym
import numpy as np
from environments import Sampler
from faults import Faults
from faulty_recordings import Case, Leaks, Outcome
from gymnasium import spaces

from tupli_mcap import FileStorage, Recording, TupliEnvWrapper, TupliError, trust
from tupli_mcap.schema import ArtifactMetadata, Episode, FilterEQ, FilterGT, RLTuple

BOX = spaces.Box(-1, 1, (3,), np.float32)


class Small(Sampler):
    """A small environment with episodes of three steps."""

    def __init__(self, size: int = 3) -> None:
        super().__init__(spaces.Box(-1, 1, (size,), np.float32), spaces.Discrete(3), length=3)


def roll(env: gym.Env[Any, Any], episodes: int) -> None:
    for _ in range(episodes):
        env.reset(seed=1)
        for _ in range(3):
            env.step(0)


def by_hand(benchmark: str, score: float) -> Episode:
    tuples = [
        RLTuple(state=[0.5 * i, score], action=i % 2, reward=score, info={}, terminal=i == 2)
        for i in range(3)
    ]
    return Episode(benchmark_id=benchmark, metadata={"score": score}, tuples=tuples)


class Lab(NamedTuple):
    """A storage, and the ids of its items."""

    root: Path
    benchmark: str
    other: str
    artifact: str
    bundle: Path


def template(directory: Path) -> Lab:
    """A storage with two benchmarks, an artifact, recordings with deleted episodes; and a bundle of another one."""
    with FileStorage(directory / "elsewhere") as storage:
        env = TupliEnvWrapper(Small(4), storage)
        env.store("guest")
        roll(env, 2)
        env.close()
        bundle = storage.bundle(str(env.id), directory / "guest.mcap")
    with FileStorage(directory / "lab") as storage:
        env = TupliEnvWrapper(Small(), storage)
        env.store("small")
        roll(env, 4)
        env.close()
        other = TupliEnvWrapper(Small(2), storage)
        other.store("other")
        storage.record_episodes([by_hand(str(other.id), score) for score in (1.0, 2.0, 3.0)])
        item = storage.store_artifact(b"abc" * 100, ArtifactMetadata(name="notes"))
        storage.delete_episode(storage.list_episodes(FilterEQ(key="benchmark_id", value=str(env.id)))[0].id)
        storage.list_episodes()
    return Lab(directory / "lab", str(env.id), str(other.id), item.id, bundle)


def _record(storage: FileStorage, lab: Lab) -> None:
    env = TupliEnvWrapper.load(storage=storage, benchmark_id=lab.benchmark, trust=True)
    try:
        roll(env, 2)
    finally:
        env.close()


def _store(storage: FileStorage, lab: Lab) -> None:
    TupliEnvWrapper(Small(5), storage).store("new", metadata={"level": 3})


def _first(storage: FileStorage) -> str:
    return storage.list_episodes()[0].id


OPERATIONS: dict[str, Callable[[FileStorage, Lab], object]] = {
    "store": _store,
    "record": _record,
    "record-by-hand": lambda s, lab: s.record_episodes([by_hand(lab.other, 9.0), by_hand(lab.other, 8.0)]),
    "artifact": lambda s, lab: s.store_artifact(b"xyz", ArtifactMetadata(name="more")),
    "load-artifact": lambda s, lab: s.load_artifact(lab.artifact),
    "delete-artifact": lambda s, lab: s.delete_artifact(lab.artifact),
    "publish-artifact": lambda s, lab: s.publish_artifact(lab.artifact, "group"),
    "publish-benchmark": lambda s, lab: s.publish_benchmark(lab.benchmark, "group"),
    "publish-episode": lambda s, lab: s.publish_episode(_first(s), "group"),
    "delete-benchmark": lambda s, lab: s.delete_benchmark(lab.other),
    "delete-episode": lambda s, lab: s.delete_episode(_first(s)),
    "delete-episodes": lambda s, lab: s.delete_episodes(FilterGT(key="metadata.score", value=1.5)),
    "delete-recording": lambda s, lab: s.delete_episodes(FilterEQ(key="benchmark_id", value=lab.other)),
    "compact": lambda s, lab: s.compact(),
    "reindex": lambda s, lab: s.reindex(),
    "declare": lambda s, lab: s.declare_key("metadata.score"),
    "bundle": lambda s, lab: s.bundle(lab.benchmark, lab.root.parent / "bundle.mcap"),
    "export": lambda s, lab: s.export(
        lab.root.parent / "export.mcap", FilterEQ(key="benchmark_id", value=lab.other)
    ),
    "import": lambda s, lab: s.import_bundle(lab.bundle),
    "list": lambda s, lab: (s.list_benchmarks(), s.list_artifacts(), s.list_episodes(include_tuples=True)),
}

SEVERAL = ("record", "import", "record-by-hand")
"""These change several things, one after another: any number of them may have been done."""


_DONE: dict[str, dict[str, str]] = {}


def state_of(lab: Lab) -> dict[str, str]:
    """Everything in a storage, and the files written beside it."""
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        with FileStorage(lab.root) as storage:
            found = {f"benchmark {h.id}": str(sorted(h.published_in)) for h in storage.list_benchmarks()}
            for h in storage.list_benchmarks():
                storage.load_benchmark(h.id)
            found |= {f"artifact {i.id}": str(sorted(i.published_in)) for i in storage.list_artifacts()}
            for i in storage.list_artifacts():
                storage.load_artifact(i.id)
            for e in storage.list_episodes(include_tuples=True):
                values = [(np.asarray(t.state).tobytes(), t.action, t.reward, t.terminal) for t in e.tuples]
                # a new recording's UUID and times differ from run to run
                where = f"{e.benchmark_id} {values!r} {e.metadata}"
                number = sum(key.startswith(f"episode {where}") for key in found)
                found[f"episode {where} {number}"] = str(sorted(e.published_in))
            found |= {f"key {key}": "" for key in storage.declared_keys()}
    for path in sorted(lab.root.parent.glob("*.mcap")):
        if path != lab.bundle:
            with Recording(path) as recording:
                found[f"file {path.name}"] = str(len(recording))
    return found


def strays(lab: Lab) -> list[str]:
    """Files that nothing needs."""
    found = [path for path in lab.root.parent.rglob("*") if path.suffix != ".lock" and path.name != ".lock"]
    return [
        path.name
        for path in found
        if path.name.startswith(".") or path.name.endswith((".tmp", ".tmp.journal", ".new"))
    ]


def clone(lab: Lab, directory: Path) -> Lab:
    shutil.copytree(lab.root.parent, directory)
    return lab._replace(root=directory / lab.root.name, bundle=directory / lab.bundle.name)


def run_storage_case(name: str, made: Lab, directory: Path, case: Case) -> Outcome:
    """Runs one operation with one fault, and checks everything that must hold then."""
    lab = clone(made, directory)
    operation = OPERATIONS[name]
    before = state_of(lab)
    leaks = Leaks(directory)
    faults = Faults(directory, case.at, case.code, lasting=case.lasting, short=case.short)
    said: list[str] = []
    surprises: list[Any] = []
    hook = sys.unraisablehook
    sys.unraisablehook = lambda args: surprises.append(args.exc_value)
    try:
        with faults(), warnings.catch_warnings(record=True) as warned:
            warnings.simplefilter("always")
            try:
                with FileStorage(lab.root) as storage:
                    operation(storage, lab)
            except Exception as err:  # noqa: BLE001
                said.append(_clear(err, directory, case))
        gc.collect()
    finally:
        sys.unraisablehook = hook
    assert not surprises, surprises
    told = [str(w.message) for w in warned if os.strerror(case.code) in str(w.message)]
    leaks.check()
    after = state_of(lab)
    done = _DONE.setdefault(name, after)  # the first time without a fault
    assert said or told or after == done, f"silent: {faults.failed}"
    removal_failed = any(kind == "unlink" for kind, _ in faults.failed)
    assert removal_failed or not strays(lab), f"left behind: {strays(lab)}"
    _repeat(name, lab)
    new = state_of(lab)
    if faults.failed:
        assert not strays(lab) or removal_failed, f"left behind: {strays(lab)}"
    _check_states(name, before, after, new, said=bool(said))
    return Outcome(bool(faults.failed), bool(said), faults.calls)


def _repeat(name: str, lab: Lab) -> None:
    """Repeats the operation without a fault; it may be refused if it was done already."""
    with FileStorage(lab.root) as storage:
        try:
            OPERATIONS[name](storage, lab)
        except TupliError as err:
            assert any(word in str(err) for word in ("there is no", "exists and is not overwritten")), err  # noqa: PT017


def _check_states(
    name: str, before: dict[str, str], after: dict[str, str], new: dict[str, str], *, said: bool
) -> None:
    if name.startswith("record") or name == "delete-episode":
        # doing it again does it twice
        if said and name not in SEVERAL:
            assert before.items() <= after.items() or after.items() <= before.items()
        if name.startswith("record"):
            assert before.items() <= after.items() <= new.items()
        else:
            assert new.items() <= after.items() <= before.items()
            assert len(before) - len(after) <= 1
        return
    if name in SEVERAL:
        assert (
            before.items() <= after.items() <= new.items() or new.items() <= after.items() <= before.items()
        )
        return
    assert after in (before, new), f"neither the old nor the new state: {_difference(before, after, new)}"
    assert said or after == new


def _difference(*states: dict[str, str]) -> list[list[str]]:
    common = set.intersection(*(set(state) for state in states))
    return [sorted(key[:60] for key in state if key not in common) for state in states]


def _clear(err: BaseException, directory: Path, case: Case) -> str:
    text = str(err)
    assert isinstance(err, TupliError), f"a raw error: {err!r}"
    assert "\n" not in text
    assert directory.name in text, f"names no path: {text}"
    assert os.strerror(case.code) in text, text
    assert ".tmp" not in text, f"names a temporary file: {text}"
    assert "; " in text, f"does not say what to do: {text}"
    return text


def run_trust_case(directory: Path, case: Case) -> Outcome:
    """Trusts and untrusts a digest with one fault; afterwards, it is trusted or not, and nothing else changed."""
    digest = "ab" * 32
    os.environ["TUPLI_MCAP_CONFIG_DIR"] = str(directory / "config")
    directory.mkdir(parents=True)
    faults = Faults(directory, case.at, case.code, lasting=case.lasting, short=case.short)
    said = []
    with faults():
        for change in (trust.trust, trust.untrust):
            try:
                change(digest)
            except Exception as err:  # noqa: BLE001
                said.append(_clear(err, directory, case))
    assert [
        p.name for p in directory.rglob("*") if p.is_file() and p.name not in ("key", digest)
    ] == [] or any(kind == "unlink" for kind, _ in faults.failed)
    trust.trust(digest)
    assert trust.is_trusted(digest)
    return Outcome(bool(faults.failed), bool(said), faults.calls)
