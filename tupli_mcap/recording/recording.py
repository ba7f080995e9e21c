"""`Recording`: one file, opened by its summary and episode index, read by columns, episodes and steps."""

from __future__ import annotations

import contextlib
import os
import warnings
from collections.abc import Callable, Mapping, Sequence
from functools import cached_property
from pathlib import Path, PurePosixPath
from types import MappingProxyType
from typing import Any, BinaryIO, NamedTuple

import gymnasium as gym
import numpy as np
from mcap.records import Channel

from tupli_mcap import jsonvalue
from tupli_mcap.environment import EnvironmentRecord, build, reasons_for_distrust
from tupli_mcap.errors import FormatError, RecordingError, TupliError, memory_for
from tupli_mcap.mcap.records import BODY, read_attachment
from tupli_mcap.mcap.source import Source, open_source
from tupli_mcap.messages.episodes import END_NAME, END_SCHEMA, START_NAME, START_SCHEMA, EpisodeStart
from tupli_mcap.messages.images.codecs import image_codecs
from tupli_mcap.messages.infos import InfoCodec
from tupli_mcap.messages.step import FINAL_STATE_SCHEMA, STEP_SCHEMA, StepLayout
from tupli_mcap.messages.topics import EPISODE_END, EPISODE_START, FINAL_STATE, INFO, Topics
from tupli_mcap.recording.about.annotations import ANNOTATIONS_NAME, MAX_ANNOTATIONS, Annotations
from tupli_mcap.recording.about.run import MAX_RUN, RUN_NAME, RecordedRuns, Run, file_name
from tupli_mcap.recording.columns.chunk_store import ChunkStore
from tupli_mcap.recording.columns.fields import FIVE, field_names
from tupli_mcap.recording.columns.read import ColumnReader, Columns, StoredSteps
from tupli_mcap.recording.columns.runs import Runs, runs_of
from tupli_mcap.recording.contents import Contents, step_channels
from tupli_mcap.recording.episode import Episodes
from tupli_mcap.recording.frames import Cameras, Frames
from tupli_mcap.recording.limits import EPISODE_TOPICS, StepClaims, check_episodes, check_rows
from tupli_mcap.recording.open import read_contents
from tupli_mcap.recording.signature_file import SIGNATURE_NAME, voucher
from tupli_mcap.spaces.labels import LABELS_NAME, MAX_LABELS, Labels
from tupli_mcap.spaces.leaves import Leaf
from tupli_mcap.trust import TrustedKey, is_trusted

__all__ = ["AttachmentInfo", "OpenFile", "RecordedBenchmark", "Recording"]

CACHE_BYTES = 512 << 20
_THREADS = min(4, os.cpu_count() or 1)


class AttachmentInfo(NamedTuple):
    """What a recording says of an attachment."""

    name: str
    media_type: str
    size: int


class OpenFile(NamedTuple):
    """The file of an open recording, for those who copy, check or sign what is in it.

    topics: the id of each topic's channel. steps: the ids of the step channels, by sub-environment.
    """

    source: Source
    contents: Contents
    store: ChunkStore
    topics: Mapping[str, int]
    steps: Sequence[int]
    cameras: Cameras


class RecordedBenchmark(NamedTuple):
    """The environment a recording was made with, as data. signature: the attachment of a signed recording."""

    id: str
    record: EnvironmentRecord
    signature: bytes | None = None

    def make_env(self, *, trust: bool = False, render_mode: str | None = None) -> gym.Env[Any, Any]:
        """Rebuilds the environment, with another `render_mode` if one is given and it has that.

        Raises:
            UntrustedError: code from the file would run, and neither is it trusted here, nor the key that signed it.
        """
        trust = trust or (self.needs_trust and self.voucher is not None)
        return build(self.record, trust=trust, render_mode=render_mode)

    @property
    def needs_trust(self) -> bool:
        """Whether rebuilding it runs code that this user has not trusted."""
        return bool(reasons_for_distrust(self.record)) and not is_trusted(self.record.digest)

    @property
    def voucher(self) -> TrustedKey | None:
        """The key, among those this user trusts, that signed the environment; None if none did."""
        return None if self.signature is None else voucher(self.signature, self.record.digest, self.id)


class Recording:
    """An MCAP recording, open for reading.

    Opening reads the summary and the episode index only. A file without a summary (its writer was killed, or is still
    at work) is recovered in memory: `complete` is False, all finished steps are there, the last episode is
    "interrupted". Nothing in the file is executed. Reading is safe from several threads.

    Args:
        source: a path, a URL (with the extra `remote`), or an open binary file.
        cache_bytes: budget for decompressed chunks.

    Raises:
        RecordingError: the file cannot be opened.
        FormatError: it is no recording, or damaged.
    """

    def __init__(self, source: str | os.PathLike[str] | BinaryIO, *, cache_bytes: int = CACHE_BYTES) -> None:
        self._source = open_source(source)
        self._reopen = None if not isinstance(source, str | os.PathLike) else _absolute(source)
        self._cache_bytes = cache_bytes
        self.name = self._source.name
        self.path: Path | None = self._source.path
        try:
            with memory_for(lambda: f"{self.name}: opening a file of {self._source.size} bytes"):
                self._contents: Contents = read_contents(self._source)
                self._store = ChunkStore(
                    self._source, self._contents.table, self._contents.memory, cache_bytes
                )
                self._prepare()
        except BaseException:
            self._source.close()
            raise

    def _prepare(self) -> None:
        contents = self._contents
        self.complete = contents.complete
        self.metadata: Mapping[str, str] = MappingProxyType(contents.metadata)
        self.index = contents.index.episodes
        topics = {channel.topic: channel for channel in contents.channels.values()}
        steps = step_channels(contents.channels, self.name)
        self._step_channels = [channel.id for channel in steps]
        self._layout: StepLayout | None = None
        self._columns: ColumnReader | None = None
        self._topics = {topic: channel.id for topic, channel in topics.items()}
        self._images: dict[str, dict[int, int]] = {}  # leaf -> step channel -> image channel
        self._infos: dict[int, dict[int, dict[str, Any]]] | None = None
        counts = {topic: self._store.count(self._topics.get(topic, 0)) for topic in EPISODE_TOPICS}
        rows = [self._store.count(channel) for channel in self._step_channels]
        check_episodes(self.index, rows, counts, self.name, whole=contents.complete)
        self._cameras = Cameras(contents, self._store, self.is_vector, len(steps), self.name)
        if steps:
            self._layout = StepLayout.from_metadata(steps[0].metadata)
            description = _spaces_of(steps[0])
            for channel in steps:
                self._check_schema(channel, STEP_SCHEMA, self._layout.step_schema)
                if _spaces_of(channel) != description:
                    raise FormatError(
                        f"{self.name}: {channel.topic} describes other spaces than {steps[0].topic}"
                    )
            if FINAL_STATE in topics:
                self._check_schema(topics[FINAL_STATE], FINAL_STATE_SCHEMA, self._layout.final_schema)
            self._images = {
                leaf.name: {
                    channel.id: self._topics.get(Topics.of_step(channel.topic).image(leaf.name), 0)
                    for channel in steps
                }
                for leaf in self._layout.images
            }
            self._check_others(topics)
            self._store.codecs = image_codecs(self._layout, contents.channels)
            if contents.complete:
                self._check_sizes(self._layout, rows)
            self._store.claims = {
                channel: StepClaims(self.index, env, self._store.table_of(channel))
                for env, channel in enumerate(self._step_channels)
            }
            self._columns = ColumnReader(self._layout, self._store, self._images)

    def _check_others(self, topics: Mapping[str, Channel]) -> None:
        """The messages of episodes are what their topics say."""
        for topic, name, text in (
            (EPISODE_START, START_NAME, START_SCHEMA), (EPISODE_END, END_NAME, END_SCHEMA),
        ):  # fmt: skip
            if topic in topics:
                self._check_schema(topics[topic], name, text)

    def _check_sizes(self, layout: StepLayout, steps: Sequence[int]) -> None:
        """The chunks hold the rows that the index says, and each step has its images, before columns are allocated."""
        if layout.constant:
            size = layout.step_message.record_size
        else:  # at least
            size = BODY + 10 + sum(_stored_bytes(layout, leaf) for leaf in layout.step_leaves)
        sizes = dict.fromkeys(self._step_channels, (size, layout.constant))
        if layout.constant and FINAL_STATE in self._topics:
            sizes[self._topics[FINAL_STATE]] = (layout.final_message.record_size, True)
        for leaf in layout.images:
            for count, channel in zip(steps, self._images[leaf.name].values(), strict=True):
                if self._store.count(channel) != count:
                    raise FormatError(
                        f"{self.name}: expected {count} images of {leaf.path}, found {self._store.count(channel)}; "
                        "recover it into a new file"
                    )
                if channel not in self._store.codecs:
                    sizes[channel] = (layout.image_messages[leaf.name].dtype.itemsize, True)
        check_rows(self._contents.table, sizes, self.name)

    def _check_schema(self, channel: Channel, name: str, text: str) -> None:
        schema = self._contents.schemas.get(channel.schema_id)
        if schema is None or schema.name != name or schema.data != text.encode():
            raise FormatError(f"{self.name}: the schema of {channel.topic} is not the one its spaces have")

    # ---- facts

    @property
    def uuid(self) -> str:
        """32 hex digits, made when the recording was."""
        return self.metadata["uuid"]

    @property
    def size(self) -> int:
        """Bytes of the file, as it was opened."""
        return self._source.size

    @property
    def benchmark_id(self) -> str:
        """The id of the benchmark; empty if there is none."""
        return self.metadata.get("benchmark_id", "")

    @property
    def created_ns(self) -> int:
        """Wall clock (ns) when the recording was made."""
        text = self.metadata.get("created_ns", "0")
        return int(text) if text.isdecimal() and len(text) <= 19 else 0

    @property
    def layout(self) -> StepLayout:
        """The layout of the steps; RecordingError if there is none yet."""
        if self._layout is None:
            raise RecordingError(
                f"{self.name} has no step yet, so its spaces are not known; record a step first"
            )
        return self._layout

    @property
    def observation_space(self) -> gym.Space[Any]:
        """The space of the states, of one sub-environment; RecordingError before the first step."""
        return self.layout.observation_space

    @property
    def action_space(self) -> gym.Space[Any]:
        """The space of the actions, of one sub-environment; RecordingError before the first step."""
        return self.layout.action_space

    @property
    def num_envs(self) -> int:
        """Sub-environments; 1 for a single environment."""
        return len(self._step_channels)

    @property
    def is_vector(self) -> bool:
        """True if a vector environment was recorded, of one sub-environment or more."""
        return Topics.of(0).step in self._topics

    @property
    def num_steps(self) -> int:
        """Steps of all episodes."""
        return int(self.index["length"].sum())

    @property
    def episodes(self) -> Episodes:
        """The episodes, lazily: length, indexing, slicing, iteration."""
        return Episodes(self)

    @property
    def attachments(self) -> Mapping[str, AttachmentInfo]:
        """The attachments, the episode index left out."""
        return {
            name: AttachmentInfo(name, a.media_type, a.data_size)
            for name, a in self._contents.attachments.items()
        }

    def read_attachment(self, name: str) -> bytes:
        """An attachment's bytes, its CRC checked."""
        if name not in self._contents.attachments:
            known = ", ".join(self._contents.attachments) or "none"
            raise RecordingError(f"{self.name} has no attachment {name!r}; it has {known}")
        return read_attachment(self._source, self._contents.attachments[name])

    @property
    def labels(self) -> Labels:
        """Names of dimensions and values, and the seconds of a step, as far as the recording says them.

        Raises:
            FormatError: they do not fit the recording.
        """
        info = self.attachments.get(LABELS_NAME)
        if info is None or self._layout is None:
            return Labels.none()
        where = f"{self.name}: {LABELS_NAME}"
        if info.size > MAX_LABELS:
            raise FormatError(f"{where}: expected at most {MAX_LABELS} bytes, found {info.size}")
        return Labels.from_json(self.read_attachment(LABELS_NAME), self._layout.leaves, where)

    @property
    def benchmark(self) -> RecordedBenchmark:
        """The environment that was recorded, as data; `make_env()` rebuilds it."""
        if "benchmark.json" not in self._contents.attachments:
            advice = "load its benchmark from the storage it is in"
            if not self.benchmark_id:
                advice = "it was left out, could not be captured, or lived in other processes"
            raise RecordingError(f"{self.name} carries no environment; {advice}")
        pickle = None
        if "env.cloudpickle" in self._contents.attachments:
            pickle = self.read_attachment("env.cloudpickle")
        where = f"{self.name}: benchmark.json"
        record = EnvironmentRecord.from_json(self.read_attachment("benchmark.json"), pickle, where=where)
        signature = self.read_attachment(SIGNATURE_NAME) if SIGNATURE_NAME in self.attachments else None
        return RecordedBenchmark(self.benchmark_id, record, signature)

    # ---- what somebody says about it

    @property
    def run(self) -> Run:
        """The run it is of; of a recording made of several, the first one. `run_of` says which an episode is of."""
        return self.runs[0]

    @cached_property
    def runs(self) -> list[Run]:
        """The runs that it is of, more than one where it was made of other recordings.

        Raises:
            FormatError: what it says of them is damaged.
        """
        rows = self.index
        ended = int(rows["end_time"].max()) if len(rows) else 0
        said, name = self.recorded_runs.runs, PurePosixPath(file_name(self.name)).stem
        environment = "" if all(run.environment for run in said) else self._environment_name
        return [run.known_as(name, environment, self.created_ns, ended) for run in said]

    @cached_property
    def run_places(self) -> list[int]:
        """For each episode, which of `runs` it is of."""
        return self.recorded_runs.places(len(self.index))

    def run_of(self, i: int) -> Run:
        """The run of episode `i`."""
        return self.runs[self.run_places[i]]

    @cached_property
    def recorded_runs(self) -> RecordedRuns:
        """`runs` as `run.json` has them: empty where the recording does not say it."""
        info = self.attachments.get(RUN_NAME)
        if info is None:
            return RecordedRuns([Run()])
        where = f"{self.name}: {RUN_NAME}"
        if info.size > MAX_RUN:
            raise FormatError(f"{where}: expected at most {MAX_RUN} bytes, found {info.size}")
        return RecordedRuns.from_json(self.read_attachment(RUN_NAME), where)

    @property
    def _environment_name(self) -> str:
        with contextlib.suppress(TupliError):  # damaged, which opening it says
            return self.benchmark.record.name
        return ""

    @cached_property
    def annotations(self) -> Annotations:
        """What was said about its episodes after they were recorded; FormatError if that is damaged."""
        info = self.attachments.get(ANNOTATIONS_NAME)
        if info is None:
            return Annotations()
        where = f"{self.name}: {ANNOTATIONS_NAME}"
        if info.size > MAX_ANNOTATIONS:
            raise FormatError(f"{where}: expected at most {MAX_ANNOTATIONS} bytes, found {info.size}")
        return Annotations(self.read_attachment(ANNOTATIONS_NAME), where)

    def listed_runs(self) -> list[dict[str, Any]]:
        """The run of each episode as filters see it; that of the file alone, with a warning, where it is damaged."""
        try:
            runs, places = self.runs, self.run_places
        except FormatError as err:
            warnings.warn(f"{err}; the run is not known", UserWarning, stacklevel=2)
            runs, places = (
                [Run().known_as(PurePosixPath(file_name(self.name)).stem, "", self.created_ns, 0)],
                [],
            )
        found = [run.as_dict() for run in runs]
        return [found[place] for place in places] or found * len(self.index)

    def annotate(self, episodes: Sequence[int] | None, values: Mapping[str, Any]) -> None:
        """Gives episodes (their numbers; None: all) values that count more than the metadata that were recorded.

        Raises:
            RecordingError: it has no path; otherwise as `annotate_episodes`.
        """
        from tupli_mcap.recording.edit.annotate import annotate_episodes

        if self.path is None:
            raise RecordingError(f"{self.name} is no file that can be changed; fetch it, and open the copy")
        annotate_episodes(self.path, values, episodes)
        with Recording(self.path) as changed:
            self.annotations = changed.annotations

    # ---- episodes

    def episode_metadata(self, i: int) -> dict[str, Any]:
        """The metadata of episode `i`, with what was said about it later."""
        number = int(self.index["episode"][i])
        return self.annotations.applied(number, self.recorded_metadata(i))

    def recorded_metadata(self, i: int) -> dict[str, Any]:
        """The metadata of episode `i` as they were recorded."""
        value = jsonvalue.loads(self._contents.index.metadata_text(i))
        if not isinstance(value, dict):
            raise FormatError(
                f"{self.name}: episode {i} expected metadata as a JSON object, found {value!r:.80}"
            )
        return value

    def all_metadata(self) -> list[str]:
        """The metadata of all episodes as JSON texts; "{}" where there is none."""
        index = self._contents.index
        texts = ["{}"] * len(index.episodes)
        for i in np.flatnonzero(index.episodes["metadata_length"]).tolist():
            texts[i] = index.metadata_text(i)
        if self.annotations.said:
            for i, number in enumerate(self.index["episode"].tolist()):
                if self.annotations.of(number):
                    texts[i] = jsonvalue.dumps(self.episode_metadata(i))
        return texts

    def episode_start(self, i: int) -> EpisodeStart:
        """The `/episode_start` message of episode `i`."""
        row = self.index[i]
        (body,) = self._store.bodies(self._channel(EPISODE_START), int(row["start_row"]), 1)
        start = EpisodeStart.decode(body)
        if start.episode != row["episode"]:
            raise FormatError(
                f"{self.name}: expected the start of episode {row['episode']}, found {start.episode}"
            )
        return start

    def episode_starts(self, episodes: Sequence[int] | np.ndarray[Any, Any]) -> list[EpisodeStart]:
        """The `/episode_start` messages of some episodes (positions or a mask), read together."""
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
        """The resets just before that of episode `i` that no step followed, the earliest first.

        They are known where the random stream goes on from them: the later resets had no seed. One that is `continued`
        was none: from there on, the stream is not the one of the episode before.
        """
        row = self.index[i]
        found: list[EpisodeStart] = []
        for at in range(int(row["start_row"]) - 1, -1, -1):
            (body,) = self._store.bodies(self._channel(EPISODE_START), at, 1)
            start = EpisodeStart.decode(body)
            if start.episode != row["episode"] or start.env != row["env"]:
                break
            found.append(start)
        return found[::-1]

    def final_state(self, i: int) -> Any:
        """The final state of episode `i`, nested as the observation space; None if it is not known."""
        rows = self.index[i : i + 1]
        if rows["final_row"][0] < 0:
            return None
        columns = self._reader.final_columns(self._channel(FINAL_STATE), rows)
        values = [
            column[0] if isinstance(column, list) or leaf.is_scalar else column[0, ...]
            for leaf, column in zip(self.layout.state, columns, strict=True)
        ]
        return self.layout.nest_state(values)

    def final_states(self, episodes: Sequence[int] | np.ndarray[Any, Any]) -> Any:
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
            return self.read([], fields=["states"]).states
        columns = self._reader.final_columns(self._channel(FINAL_STATE), rows)
        return self.layout.nest_state(columns)

    def _channel(self, topic: str) -> int:
        if topic not in self._topics:
            raise FormatError(
                f"{self.name}: expected a channel {topic}, found {', '.join(self._topics) or 'none'}"
            )
        return self._topics[topic]

    @property
    def _reader(self) -> ColumnReader:
        if self._columns is None:
            raise RecordingError(f"{self.name} has no step yet; record a step first")
        return self._columns

    def infos(self, i: int) -> list[dict[str, Any] | None] | None:
        """The recorded infos of episode `i`, one a step; None if the recording has none."""
        channel = self._topics.get(INFO)
        if channel is None:
            return None
        if self._infos is None:
            decoder = InfoCodec.from_metadata(self._contents.channels[channel].metadata)
            found: dict[int, dict[int, dict[str, Any]]] = {}
            for body in self._store.bodies(channel, 0, self._store.count(channel)):
                episode, step, info = decoder.decode(body)
                found.setdefault(episode, {})[step] = info
            self._infos = found
        row = self.index[i]
        steps = self._infos.get(int(row["episode"]), {})
        return [steps.get(step) for step in range(int(row["length"]))]

    # ---- frames

    @property
    def cameras(self) -> tuple[str, ...]:
        """The cameras that there are frames of; empty if there are none."""
        return self._cameras.names

    def frames(self, i: int, camera: str | None = None) -> Frames:
        """The frames of episode `i`; none if the recording has no camera, or the episode no frames.

        Args:
            camera: one of `cameras`; by default "render", or else the first one.

        Raises:
            RecordingError: there is no such camera.
        """
        row = self.index[i]
        env = int(row["env"])
        if camera is None:
            camera = "render" if "render" in self.cameras or not self.cameras else self.cameras[0]
            if not self.cameras:
                none = np.empty(0, np.int64)
                return Frames(self, camera, env, none, none, none)
        rows = self._cameras.rows(camera, env, int(row["episode"]), int(row["length"]))
        return Frames(self, camera, env, *rows)

    # ---- columns

    def read(
        self,
        episodes: Sequence[int] | np.ndarray[Any, Any] | None = None,
        fields: Sequence[str] | None = None,
        threads: int | None = None,
        *,
        images: bool = True,
    ) -> Columns:
        """Columns of the given episodes (all by default), one after another in the order given.

        Args:
            episodes: positions in `self.episodes`, or a bool for each of them.
            fields: some of "states", "actions", "rewards", "terminals", "timeouts", "next_states", "times" and "infos";
                the first five by default. Gymnasium's names (observations, terminations, …) mean the same.
            threads: how many threads decompress; by default as many as there are cores, at most 4.
            images: False reads no image of a state: the columns of image leaves are empty. Not for `next_states`.

        Where an episode's final state is not known, `next_states` repeats its last state.
        """
        fields = FIVE if fields is None else field_names(fields)
        if not images and "next_states" in fields:
            raise RecordingError("expected images=True for next_states, found False; read states instead")
        rows = self.index
        if episodes is not None:
            rows = rows[self._positions(episodes)]
        lengths = rows["length"].astype(np.int64)
        total = int(lengths.sum())
        columns = Columns(lengths)
        if self._layout is None:
            return columns
        threads = threads or _THREADS
        keep = episodes is not None
        needed = [field for field in fields if field not in ("next_states", "infos")]
        if "next_states" in fields and "states" not in needed:
            needed.append("states")
        with memory_for(lambda: f"{self.name}: reading {', '.join(fields)} of {total} steps"):
            runs = runs_of(rows, self._step_channels)
            found = self._reader.read(runs, total, needed, threads, keep, images)
            if "next_states" in fields:
                columns.next_states = self._next_states(found["states"], rows, lengths)
        for field in fields:
            if field in found:
                setattr(columns, field, found[field])
        if "infos" in fields:
            positions = np.arange(len(self.index)) if episodes is None else self._positions(episodes)
            columns.infos = [info for i in positions.tolist() for info in self._infos_of(i)]
        return columns

    def _infos_of(self, i: int) -> list[dict[str, Any]]:
        """A dict a step of episode `i`; empty where no info was recorded."""
        infos = self.infos(i)
        return (
            [{} for _ in range(int(self.index["length"][i]))]
            if infos is None
            else [info or {} for info in infos]
        )

    def _positions(self, episodes: Any) -> Any:
        """Positions in the index, from positions or a mask; RecordingError if they are something else."""
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
        """Columns of the steps `start:stop` of episode `i`; the chunks they lie in stay in the cache."""
        row = self.index[i]
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

    def _next_states(self, states: Any, rows: Any, lengths: Any) -> Any:
        layout = self.layout
        known = rows["final_row"] >= 0
        ends = np.cumsum(lengths) - 1
        finals: list[Any] = []
        if known.any():
            finals = self._reader.final_columns(self._channel(FINAL_STATE), rows[known])
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
    def file(self) -> OpenFile:
        """Its channels, chunks and messages. It is closed with the recording."""
        return OpenFile(
            self._source, self._contents, self._store, self._topics, self._step_channels, self._cameras
        )

    @property
    def stored(self) -> StoredSteps:
        """Where the steps lie; RecordingError if there is none yet."""
        finals = self._topics.get(FINAL_STATE)
        where, source = self._reopen, self._source
        return StoredSteps(self.layout, self._store, self._step_channels, self._images, finals, where, source)

    def replay(
        self,
        episodes: str | Sequence[int] | None = None,
        *,
        save: str | os.PathLike[str] | None = None,
        **options: Any,
    ) -> Any:
        """Shows episodes in the Rerun viewer (in a notebook: below the cell), or writes them into a `.rrd` file.

        `options` are those of `tupli_mcap.viewer.show`, `display` and `save`.

        Raises:
            MissingExtraError: rerun-sdk is not installed.
        """
        from tupli_mcap import viewer

        if save is not None:
            return viewer.save(self, save, episodes, **options)
        if viewer.in_notebook():
            return viewer.display(self, episodes, **options)
        return viewer.show(self, episodes, **options)

    def plot(self, **options: Any) -> Any:
        """A `tupli_mcap.plots.Report`: returns, lengths, states, actions and one episode, as one picture.

        `options` are those of `tupli_mcap.plots.report`. A notebook shows it; `.save(path)` writes it.

        Raises:
            MissingExtraError: matplotlib (the extra `plot`) is not installed.
        """
        from tupli_mcap import plots

        return plots.report(self, **options)

    def close(self) -> None:
        """Closes the file; what was read stays valid."""
        self._source.close()

    def __reduce__(self) -> tuple[Callable[..., Recording], tuple[str, str, int]]:
        """A copy in another process opens the file itself."""
        if self._reopen is None:
            raise RecordingError(
                f"{self.name} was opened as a file object, which cannot be copied; give its path"
            )
        return _opened_again, (self._reopen, self.uuid, self._cache_bytes)

    def __enter__(self) -> Recording:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def __len__(self) -> int:
        return len(self.index)

    def __repr__(self) -> str:
        state = "" if self.complete else ", recovered"
        return f"<Recording {self.name}: {len(self.index)} episodes, {self.num_steps} steps{state}>"


def _stored_bytes(layout: StepLayout, leaf: Leaf) -> int:
    """What a leaf takes in a message, at least."""
    return 1 if leaf.kind == "variable" else leaf.size * layout.dtypes[leaf.name].itemsize


def _spaces_of(channel: Channel) -> dict[str, str]:
    return {key: value for key, value in channel.metadata.items() if key not in ("env", "crc")}


def _absolute(source: str | os.PathLike[str]) -> str:
    name = os.fspath(source)
    return name if "://" in name else os.path.abspath(name)  # noqa: PTH100 - links stay


def _opened_again(source: str, uuid: str, cache_bytes: int) -> Recording:
    recording = Recording(source, cache_bytes=cache_bytes)
    if recording.uuid != uuid:
        recording.close()
        raise RecordingError(
            f"{source} is another recording by now (expected {uuid}, found {recording.uuid})"
        )
    return recording
