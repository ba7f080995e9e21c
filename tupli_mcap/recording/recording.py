"""`Recording`: one file, read by columns, episodes and steps."""

from __future__ import annotations

import copy
import html
import os
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import TYPE_CHECKING, Any, Self, TypeVar, overload

import numpy as np

from tupli_mcap.arrays import Array
from tupli_mcap.errors import FormatError, RecordingError, memory_for, plural
from tupli_mcap.mcap.source import TemporarySource
from tupli_mcap.messages.episodes import EpisodeStart
from tupli_mcap.messages.infos import InfoCodec
from tupli_mcap.messages.step import StepLayout
from tupli_mcap.messages.topics import EPISODE_START, FINAL_STATE, INFO
from tupli_mcap.recording.about.described import DescribedRecording
from tupli_mcap.recording.columns.fields import FIVE, field_names, fields_and_parts
from tupli_mcap.recording.columns.read import ColumnReader, Columns, StoredSteps
from tupli_mcap.recording.columns.runs import Runs, runs_of
from tupli_mcap.recording.episode import Episode, Episodes
from tupli_mcap.recording.frames import Frames, gathered
from tupli_mcap.recording.index import LARGE_SEED
from tupli_mcap.recording.verbs import DatasetVerbs

if TYPE_CHECKING:
    from pathlib import Path

    from tupli_mcap.dataset import Dataset
    from tupli_mcap.recording.about.annotations import Annotation

T = TypeVar("T")
_THREADS = min(4, os.cpu_count() or 1)
_OF_ROWS = (*FIVE, "times")  # fields that the rows of steps and images hold


class Recording(DescribedRecording, DatasetVerbs):
    """An MCAP recording, open for reading.

    Opening reads only the summary and the episode index. A file without a summary (its writer was killed, or is still
    at work) is recovered in memory: `complete` is False, all finished steps are there, and episodes that had not ended
    are "interrupted". Nothing in the file is executed. Reading is thread-safe.

        with tupli_mcap.Recording("runs/first.mcap") as recording:
            columns = recording.read(["states", "rewards"], episodes=[0])
            print(columns.rewards.sum() == recording.returns[0])

    Args:
        source: a path, a URL (with the extra `remote`), or an open binary file.
        cache_bytes: budget for decompressed chunks.

    Raises:
        RecordingError: the file cannot be opened.
        FormatError: it is no recording, or damaged.
    """

    @property
    def episodes(self) -> Episodes:
        """The episodes, lazily: length, indexing, slicing, iteration."""
        return Episodes(self)

    @property
    def dataset(self) -> Dataset:
        """Its episodes as a `Dataset`, which opens the file by its path.

        Raises:
            DatasetError: it was opened as a file object.
        """
        from tupli_mcap import dataset

        return dataset.open(self)

    @overload
    def __getitem__(self, chosen: int | np.integer[Any]) -> Episode: ...
    @overload
    def __getitem__(self, chosen: slice | Sequence[int] | Array) -> Dataset: ...
    def __getitem__(self, chosen: int | np.integer[Any] | slice | Sequence[int] | Array) -> Episode | Dataset:
        """`recording[3]` is an episode; `recording[-5:]`, `recording[[4, 2]]` and `recording[mask]` are datasets."""
        if isinstance(chosen, int | np.integer) and not isinstance(chosen, bool):
            return self.episodes[int(chosen)]
        return self.dataset[chosen]

    def __iter__(self) -> Iterator[Episode]:
        return iter(self.episodes)

    def __add__(self, other: Recording | Dataset) -> Dataset:
        """The episodes of both, those of this recording first."""
        return self.dataset + other

    def annotate(self, /, **values: Any) -> None:
        """Adds metadata to all episodes, in the file: `recording.annotate(success=True)`.

        Values take precedence over the metadata that were recorded; None removes a key. `undo_annotation` takes them
        back. `recording[3].annotate(...)` and `recording.filter("return > 100").annotate(...)` are for some episodes.

        Raises:
            RecordingError: the recording has no path, or another one is there now. Other errors are those of
                `annotate_episodes`.
        """
        self.annotate_numbers(None, values)

    def annotate_numbers(
        self, episodes: Sequence[int] | None, values: Mapping[str, Any], *, dry_run: bool = False
    ) -> None:
        """As `annotate`, for episodes by their numbers (None: all); `dry_run` only raises the errors."""
        from tupli_mcap.recording.edit.annotate import annotate_episodes

        self._annotated(lambda path: annotate_episodes(path, values, episodes, dry_run=dry_run), episodes)

    def undo_annotation(self, *, dry_run: bool = False) -> Annotation:
        """Takes the last annotation back from all its episodes, and returns it; `dry_run` only returns it.

        Raises:
            RecordingError: there is none, or as `annotate`.
        """
        from tupli_mcap.recording.edit.annotate import undo_annotation

        return self._annotated(lambda path: undo_annotation(path, dry_run=dry_run))

    def _annotated(self, change: Callable[[Path], T], episodes: Sequence[int] | None = None) -> T:
        """Changes the annotations in the file, of these episodes; returns what the change returned."""
        if self.path is None:
            # a user knows an episode of a server by its id, not by the path of its recording there
            what = f"episode {self.uuid}-{episodes[0]}" if episodes else self.name
            raise RecordingError(
                f"{what} cannot be changed here; download it (from a server: tupli-mcap pull), and open the copy"
            )
        with Recording(self.path) as there:
            if there.uuid != self.uuid:
                raise RecordingError(f"{self.path} is another recording now; open it again")
        found = change(self.path)
        with Recording(self.path) as changed:
            self.annotations = changed.annotations
        return found

    # ---- episodes

    def episode_start(self, i: int) -> EpisodeStart:
        """The `/episode_start` message of episode `i`; IndexError if there is no such episode."""
        return self.episode_starts([self.episodes[i].position])[0]

    @property
    def lengths(self) -> Array:
        """Steps of each episode: int64 (episodes,)."""
        return self.index["length"].astype(np.int64)

    @property
    def returns(self) -> Array:
        """The sum of each episode's rewards: float64 (episodes,), NaN if a reward is. Of rewards that are arrays or
        dicts, all numbers are added; texts count 0."""
        return self.index["return"].copy()

    @property
    def seeds(self) -> list[int | None]:
        """The seed of each episode, None if it has none. Seeds beyond 64 bits are read from the episodes' starts.

        The index of files from earlier versions does not mark such seeds; there, only `Episode.seed` has them.
        """
        rows = self.index
        fields = zip(rows["has_seed"].tolist(), rows["seed"].tolist(), strict=True)
        seeds = [seed if has_seed else None for has_seed, seed in fields]
        for i in np.flatnonzero(rows["has_seed"] == LARGE_SEED).tolist():
            seeds[i] = self.episode_start(i).seed_number
        return seeds

    def episode_starts(self, episodes: Sequence[int] | Array) -> list[EpisodeStart]:
        """The `/episode_start` messages of some episodes (positions or a mask), read together; RecordingError if there
        are no such episodes."""
        rows = self.index[self._positions(episodes)]
        if not len(rows):
            return []
        at = rows["start_row"].astype(np.int64)
        first = int(at.min())
        bodies = list(self._store.bodies(self._channel(EPISODE_START), first, int(at.max()) + 1 - first))
        starts = [EpisodeStart.decode(bodies[i]) for i in (at - first).tolist()]
        for start, episode in zip(starts, rows["episode"].tolist(), strict=True):
            if start.episode != episode:
                raise FormatError(
                    f"{self.name}: expected the start of episode {episode}, found {start.episode}"
                )
        return starts

    def resets_before(self, i: int) -> list[EpisodeStart]:
        """The resets without a step directly before that of episode `i`, the earliest first.

        They are recorded if later resets had no seed, since the random stream then goes on from them. An entry that is
        `continued` was no reset: it says that the random stream does not go on from the episode before.
        """
        row = self._row(i)
        found: list[EpisodeStart] = []
        for at in range(int(row["start_row"]) - 1, -1, -1):
            (body,) = self._store.bodies(self._channel(EPISODE_START), at, 1)
            start = EpisodeStart.decode(body)
            if start.episode != row["episode"] or start.env != row["env"]:
                break
            found.append(start)
        return found[::-1]

    def final_state(self, i: int) -> Any:
        """The final state of episode `i`, nested as the observation space; None if it is not known. IndexError if there
        is no such episode."""
        position = self.episodes[i].position
        rows = self.index[position : position + 1]
        if rows["final_row"][0] < 0:
            return None
        columns = self._reader.final_columns(self._channel(FINAL_STATE), rows, self.layout.state)
        values = [
            column[0] if isinstance(column, list) or leaf.is_scalar else column[0, ...]
            for leaf, column in zip(self.layout.state, columns, strict=True)
        ]
        return self.layout.nest_state(values)

    def final_states(self, episodes: Sequence[int] | Array) -> Any:
        """The final states of some episodes (positions or a mask) as columns, nested as the observation space is.

        Raises:
            RecordingError: the final state of one of them is not known (`index["final_row"]` is -1).
        """
        rows = self.index[self._positions(episodes)]
        unknown = rows["episode"][rows["final_row"] < 0]
        if len(unknown):
            raise RecordingError(
                f"{self.name}: the final state of episode {unknown[0]} is not known; leave it out"
            )
        if not len(rows):
            return self.read(["states"], episodes=[]).states
        columns = self._reader.final_columns(self._channel(FINAL_STATE), rows, self.layout.state)
        return self.layout.nest_state(columns)

    @property
    def _reader(self) -> ColumnReader:
        if self._columns is None:
            raise RecordingError(f"{self.name} has no step yet; record a step first")
        return self._columns

    def infos(self, i: int) -> list[dict[str, Any] | None] | None:
        """The recorded info of each step of episode `i` (None for a step without one); None if the recording has no
        infos. The caller may change them. IndexError if there is no such episode."""
        return self.infos_of_steps(i, 0, None)

    def infos_of_steps(self, i: int, start: int, stop: int | None) -> list[dict[str, Any] | None] | None:
        """As `infos`, of the steps `start:stop`."""
        row, channel = self._row(i), self._topics.get(INFO)
        if channel is None:
            return None
        if self._infos is None:
            codec = InfoCodec.from_metadata(self._contents.channels[channel].metadata)
            found: dict[int, dict[int, bytes]] = {}
            for body in self._store.bodies(channel, 0, self._store.count(channel)):
                episode, step = codec.place(body)
                found.setdefault(episode, {})[step] = bytes(body)
            self._infos = codec, found
        codec, messages = self._infos
        bodies = messages.get(int(row["episode"]), {})
        steps = range(int(row["length"]))[start:stop]
        # decoded each time, so that what a caller changes is changed for nobody else
        return [codec.decode(memoryview(bodies[step]))[2] if step in bodies else None for step in steps]

    def _row(self, i: int) -> Any:
        """The row of episode `i` in the index, from the end if it is negative; raises IndexError if there is none."""
        return self.index[self.episodes[i].position]

    # ---- frames

    @property
    def cameras(self) -> tuple[str, ...]:
        """The cameras with recorded frames; empty if there are none."""
        return self._cameras.names

    def frames(self, i: int, camera: str | None = None) -> Frames:
        """The frames of episode `i`; empty if the recording has no camera, or the episode no frames.

        Args:
            camera: one of `cameras`; by default "render", or else the first one.

        Raises:
            IndexError: there is no such episode.
            RecordingError: there is no such camera.
        """
        row = self._row(i)
        env = int(row["env"])
        if camera is None:
            camera = "render" if "render" in self.cameras or not self.cameras else self.cameras[0]
            if not self.cameras:
                none = np.empty(0, np.int64)
                return Frames(self._cameras, camera, env, none, none, none)
        rows = self._cameras.rows(camera, env, int(row["episode"]), int(row["length"]))
        return Frames(self._cameras, camera, env, *rows)

    # ---- columns

    def read(
        self,
        fields: Sequence[str] = FIVE,
        *,
        episodes: Sequence[int] | Array | None = None,
        threads: int | None = None,
        images: bool = True,
    ) -> Columns:
        """Columns of the given episodes (all by default), one after another in the order given.

        Args:
            fields: some of "states", "actions", "rewards", "terminals", "timeouts", "next_states", "times", "infos" and
                "frames"; the first five by default. Gymnasium's names (observations, terminations, …) mean the same.
                "state.arm" or "action.grip", a part of a Dict, leaves the others out of `states` and `next_states`, or
                of `actions`; images that are left out are not read.
            episodes: positions in `self.episodes`, or a bool for each of them.
            threads: how many threads decompress; by default as many as there are cores, at most 4.
            images: False leaves the columns of image leaves empty and reads no image; not possible for `next_states`.

        If an episode's final state is not known, `next_states` repeats its last state.

        Raises:
            RecordingError: an episode or a field does not exist.
            SpaceError: the state or the action has no such part.
            FormatError: a chunk is damaged.
        """
        fields, parts = fields_and_parts(fields)
        if not images and "next_states" in fields:
            raise RecordingError("expected images=True for next_states, found False; read states instead")
        positions = np.arange(len(self.index)) if episodes is None else self._positions(episodes)
        rows = self.index if episodes is None else self.index[positions]
        lengths = rows["length"].astype(np.int64)
        total = int(lengths.sum())
        columns = Columns(lengths)
        if self._layout is None:
            return columns
        layout = self._layout.only(parts)
        needed = [field for field in fields if field not in ("next_states", "infos", "frames")]
        if "next_states" in fields and "states" not in needed:
            needed.append("states")
        with memory_for(lambda: f"{self.name}: reading {', '.join(fields)} of {total} steps"):
            runs = runs_of(rows, self._step_channels)
            keep = episodes is not None
            found = self._reader.read(runs, total, needed, threads or _THREADS, keep, images, parts)
            if "next_states" in fields:
                columns.next_states = self._next_states(found["states"], rows, lengths, layout)
        for field in fields:
            if field in found:
                setattr(columns, field, found[field])
        if "infos" in fields:
            columns.infos = [info for i in positions.tolist() for info in self._infos_of(i)]
        if "frames" in fields:
            ends = np.cumsum(lengths)
            pictures = (
                (self.frames(i), np.arange(end - start), np.arange(start, end))
                for i, start, end in zip(positions.tolist(), ends - lengths, ends, strict=True)
            )
            with memory_for(lambda: f"{self.name}: decoding {total} frames"):
                columns.frames = gathered(pictures, total)
        return columns

    def _infos_of(self, i: int) -> list[dict[str, Any]]:
        """A dict for each step of episode `i`; empty if no info was recorded."""
        infos = self.infos(i)
        return (
            [{} for _ in range(int(self.index["length"][i]))]
            if infos is None
            else [info or {} for info in infos]
        )

    def _positions(self, episodes: Any) -> Any:
        """Positions in the index, from positions or a mask; raises RecordingError for anything else."""
        try:
            chosen = np.asarray(episodes)
        except ValueError:  # values of different shapes
            chosen = np.empty((), object)
        n = len(self.index)
        if chosen.dtype.kind == "b" and chosen.shape == (n,):
            return np.flatnonzero(chosen)
        if chosen.ndim != 1 or (len(chosen) and chosen.dtype.kind not in "iu"):
            raise RecordingError(
                f"{self.name}: expected a list of positions from 0 to {n - 1}, or a mask of {n} bools, "
                f"found {episodes!r:.100}"
            )
        if len(chosen) and (chosen.min() < 0 or chosen.max() >= n):
            raise RecordingError(f"{self.name}: expected episodes from 0 to {n - 1}, found {episodes!r:.100}")
        return chosen.astype(np.int64)

    def read_steps(
        self, i: int, start: int, stop: int, fields: Sequence[str] = FIVE, *, images: bool = True
    ) -> Columns:
        """Columns of the steps `start:stop` of episode `i`; their chunks stay in the cache. `fields` and `images` are
        as for `read`, without "next_states", "infos" and "frames".

        Raises:
            IndexError: there is no such episode.
            RecordingError: it has no such steps, or this reads no such field.
            FormatError: a chunk is damaged.
        """
        fields, row = field_names(fields, _OF_ROWS), self._row(i)
        count = stop - start
        if not 0 <= start <= stop <= int(row["length"]):
            raise RecordingError(
                f"{self.name}: expected steps from 0 to {row['length']}, found {start}:{stop}"
            )
        channel = self._step_channels[int(row["env"])]
        run = Runs([channel], [int(row["first_row"]) + start], [count])
        columns = Columns(np.array([count]))
        with memory_for(lambda: f"{self.name}: reading {', '.join(fields)} of {count} steps"):
            for field, values in self._reader.read(run, count, fields, 1, True, images).items():
                setattr(columns, field, values)
        return columns

    def _next_states(self, states: Any, rows: Any, lengths: Any, layout: StepLayout) -> Any:
        known = rows["final_row"] >= 0
        ends = np.cumsum(lengths) - 1
        finals: list[Any] = []
        if known.any():
            finals = self._reader.final_columns(self._channel(FINAL_STATE), rows[known], layout.state)
        columns = []
        for i, leaf in enumerate(layout.state):
            column = leaf.get(states)
            if isinstance(column, list):
                shifted: Any = column[1:] + column[-1:]
                for end in ends[~known]:
                    shifted[end] = column[end]
                for end, value in zip(ends[known], finals[i] if finals else [], strict=True):
                    shifted[end] = value
            else:
                shifted = np.concatenate([column[1:], column[-1:]])
                shifted[ends[~known]] = column[ends[~known]]
                if finals:
                    shifted[ends[known]] = finals[i]
            columns.append(shifted)
        return layout.nest_state(columns)

    @property
    def stored(self) -> StoredSteps:
        """A handle to the recording's step chunks; raises RecordingError before the first step."""
        finals = self._topics.get(FINAL_STATE)
        where, source = self.address, self._source
        return StoredSteps(self.layout, self._store, self._step_channels, self._images, finals, where, source)

    replay = DatasetVerbs.view

    def __reduce__(self) -> tuple[Callable[..., Recording], tuple[Any, ...]]:
        """Pickles the path: a copy in another process opens the file itself. That of a server's recording reads the
        same temporary file, while this one is open."""
        if isinstance(self._source, TemporarySource):
            return _opened_again, (type(self), copy.copy(self._source), self.uuid, self._cache_bytes)
        if self.address is None:
            raise RecordingError(
                f"{self.name} was opened as a file object, which cannot be copied; give its path"
            )
        return _opened_again, (type(self), self.address, self.uuid, self._cache_bytes)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def __len__(self) -> int:
        return len(self.index)

    def _repr_html_(self) -> str:
        return html.escape(repr(self)) if self.address is None else self.dataset._html("Recording")

    def __repr__(self) -> str:
        state = "" if self.complete else ", unfinished"
        return f"<Recording {self.name}: {plural(len(self.index), 'episode')}, {plural(self.n_steps, 'step')}{state}>"


def _opened_again(
    kind: type[Recording], source: str | TemporarySource, uuid: str, cache_bytes: int
) -> Recording:
    recording = kind(source, cache_bytes=cache_bytes)
    if recording.uuid != uuid:
        recording.close()
        raise RecordingError(
            f"{recording.name} is a different recording now (expected {uuid}, found {recording.uuid})"
        )
    return recording
