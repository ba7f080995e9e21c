"""Many processes in one storage: writers record while others read, delete, compact, rebuild, share, and are killed.

    python tools/concurrency.py --seconds 120 --writers 8 --seed 1

Every row contains its process, episode and step, so that each row can be checked by itself. Processes write everything
acknowledged (a step that returned, an episode that ended, a deletion) to ledgers outside the storage, with one write(2)
each, which survives a kill. During the run and after it, the storage is compared with the ledgers:

- no acknowledged step is lost, and lists have every ended episode, unless a process meant to delete it;
- nothing whose deletion was acknowledged comes back;
- every episode that is read is exact, from its first step to its last;
- a call fails only if its item was deleted meanwhile, and none warns;
- no process waits for another one for more than --patience seconds;
- the catalog equals a rebuilt one, and nothing is locked when all have ended.
"""

from __future__ import annotations

import argparse
import contextlib
import faulthandler
import multiprocessing
import os
import random
import shutil
import signal
import struct
import sys
import tempfile
import time
import traceback
import warnings
from collections import Counter
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

import gymnasium as gym
import numpy as np

from tupli_mcap import FileStorage, Recording, TupliDataset, TupliEnvWrapper
from tupli_mcap.errors import NotFoundError, StorageError
from tupli_mcap.mcap.lock import is_locked
from tupli_mcap.schema import EpisodeMetadataCallback, F, FilterEQ, RLTuple
from tupli_mcap.storage.catalog.place import catalog_path

FOREIGN = 1 << 20  # tokens of imported episodes start here
_STEP = struct.Struct("<III")  # episode, steps acknowledged, whether it has ended
Key = tuple[int, int]  # token, episode


class Told(gym.Env[Any, Any]):
    """An environment whose states identify themselves: (token, episode, step). Options give the length of an
    episode."""

    observation_space = gym.spaces.Box(0, 1 << 40, (3,), np.int64)
    action_space = gym.spaces.Discrete(1 << 30)

    def __init__(self, token: int, episode: int = -1) -> None:
        self.token, self.episode, self.steps, self.length = token, episode, 0, 1

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, Any]:
        self.steps, self.episode = 0, self.episode + 1
        self.length = (options or {}).get("length", 3)
        return self._state(), {}

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        self.steps += 1
        ended = self.steps == self.length
        timeout = self.episode % 3 == 0
        return self._state(), reward_of(self._state()), ended and not timeout, ended and timeout, {}

    def _state(self) -> Any:
        return np.array([self.token, self.episode, self.steps], np.int64)


def reward_of(state: Any) -> float:
    """The reward of the step that led to a state."""
    return float(state[0] * 1_000_003 + state[1] * 1009 + state[2])


def action_of(state: Any) -> int:
    """The action that is taken in a state."""
    return int(state[0] * 7919 + state[1] * 31 + state[2]) % (1 << 30)


class Named(EpisodeMetadataCallback):
    """Metadata: whose episode it is."""

    def reset(self) -> None:
        pass

    def __call__(self, tuple: RLTuple) -> dict[str, Any]:
        return {"token": int(tuple.state[0]), "number": int(tuple.state[1])}


class WrongError(Exception):
    """The storage has broken a promise."""


def check_rows(states: Any, actions: Any, rewards: Any, flags: Any, final: Any) -> Key:
    """The token and number of the episode of some rows; WrongError unless they are exactly its first steps."""
    n = len(states)
    token, number = (int(x) for x in states[0][:2])
    wanted = np.empty((n + 1, 3), np.int64)
    wanted[:, 0], wanted[:, 1], wanted[:, 2] = token, number, np.arange(n + 1)
    whole = states if final is None else [*states, final]
    exact = np.array_equal(np.asarray(whole), wanted[: len(whole)])
    exact &= [int(a) for a in actions] == [action_of(s) for s in wanted[:n]]
    exact &= [float(r) for r in rewards] == [reward_of(s) for s in wanted[1:]]
    exact &= not any(flags[:-1])
    if not exact:
        raise WrongError(
            f"episode {number} of {token} came back as {states!r}, {actions!r}, {rewards!r}, {flags!r}"
        )
    return token, number


def check_recording(recording: Recording) -> Iterator[tuple[int, Key, int, str]]:
    """(number, whose, steps, end) of the episodes of a recording."""
    for episode in recording.episodes:
        flags = np.asarray(episode.terminals) | np.asarray(episode.timeouts)
        key = check_rows(episode.states, episode.actions, episode.rewards, flags, episode.final_state)
        yield int(episode.number), key, len(episode), episode.end


class Ledger:
    """Everything acknowledged, in files that any process may read at any time."""

    def __init__(self, root: Path) -> None:
        self.root = root
        root.mkdir(parents=True, exist_ok=True)

    def note(self, name: str, line: str | bytes) -> None:
        data = line if isinstance(line, bytes) else f"{line}\n".encode()
        fd = os.open(self.root / name, os.O_WRONLY | os.O_CREAT | os.O_APPEND | os.O_CLOEXEC, 0o644)
        try:
            os.write(fd, data)
        finally:
            os.close(fd)

    def episodes(self) -> dict[Key, tuple[int, bool]]:
        """Whose -> (steps, ended)."""
        found = {}
        for path in self.root.glob("steps-*"):
            token = int(path.name.removeprefix("steps-"))
            data = path.read_bytes()
            for episode, steps, ended in _STEP.iter_unpack(data[: len(data) // _STEP.size * _STEP.size]):
                found[token, episode] = (steps, bool(ended))
        return found

    def keys(self, name: str) -> set[Key]:
        with contextlib.suppress(FileNotFoundError):
            lines = (self.root / name).read_text().splitlines()
            return {(int(a), int(b)) for a, b in (line.split() for line in lines)}
        return set()

    def lines(self, name: str) -> list[str]:
        with contextlib.suppress(FileNotFoundError):
            return (self.root / name).read_text().splitlines()
        return []


class SharedPlace(NamedTuple):
    """Where a run happens."""

    root: Path
    benchmarks: list[str]
    bundles: list[Path]

    @property
    def storage(self) -> Path:
        return self.root / "lab"

    @property
    def ledger(self) -> Ledger:
        return Ledger(self.root / "ledger")


class Worker:
    """One process: works until it is told to stop, or killed."""

    def __init__(
        self, place: SharedPlace, slot: int, token: int, seed: int, until: float, beats: Any
    ) -> None:
        self.place, self.slot, self.token, self.until = place, slot, token, until
        self.beats = beats
        self.random = random.Random(f"{seed}-{token}")
        self.ledger = place.ledger
        self.storage = FileStorage(place.storage)
        self.counts: Counter[str] = Counter()

    def main(self, work: Callable[[], None]) -> None:
        faulthandler.register(signal.SIGUSR1)
        signal.signal(signal.SIGINT, signal.SIG_IGN)
        warnings.simplefilter("error")
        warnings.filterwarnings("ignore", category=DeprecationWarning)
        warnings.filterwarnings("ignore", module="gymnasium")
        try:
            while time.time() < self.until:
                self.beat()
                work()
            self.storage.close()
        except BaseException:  # noqa: BLE001 - told to the parent
            self.ledger.note("errors", f"--- {type(self).__name__} {self.token}\n{traceback.format_exc()}")
            os._exit(1)

    def beat(self) -> None:
        self.beats[self.slot] = time.time()


class Writer(Worker):
    """Records episodes into one benchmark after another."""

    def work(self) -> None:
        env = TupliEnvWrapper(
            Told(self.token, self.counts["episodes"]),
            self.storage,
            self.random.choice(self.place.benchmarks),
            metadata_callback=Named(),
            chunk_size=self.random.choice([600, 4000, 1 << 18]),
        )
        for _ in range(self.random.randrange(1, 12)):
            self.beat()
            self.record(env)
            if self.random.random() < 0.2:  # go on in the same file, if nobody has replaced or deleted it
                env.deactivate_recording()
                env.activate_recording()
            if time.time() > self.until:
                break
        env.close()

    def record(self, env: TupliEnvWrapper) -> None:
        length = self.random.choice([1, 2, 5, 20, 60])
        state, _ = env.reset(options={"length": length})
        number = int(state[1])
        self.counts["episodes"] = number
        breaks_off = self.random.random() < 0.1
        ledger = f"steps-{self.token}"
        for i in range(1, length + 1):
            state, _, terminal, timeout, _ = env.step(action_of(state))
            self.ledger.note(ledger, _STEP.pack(number, i, terminal or timeout))
            if breaks_off and i * 2 > length:
                return
            time.sleep(0.0005)


class Other(Worker):
    """A process that reads, deletes, compacts and shares while others record."""

    def work(self) -> None:
        names = ("look", "load", "open", "items", "delete", "delete_many", "publish", "compact", "rebuild", "vanish",
                 "share", "take", "benchmark", "refuse")  # fmt: skip
        weights = (6, 3, 4, 2, 4, 2, 2, 2, 1, 1, 1, 2, 1, 1)
        name = self.random.choices(names, weights)[0]
        self.counts[name] += 1
        try:
            getattr(self, name)()
            self.ledger.note("done", name)
        except NotFoundError:
            self.ledger.note("done", f"{name}, found gone")
        time.sleep(self.random.random() * 0.05)

    def look(self) -> None:
        """Checks that lists have every ended episode, and no deleted one."""
        gone = self.ledger.keys("deleted")
        ended = {key for key, (_, over) in self.ledger.episodes().items() if over}
        chosen = self.random.choice([None, "id", "token"])
        wanted: Any = None
        if chosen == "id":
            wanted = FilterEQ(key="benchmark_id", value=self.random.choice(self.place.benchmarks))
        elif chosen == "token" and ended:
            token = self.random.choice(sorted(ended))[0]
            wanted = F("metadata.token") == token
            ended = {key for key in ended if key[0] == token}
        headers = self.storage.list_episodes(wanted)
        found = Counter((h.metadata["token"], h.metadata["number"]) for h in headers if h.metadata)
        twice = [key for key, n in found.items() if n > 1]
        lost = set() if chosen == "id" else ended - found.keys() - self.ledger.keys("deleting")
        back = found.keys() & gone
        if twice or lost or back:
            raise WrongError(f"listed twice: {twice}, not listed: {lost}, listed though deleted: {back}")

    def load(self) -> None:
        """Loads a whole benchmark."""
        benchmark = self.random.choice(self.place.benchmarks)
        ds = TupliDataset(self.storage).with_episode_filter(FilterEQ(key="benchmark_id", value=benchmark))
        ds.load()
        states, actions, rewards, terminals, timeouts = ds.convert_to_numpy(mark_cuts=False)
        at = 0
        for header in ds._headers:
            rows = slice(at, at + header.n_tuples)
            check_rows(states[rows], actions[rows], rewards[rows], (terminals | timeouts)[rows], None)
            at += header.n_tuples

    def open(self) -> None:
        """Opens one recording: live, killed or finished."""
        header = self._any()
        with self.storage.open_recording(header.recording) as recording:
            list(check_recording(recording))

    def items(self) -> None:
        items: list[Any] = self.storage.list_episodes(None, True, limit=20, offset=self.random.randrange(50))
        for item in items:
            rows = [(t.state, t.action, t.reward, t.terminal or t.timeout) for t in item.tuples]
            states, actions, rewards, flags = zip(*rows, strict=True)
            check_rows(states, actions, rewards, flags, None)

    def _any(self) -> Any:
        headers = self.storage.list_episodes(F("metadata.token") < FOREIGN)
        if not headers:
            raise NotFoundError("no episode yet")
        return self.random.choice(headers)

    def delete(self) -> None:
        header = self._any()
        key = f"{header.metadata['token']} {header.metadata['number']}"
        self.ledger.note("deleting", key)
        self.storage.delete_episode(header.id)
        self.ledger.note("deleted", key)
        with contextlib.suppress(NotFoundError):
            self.storage.publish_episode(header.id, "nobody")
            raise WrongError(f"{header.id} was deleted, and could be published")

    def delete_many(self) -> None:
        recording = self._any().recording
        wanted = FilterEQ(key="recording", value=recording) & (F("metadata.token") < FOREIGN)
        headers = self.storage.list_episodes(wanted)
        limit = self.random.choice([h.metadata["number"] for h in headers] or [0])
        wanted = wanted & (F("metadata.number") <= limit)
        keys = [(h.metadata["token"], h.metadata["number"]) for h in headers if h.metadata["number"] <= limit]
        for token, number in keys:
            self.ledger.note("deleting", f"{token} {number}")
        tokens = sorted({token for token, _ in keys})
        if len(tokens) == 1:  # what is added meanwhile has higher numbers
            self.storage.delete_episodes(wanted)
            for token, number in keys:
                self.ledger.note("deleted", f"{token} {number}")

    def publish(self) -> None:
        self.storage.publish_episode(self._any().id, f"group{self.random.randrange(5)}")

    def compact(self) -> None:
        self.storage.compact()

    def rebuild(self) -> None:
        self.storage.reindex()

    def vanish(self) -> None:
        """Deletes the catalog's file."""
        catalog = catalog_path(self.place.storage)
        assert catalog is not None
        for suffix in ("", "-wal", "-shm"):
            catalog.with_name(f"{catalog.name}{suffix}").unlink(missing_ok=True)

    def share(self) -> None:
        target = self.place.root / f"bundle-{self.token}-{self.counts['share']}.mcap"
        self.storage.bundle(self.random.choice(self.place.benchmarks), target)
        with Recording(target) as recording:
            list(check_recording(recording))
        target.unlink()

    def take(self) -> None:
        bundle = self.random.choice(self.place.bundles)
        self.storage.import_bundle(bundle)
        self.ledger.note("taken", bundle.name)

    def benchmark(self) -> None:
        """Stores a benchmark, records to it, and deletes it."""
        env = TupliEnvWrapper(Told(2 * FOREIGN + self.token, self.counts["benchmark"]), self.storage)
        uri = env.store(name=f"own {self.token} {self.counts['benchmark']}")
        state, _ = env.reset()
        for _ in range(3):
            state, *_ = env.step(action_of(state))
        env.close()
        mine = FilterEQ(key="benchmark_id", value=uri)
        if self.storage.count_episodes(mine) != 1 or env.delete().episodes != 1:
            raise WrongError(f"benchmark {uri} did not hold the one episode")
        if self.storage.count_episodes(mine):
            raise WrongError(f"benchmark {uri} was deleted and still has episodes")

    def refuse(self) -> None:
        """Checks that nobody can delete a benchmark with its episodes while it is being recorded."""
        uri = self.random.choice(self.place.benchmarks)
        env = TupliEnvWrapper(Told(3 * FOREIGN + self.token, self.counts["refuse"]), self.storage, uri)
        state, _ = env.reset()
        env.step(action_of(state))
        other = TupliEnvWrapper(Told(0), FileStorage(self.place.storage), uri)
        try:
            other.delete()
        except StorageError as err:
            if "is being recorded" not in str(err):
                raise
        else:
            raise WrongError(f"benchmark {uri} was deleted while it was recorded")
        env.close()


def _run_worker(kind: type[Any], *args: Any) -> None:
    worker = kind(*args)
    worker.main(worker.work)


def prepare(root: Path, benchmarks: int, bundles: int) -> SharedPlace:
    """A storage with benchmarks, and bundles from elsewhere to be imported."""
    storage = FileStorage(root / "lab")
    ids = [TupliEnvWrapper(Told(0), storage).store(name=f"shared {i}") for i in range(benchmarks)]
    storage.declare_key("metadata.token")
    storage.close()
    paths = []
    for i in range(bundles):
        elsewhere = FileStorage(root / f"elsewhere{i}")
        env = TupliEnvWrapper(Told(FOREIGN + i), elsewhere, metadata_callback=Named())
        uri = env.store(name=f"foreign {i}")
        for _ in range(3):
            state, _ = env.reset()
            for _ in range(3):
                state, *_ = env.step(action_of(state))
        env.close()
        paths.append(elsewhere.bundle(uri, root / f"foreign{i}.mcap"))
        elsewhere.close()
    return SharedPlace(root, ids, paths)


def run(
    root: Path, seconds: float, seed: int, writers: int = 8, others: int = 4, patience: float = 120.0
) -> Counter[str]:
    """Runs it all; returns figures. Raises WrongError."""
    place = prepare(root, max(2, writers // 2), 3)
    context = multiprocessing.get_context("fork")
    rng = random.Random(seed)
    until = time.time() + seconds
    kinds: list[type[Worker]] = [Writer] * writers + [Other] * others
    beats = context.Array("d", [time.time()] * len(kinds), lock=False)
    figures: Counter[str] = Counter()
    tokens = iter(range(1, FOREIGN))
    processes: list[Any] = [None] * len(kinds)

    def start(slot: int) -> None:
        beats[slot] = time.time()
        args = (kinds[slot], place, slot, next(tokens), seed, until, beats)
        processes[slot] = context.Process(target=_run_worker, args=args)
        processes[slot].start()

    for slot in range(len(kinds)):
        start(slot)
    try:
        while True:  # one is killed, however late they all have started
            time.sleep(rng.uniform(0.1, 0.8))
            _check_alive(processes, beats, patience, place)
            slot = rng.randrange(len(kinds))
            processes[slot].kill()
            processes[slot].join()
            figures[f"killed {kinds[slot].__name__.lower()}s"] += 1
            start(slot)
            if time.time() >= until:
                break
        while any(process.is_alive() for process in processes):
            time.sleep(0.05)
            _check_alive(processes, beats, patience, place)
    finally:
        for process in processes:
            process.kill()
            process.join()
    _check_alive(processes, beats, patience, place)
    figures.update(f"did {name}" for name in place.ledger.lines("done"))
    return figures + verify(place)


def _check_alive(processes: list[Any], beats: Any, patience: float, place: SharedPlace) -> None:
    errors = place.ledger.lines("errors")
    if errors:
        raise WrongError("\n".join(errors[:80]))
    for slot, process in enumerate(processes):
        if process.is_alive() and time.time() - beats[slot] > patience:
            for other in processes:
                with contextlib.suppress(OSError, ValueError):
                    os.kill(other.pid, signal.SIGUSR1)
            time.sleep(2)
            raise WrongError(f"process {slot} has waited for {patience:.0f} s")


def verify(place: SharedPlace) -> Counter[str]:
    """Compares the storage with the ledgers."""
    figures: Counter[str] = Counter()
    storage, ledger = FileStorage(place.storage), place.ledger
    locked = [path for path in place.storage.rglob("*.mcap") if is_locked(path)]
    if locked:
        raise WrongError(f"still locked: {locked}")
    meant, gone = ledger.keys("deleting"), ledger.keys("deleted")
    for again in (False, True):  # before and after compacting
        listed = [header.model_dump() for header in storage.list_episodes()]
        found = _read_all(storage)
        for key, (steps, ended) in ledger.episodes().items():
            if key in found:
                there, end = found[key]
                most = steps if ended else steps + 1  # committed, but not acknowledged
                if not steps <= there <= most or (ended and end == "interrupted"):
                    raise WrongError(f"{key}: expected {steps} steps, found {there}, end {end}")
            elif key not in meant:
                raise WrongError(f"{key}: {steps} steps were acknowledged, none found")
        if found.keys() & gone:
            raise WrongError(f"deleted, and there again: {found.keys() & gone}")
        taken = set(ledger.lines("taken"))
        for i, bundle in enumerate(place.bundles):
            n = sum(1 for token, _ in found if token == FOREIGN + i)
            if n not in ((3,) if bundle.name in taken else (0, 3)):
                raise WrongError(f"{bundle.name}: expected 3 imported episodes, found {n}")
        storage.reindex()
        if [header.model_dump() for header in storage.list_episodes()] != listed:
            raise WrongError("the catalog made anew differs")
        figures["episodes in the end"], figures["steps in the end"] = (
            len(listed),
            sum(n for n, _ in found.values()),
        )
        if not again:
            storage.compact()
    acknowledged = ledger.episodes()
    figures["episodes acknowledged"] = len(acknowledged)
    figures["steps acknowledged"] = sum(steps for steps, _ in acknowledged.values())
    figures["deletions acknowledged"] = len(gone)
    figures["recordings"] = sum(1 for _ in place.storage.rglob("*.mcap"))
    storage.close()
    return figures


def _read_all(storage: FileStorage) -> dict[Key, tuple[int, str]]:
    headers: dict[str, set[int]] = {}
    for header in storage.list_episodes():
        headers.setdefault(header.recording, set()).add(header.episode)
    found: dict[Key, tuple[int, str]] = {}
    for name, numbers in headers.items():
        with storage.open_recording(name) as recording:
            for number, key, steps, end in check_recording(recording):
                if number in numbers:
                    if key in found:
                        raise WrongError(f"{key} is there twice, again in {name}")
                    found[key] = (steps, end)
    return found


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--seconds", type=float, default=60)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--writers", type=int, default=8)
    parser.add_argument("--others", type=int, default=4)
    parser.add_argument("--patience", type=float, default=120)
    parser.add_argument("--keep", action="store_true", help="keep the directory, also of a run without fault")
    options = parser.parse_args()
    root = Path(tempfile.mkdtemp(prefix="tupli-concurrency-"))
    os.environ["TUPLI_MCAP_CONFIG_DIR"] = str(root / "config")
    os.environ["TUPLI_MCAP_CACHE_DIR"] = str(root / "cache")
    try:
        figures = run(root, options.seconds, options.seed, options.writers, options.others, options.patience)
    except WrongError as err:
        sys.exit(f"{err}\nkept in {root}")
    for name, n in sorted(figures.items()):
        print(f"{name:26} {n:>9,}")
    print("nothing lost, nothing back, nobody waiting")
    if not options.keep:
        shutil.rmtree(root)


if __name__ == "__main__":
    main()
