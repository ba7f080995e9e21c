"""The other libraries: Minari, PyTupli and the writer and reader of the `mcap` package.

Minari and PyTupli are optional; `missing(...)` names the ones that are not installed.
"""

from __future__ import annotations

import importlib.util
import itertools
import logging
import os
import warnings
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
from mcap.reader import make_reader
from mcap.writer import CompressionType, Writer
from numpy.typing import NDArray

from benchmarks.measure import Stopwatch, check
from benchmarks.workloads import SEED, Columns, Workload

MINARI_NEEDS = {"hdf5": ("minari", "h5py", "jax", "PIL"), "arrow": ("minari", "pyarrow", "jax", "PIL")}
MINARI_NEEDS["parquet"] = MINARI_NEEDS["arrow"]
PYTUPLI_NEEDS = ("pytupli",)


def missing(needs: Sequence[str]) -> list[str]:
    """The modules among `needs` that cannot be imported."""
    return [name for name in needs if importlib.util.find_spec(name) is None]


# ----------------------------------------------------------------------------------------------------- Minari


@contextmanager
def _minari_home(directory: Path) -> Iterator[None]:
    """Let Minari keep its data in `directory`, without its advice on authors and descriptions."""
    directory.mkdir(parents=True, exist_ok=True)
    before = os.environ.get("MINARI_DATASETS_PATH")
    os.environ["MINARI_DATASETS_PATH"] = str(directory)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            yield
    finally:
        if before is None:
            del os.environ["MINARI_DATASETS_PATH"]
        else:
            os.environ["MINARI_DATASETS_PATH"] = before


def record_minari(
    workload: Workload, directory: Path, fmt: str, episodes: int
) -> tuple[float, float, int, Any]:
    """Record with DataCollector and make a dataset of it, in an empty `directory`.

    Returns:
        Seconds of constructing the collector and rolling out, seconds of create_dataset, steps, the dataset.
    """
    import minari

    rollout, create = Stopwatch(), Stopwatch()
    with _minari_home(directory):
        inner = workload.make()
        with rollout:
            env = minari.DataCollector(inner, data_format=fmt)
            steps = workload.rollout(env, episodes)
        with create:
            dataset = env.create_dataset(dataset_id=f"{workload.name}-v0")
        env.close()
    return rollout.seconds, create.seconds, steps, dataset


def read_minari(dataset: Any) -> Columns:
    """Every episode of the dataset, concatenated."""
    episodes = list(dataset.iterate_episodes())
    names = ("actions", "rewards", "terminations", "truncations")
    columns = {name: np.concatenate([getattr(episode, name) for episode in episodes]) for name in names}
    return Columns(
        np.concatenate([episode.observations[:-1] for episode in episodes]),
        columns["actions"],
        columns["rewards"],
        columns["terminations"],
        columns["truncations"],
        np.concatenate([episode.observations[1:] for episode in episodes]),
        np.array([len(episode.rewards) for episode in episodes], np.int64),
    )


def check_minari(workload: Workload, dataset: Any, steps: int) -> None:
    """Replay what Minari recorded: it seeds every reset itself, so its episodes are not the reference's."""
    env = workload.make()
    next_action = itertools.cycle(workload.actions).__next__
    total = 0
    for number, episode in enumerate(dataset.iterate_episodes()):
        metadata = next(iter(dataset.storage.get_episode_metadata([number])))
        seed = SEED if number == 0 else metadata["seed"]
        check(metadata["seed"] == seed, f"episode {number} has seed {metadata['seed']!r}, not {seed}")
        states = [env.reset(seed=int(seed))[0]]
        for action in episode.actions:
            check(np.array_equal(action, next_action()), f"episode {number} has another action")
            states.append(env.step(action)[0])
        check(np.array_equal(episode.observations, states), f"episode {number} has other observations")
        total += len(episode.actions)
    check(total == steps, f"{total} steps, not {steps}")


# ---------------------------------------------------------------------------------------------------- PyTupli


def record_pytupli(workload: Workload, directory: Path, episodes: int) -> tuple[float, int, Any]:
    """Record with TupliEnvWrapper into a FileStorage; storing the benchmark first is not counted.

    Returns:
        Seconds of constructing the wrapper, rolling out and closing it, steps, the storage.
    """
    from pytupli.benchmark import TupliEnvWrapper
    from pytupli.storage import FileStorage

    logging.getLogger("pytupli").setLevel(logging.ERROR)
    storage = FileStorage(str(directory))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        first = TupliEnvWrapper(workload.make(), storage=storage)
        first.store(name="bench")
    inner = workload.make()
    watch = Stopwatch()
    with watch:
        env = TupliEnvWrapper(inner, storage=storage, benchmark_id=first.id)
        steps = workload.rollout(env, episodes)
        env.close()
    return watch.seconds, steps, storage


def read_pytupli(storage: Any) -> tuple[NDArray[Any], ...]:
    """`TupliDataset.load` and `convert_to_tensors`: observations, actions, rewards, terminals, timeouts."""
    from pytupli.dataset import TupliDataset

    dataset = TupliDataset(storage)
    dataset.load()
    arrays: tuple[NDArray[Any], ...] = dataset.convert_to_tensors()
    return arrays


def check_pytupli(storage: Any, reference: Columns) -> None:
    """PyTupli's states are the next observations; its episodes come back in no particular order."""
    states, actions, rewards, terminals, timeouts = read_pytupli(storage)

    def sorted_rows(*columns: NDArray[Any]) -> NDArray[Any]:
        rows = np.column_stack([np.asarray(column, np.float64) for column in columns])
        return rows[np.lexsort(rows.T)]

    found = sorted_rows(states, actions, rewards, terminals, timeouts)
    wanted = sorted_rows(
        reference.next_states, reference.actions, reference.rewards, reference.terminals, reference.timeouts
    )
    check(np.array_equal(found, wanted), "other tuples than were rolled out")


# ------------------------------------------------------------------------------------------------------- mcap


class BareWriter(gym.Wrapper[Any, Any, Any, Any]):
    """One `Writer.add_message` a step, with the bytes prepared: no clock, no encoding, no episodes."""

    def __init__(self, env: gym.Env[Any, Any], path: Path, schema: bytes, messages: Sequence[bytes]) -> None:
        super().__init__(env)
        self._writer = Writer(str(path), compression=CompressionType.ZSTD)
        self._writer.start()
        schema_id = self._writer.register_schema("tupli_mcap/msg/Step", "ros2msg", schema)
        self._channel = self._writer.register_channel("/step", "cdr", schema_id)
        self._messages = messages
        self._count = 0

    def step(self, action: Any) -> tuple[Any, Any, bool, bool, dict[str, Any]]:
        result = self.env.step(action)
        count = self._count
        self._writer.add_message(self._channel, count, self._messages[count], count, count)
        self._count = count + 1
        return result

    def close(self) -> None:
        self._writer.finish()  # type: ignore[no-untyped-call]
        super().close()


def record_mcap(
    workload: Workload, path: Path, schema: bytes, messages: Sequence[bytes], episodes: int
) -> tuple[float, int]:
    """Seconds of constructing BareWriter, rolling out and finishing the file, and the number of steps."""
    inner = workload.make()
    watch = Stopwatch()
    with watch:
        env = BareWriter(inner, path, schema, messages)
        steps = workload.rollout(env, episodes)
        env.close()
    return watch.seconds, steps


def step_messages(path: Path, limit: int, *, log_time_order: bool = True) -> tuple[bytes, list[bytes]]:
    """The schema and the first `limit` messages of `/step`, read with the `mcap` package, not decoded."""
    with path.open("rb") as stream:
        found = make_reader(stream).iter_messages(topics=["/step"], log_time_order=log_time_order)
        data, schema_text = [], b""
        for schema, _, message in itertools.islice(found, limit):
            schema_text = schema.data if schema is not None else b""
            data.append(message.data)
    return schema_text, data
