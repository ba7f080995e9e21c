"""tupli-mcap: recordings as they are, and their columns saved."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from tools.bench.contenders.base import LOADED, CannotError, Contender, Session
from tools.bench.data import Array, flat
from tools.bench.measure import Stopwatch
from tools.bench.workloads import STEPS, Workload


def leaves(found: Any) -> dict[str, Any]:
    """The leaves of columns, an episode or a window."""
    return flat(found.states) | {name: getattr(found, name) for name in STEPS}


class _Episodes(Session):
    def __init__(self, path: Path) -> None:
        from tupli_mcap import Recording

        self._recording = Recording(path)
        super().__init__(self._recording.index["length"].astype(np.int64))

    def episode(self, number: int) -> dict[str, Any]:
        return leaves(self._recording.episodes[number])

    def window(self, number: int, start: int, length: int) -> dict[str, Any]:
        return leaves(self._recording.episodes[number][start : start + length])

    def close(self) -> None:
        self._recording.close()


class Ours(Contender):
    """`RecordEpisodes`, `Recording`, `TupliDataset` and `tupli_mcap.torch`."""

    def wrap(self, env: Any, work: Workload, path: Path) -> Any:
        from tupli_mcap import RecordEpisodes

        return RecordEpisodes(env, path)

    def wrap_vector(self, env: Any, path: Path) -> Any:
        from tupli_mcap.vector import RecordEpisodes

        return RecordEpisodes(env, path)

    def read_vector(self, path: Path) -> dict[str, Any]:
        from tupli_mcap import Recording

        with Recording(path) as recording:
            lengths = recording.index["length"].astype(np.int64)
            return leaves(recording.read()) | {"env": np.repeat(recording.index["env"], lengths)}

    def append(self, work: Workload, path: Path, episodes: int) -> tuple[float, int]:
        from tupli_mcap import RecordEpisodes

        env, watch = work.make(), Stopwatch()
        with watch:
            recorder = RecordEpisodes(env, path, mode="a")
            steps = work.rollout(recorder, episodes)
            recorder.close()
        return watch.seconds, steps

    def listing(self, path: Path) -> Array:
        from tupli_mcap import Recording

        with Recording(path) as recording:
            return np.array([len(episode) for episode in recording.episodes])

    def read(self, path: Path) -> tuple[dict[str, Any], Array | None]:
        from tupli_mcap import Recording

        with Recording(path) as recording:
            columns = recording.read()
        return leaves(columns), columns.episode_lengths

    def field(self, path: Path) -> Array:
        from tupli_mcap import Recording

        with Recording(path) as recording:
            actions: Array = recording.read(fields=["actions"]).actions
            return actions

    def open(self, path: Path) -> Session:
        return _Episodes(path)

    def dataset(self, path: Path) -> Any:
        """The recording as a dataset."""
        from tupli_mcap import TupliDataset

        return TupliDataset.from_files(path)

    def select(self, path: Path, least: float) -> dict[str, Any]:
        from tupli_mcap import F

        chosen = self.dataset(path).with_episode_filter(F("episode_return") >= least)
        return dict(zip(("states", *STEPS), chosen.convert_to_numpy(), strict=True)) | _flat_states(chosen)

    def loader_parts(self, path: Path, length: int, stride: int) -> tuple[Any, Any]:
        """A map-style dataset of windows for PyTorch, and what its DataLoader collates with."""
        from tupli_mcap.torch import MapDataset, collate

        windows = self.dataset(path).windows(length, stride, fields=LOADED)
        return MapDataset(windows), collate


def _flat_states(dataset: Any) -> dict[str, Any]:
    return flat(dataset.observations)


class _Mapped(Session):
    """Episodes are runs of steps of the columns."""

    def __init__(self, columns: Any) -> None:
        self._steps = columns.steps
        super().__init__(self._steps.episode_lengths)
        self._starts = np.cumsum(self.lengths) - self.lengths

    def episode(self, number: int) -> dict[str, Any]:
        return self.window(number, 0, int(self.lengths[number]))  # type: ignore[index]

    def window(self, number: int, start: int, length: int) -> dict[str, Any]:
        first = int(self._starts[number]) + start
        found = self._steps.read(("states", *STEPS), np.arange(first, first + length))
        return flat(found.pop("states")) | found


class SavedColumns(Ours):
    """The same recording, whose columns were written once as files that are mapped into memory."""

    note = "recorded as above, then `dataset.save_columns(...)`; that is not counted as recording"

    def record(self, work: Workload, path: Path, episodes: int) -> tuple[float, int]:
        path.mkdir()
        found = super().record(work, path / "run.mcap", episodes)
        if work.table == "mission":
            raise CannotError("texts are in no array")
        super().dataset(path / "run.mcap").save_columns(path / "columns")
        return found

    def append(self, work: Workload, path: Path, episodes: int) -> tuple[float, int]:
        raise CannotError("columns are written once")

    def dataset(self, path: Path) -> Any:
        """The columns."""
        from tupli_mcap.dataset import open_columns

        return open_columns(path / "columns")

    def read(self, path: Path) -> tuple[dict[str, Any], Array | None]:
        steps = self.dataset(path).steps
        found = steps.read(("states", *STEPS), np.arange(len(steps)))
        return flat(found.pop("states")) | found, steps.episode_lengths

    def field(self, path: Path) -> Array:
        steps = self.dataset(path).steps
        actions: Array = steps.read(("actions",), np.arange(len(steps)))["actions"]
        return actions

    def listing(self, path: Path) -> Array:
        raise CannotError("as above")

    def select(self, path: Path, least: float) -> dict[str, Any]:
        raise CannotError("are filtered before they are saved")

    def open(self, path: Path) -> Session:
        return _Mapped(self.dataset(path))
