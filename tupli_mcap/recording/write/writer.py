"""One recording being written: the file, its journal, its channels and its episodes.

The recorders (`recorders`) put steps into the row stores made here (`rows`), which come into the file through `chunks`;
what happens once an episode is in this module. Not thread-safe.
"""

from __future__ import annotations

import contextlib
import os
import time
import warnings
import weakref
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from tupli_mcap.errors import RecordingError, SpaceError, StepError, TupliError, os_reason
from tupli_mcap.journal.derive import EpisodeBatch, StartedEpisode
from tupli_mcap.journal.file import Journal, boot_id, sync_directory, sync_file
from tupli_mcap.journal.logs import EventLog, ToFile
from tupli_mcap.mcap.container import Container
from tupli_mcap.mcap.lock import FileLock
from tupli_mcap.messages.images.codecs import png_leaves
from tupli_mcap.messages.layout import NUMBERS
from tupli_mcap.messages.step import StepLayout
from tupli_mcap.messages.topics import Topics
from tupli_mcap.recording.channels import register_channels
from tupli_mcap.recording.contents import RECORDING_METADATA, first_metadata, step_channels
from tupli_mcap.recording.index import INDEX_MEDIA_TYPE, INDEX_NAME, IndexBuilder
from tupli_mcap.recording.write.chunks import ChunkWriter
from tupli_mcap.recording.write.episodes import EpisodeLog, ResetFacts, plain_reset
from tupli_mcap.recording.write.options import RecordOptions, check_place
from tupli_mcap.recording.write.place import RecordingPlace
from tupli_mcap.recording.write.rows.contract import BatchStore, StepStore
from tupli_mcap.recording.write.rows.stores import Stores, plan_areas

_live: weakref.WeakSet[RecordingWriter] = weakref.WeakSet()


class RecordingWriter:
    """Writes one recording; `begin` is called at the first step, when the layout is known.

    A new recording without steps is removed when it is closed, unless `keep_empty`.
    """

    def __init__(
        self,
        path: str | os.PathLike[str],
        options: RecordOptions,
        *,
        format_version: str = "1",
        keep_empty: bool = False,
    ) -> None:
        check_place(path)
        self.path = Path(path)
        self.place = RecordingPlace(path, options.journal_dir)
        self.options, self.format_version, self._keep_empty = options, format_version, keep_empty
        self.closed = False
        self.failed = ""  # why nothing more can be recorded, where that is known
        self.layout: StepLayout | None = None
        self.index = IndexBuilder()
        self.next_episode = 0
        self.journal: Journal | None = None
        self._stores: Stores | None = None
        self.rows: StepStore | None = None
        self.vector: BatchStore | None = None
        self.streams: Sequence[StepStore] = ()
        self._durable = options.durability != "os"
        self._sealed = options.durability == "step"
        self.events: EpisodeLog | None = None
        self.infos: EventLog | None = None
        self.frames: list[EventLog] = []
        # set by the recorder: called when nothing may be recorded any more (its encoder knows only its buffer), and
        # asked whether the last event is the start of an episode without a step
        self.on_close: Callable[[], None] = lambda: None
        self.start_is_droppable: Callable[[], bool] = lambda: False
        # sub-environments whose random stream does not come from their last recorded episode
        self.lost_streams: set[int] = set()
        self.num_envs = 1
        self.is_vector = False
        self._is_cut = True  # False on append, while the file still is as it was found
        # on append: attachments that are added, or replaced, with the first step
        self.arriving: dict[str, tuple[str, bytes]] = {}
        self._flush_seconds = options.flush_seconds
        self._flushed_at = time.monotonic()
        self._take_file()
        _live.add(self)

    def _take_file(self) -> None:
        lock: FileLock | None = None
        try:
            self.lock = lock = FileLock(self.path, self.options.mode)
            self._open()
        except BaseException as err:
            if lock is not None:
                with contextlib.suppress(RecordingError):
                    lock.release()
            if isinstance(err, OSError):
                raise RecordingError(f"{self.path} cannot be recorded to: {os_reason(err)}") from err
            raise

    def _open(self) -> None:
        self.container = Container(self.lock.fd, str(self.path), self.options.compression)
        self._chunks = ChunkWriter(self.path, self.container, self.lock, self._settle)
        if self.options.mode == "a" and self.path.stat().st_size:
            self._resume()
            return
        self.place.begin(replaces=self.options.mode == "w")
        try:
            os.ftruncate(self.lock.fd, 0)
        except OSError as err:
            raise RecordingError(
                f"{self.path} cannot be emptied ({os_reason(err)}); choose a regular file"
            ) from err
        now = time.time_ns()
        values = first_metadata(self.place.uuid, self.format_version, self.options.benchmark_id, now)
        if self.options.journal_dir is not None:
            values["journal"] = str(self.place.journal)
        if self.place.replaced:
            # whoever comes next shall know, if this process dies before it removes that journal
            values["replaced"] = self.place.replaced
        self.container.start()
        self.container.add_metadata(RECORDING_METADATA, values)
        for name, (media_type, data) in (self.options.attachments or {}).items():
            self.container.add_attachment(name, media_type, data, now)
        if not self.lock.replaces:
            self.lock.publish()

    def _resume(self) -> None:
        from tupli_mcap.recording.write.resume import resume

        self._is_cut = False
        contents, self.index, self.layout, self.arriving = resume(
            self.path, self.options, self.format_version, self.place, self.container
        )
        self.next_episode = contents.next_episode
        if not contents.complete:
            self.cut()  # what is cut follows from the chunks: a crash in between loses nothing
            for channel in contents.undefined:  # the file was shorter after a power loss
                self.container.write(self.container.definitions(channel))
            for rows in contents.tail:
                self.container.add_chunk(rows)
            if contents.tail:  # the journal they come from may have been on the disk, and will be replaced
                sync_file(self.lock.fd, str(self.path))
        self.place.go_on()

    # ---- the first step

    def begin(
        self,
        layout: StepLayout,
        num_envs: int,
        *,
        vector: bool,
        apart: bool = False,
        info_schema: tuple[str, Mapping[str, str]] | None = None,
    ) -> None:
        """Fixes the layout: registers the channels, makes the journal and the row stores.

        `apart`: sub-environments of a `vector` recording do not step together.
        """
        self.layout, self.num_envs, self.is_vector, self._apart = layout, num_envs, vector, apart
        if self.index.count:  # of an earlier session
            self.lost_streams = set(range(num_envs))
        png = frozenset(leaf.name for leaf in layout.images if self.options.image_format == "png")
        if self.container.channels:  # on append
            png = png_leaves(self.container.channels)
        self.channels = register_channels(
            self.container, str(self.path), layout, num_envs if vector else None, info_schema,
            self.options.cameras, png,
        )  # fmt: skip
        self._make_stores(layout)
        # after the journal: a file that has channels and no end has one
        self.cut()
        self._attach()
        self.container.define_channels()
        self._settle()
        if self._durable:
            sync_directory(self.place.file.parent)

    def take_place(self) -> None:
        """The file that this one replaces goes when this one has a step."""
        if self.lock.replaces:
            self.lock.publish()
            self.place.remove_replaced()
            if self._durable:
                sync_directory(self.place.file.parent)

    def cut(self) -> None:
        """On append: takes index and summary off the file. Before, nothing in it has changed."""
        if self._is_cut:
            return
        at = self.container.position
        try:
            os.ftruncate(self.lock.fd, at)
        except OSError as err:
            raise RecordingError(
                f"{self.path} could not be cut off at offset {at}: {os_reason(err)}"
            ) from err
        self._is_cut = True

    def _attach(self) -> None:
        container, arriving = self.container, self.arriving
        self.arriving = {}
        container.attachment_indexes = [
            each for each in container.attachment_indexes if each.name not in arriving
        ]
        for name, (media_type, data) in arriving.items():
            container.add_attachment(name, media_type, data, time.time_ns())

    def fixed_layout(self) -> StepLayout:
        """The layout; RecordingError before the first step."""
        if self.layout is None:
            raise RecordingError(f"{self.path} has no step yet, so its layout is not known")
        return self.layout

    def _events(self) -> EpisodeLog:
        if self.events is None:
            raise RecordingError(f"{self.path} has no step yet, so it has no episodes")
        return self.events

    def _make_stores(self, layout: StepLayout) -> None:
        self.journal = self._new_journal()
        self.journal.publish(durable=self._durable, replaced=self.place.replaced)
        container, chunks = self.container, self._chunks
        file = ToFile(
            container.counts, container.end_time, lambda: container.position, chunks.add, chunks.start,
            self._grow, self._durable, self._sealed,
        )  # fmt: skip
        self._stores = stores = Stores(
            layout, self.channels, self.journal, self.index, file, vector=self.is_vector, apart=self._apart
        )
        self.rows, self.vector, self.streams = stores.rows, stores.vector, stores.streams
        self.events, self.infos, self.frames = stores.events, stores.infos, stores.frames

    # ---- episodes

    def start_episode(self, env: int, first_row: int, reset: ResetFacts) -> StartedEpisode:
        """Writes `/episode_start`; it is taken back by `drop_start` if no step follows."""
        if env in self.lost_streams:
            self._mark_lost_stream(env, first_row, reset)
        started = (self.events or self._events()).start(self.next_episode, env, first_row, reset)
        self.next_episode += 1
        return started

    def _mark_lost_stream(self, env: int, first_row: int, reset: ResetFacts) -> None:
        """A start without a step says that the random stream of this episode is not that of the one before."""
        self.lost_streams.discard(env)
        if reset.goes_on:
            self.add_reset(env, first_row, plain_reset(reset.time_ns, continued=True))

    def add_reset(self, env: int, first_row: int, reset: ResetFacts) -> None:
        """Writes the start of a reset that no step follows."""
        self.start_episode(env, first_row, reset)
        self.keep_start()

    def drop_start(self) -> None:
        """Takes back the last `/episode_start`, the last event: a reset without a step is no episode."""
        self._events().drop_last(self.channels.start)
        self.next_episode -= 1

    def keep_start(self) -> None:
        """Leaves the last `/episode_start` where it is, though no step follows: the random stream of the next episode,
        which takes its number, went through that reset."""
        self.next_episode -= 1

    def end_episode(
        self,
        episode: StartedEpisode,
        end: int,
        length: int,
        total: Any,
        final_state: bytes | None,
        metadata: str,
        final_row: int = -1,
        time_ns: int | None = None,
    ) -> None:
        """Writes `/final_state` (unless it is there already, as `final_row`) and `/episode_end`, and the episode's row
        of the index. `time_ns` is the same for episodes that end in one batch; now, by default."""
        events = self.events or self._events()
        total = total if type(total) is float else float(np.sum(total))
        now = time.time_ns() if time_ns is None else time_ns
        events.end(now, episode, end, length, total, final_state, final_row, metadata)
        self._flush_if_due()

    def put_final_states(self, finals: Sequence[tuple[StartedEpisode, bytes]]) -> int:
        """Writes `/final_state` ahead of the step that ends the episodes; returns the first one's row."""
        channel, events = self.channels.final_state, self._events()
        row = events.sequences[channel]
        pack = NUMBERS.pack
        events.append(time.time_ns(), *[(channel, pack(e.number, e.env) + final) for e, final in finals])
        return row

    def add_episodes(self, batch: EpisodeBatch) -> None:
        """Writes starts, final states and ends of whole episodes, whose numbers follow the last one's."""
        self._events().extend(batch)
        self.next_episode += len(batch.starts)

    def after_steps(self) -> None:
        """Flushes if that is due, and waits for the disk where durability of steps is asked for."""
        self._flush_if_due()
        self.sync_step()

    def _flush_if_due(self) -> None:
        """Flushes if `flush_seconds` were asked for and have passed since the last flush."""
        seconds = self._flush_seconds
        if seconds is not None and time.monotonic() - self._flushed_at > seconds:
            self.flush()

    # ---- chunks

    def _settle(self) -> None:
        """Waits until what was written is on the disk, where durability of chunks is asked for: the journal first, for
        it holds the ends of the episodes."""
        if self._durable:
            if self.journal is not None:
                self.journal.sync()
            sync_file(self.lock.fd, str(self.path))

    def sync_step(self) -> None:
        """Waits until everything put so far is on the disk, where durability of steps is asked for."""
        if self._sealed and self.journal is not None:
            self.journal.sync()

    def stop(self, err: BaseException) -> None:
        """Notes for `why_stopped` what has broken off the recorder's work; a refused step does not."""
        if not self.failed and not isinstance(err, StepError):
            # only what it says: its traceback has frames that hold the recorder, and views of the journal
            self.failed = (
                str(err) if isinstance(err, RecordingError) else self._broken_off(type(err).__name__)
            )

    def why_stopped(self) -> RecordingError:
        """Why nothing more can be recorded: it is closed, or has been broken off."""
        if self.closed and not self.failed:
            return RecordingError(
                f'{self.path} is closed; make another recorder (mode="a" goes on in this file)'
            )
        interrupted = self._broken_off(
            "an interruption (or this call, from a signal handler or another thread, say)"
        )
        return RecordingError(self.failed or interrupted)

    def _broken_off(self, what: str) -> str:
        return (
            f"{self.path}: {what} broke off the recorder's work; every finished step is safe: "
            'close the recording, and go on with mode="a"'
        )

    def check_spaces(self, spaces: StepLayout, num_envs: int, *, vector: bool) -> None:
        """On append: raises SpaceError unless the environment is one the file can go on with."""
        if self.layout is None:
            return
        steps = step_channels(self.container.channels, str(self.path))
        recorded = len(steps), Topics.of_step(steps[0].topic).is_vector
        if recorded != (num_envs, vector):
            raise SpaceError(
                f"{self.path} records {_kind(*recorded)}, found {_kind(num_envs, vector)}; record to another file"
            )
        old, new = self.layout.to_metadata(), spaces.to_metadata()
        for key in ("observation_space", "action_space", "reward_space"):
            if old[key] != new[key]:
                raise SpaceError(
                    f"{self.path}: expected the recorded {key} {getattr(self.layout, key)}, found "
                    f"{getattr(spaces, key)}; record to another file"
                )

    def flush(self) -> None:
        """Writes everything recorded so far into chunks (the file still has no summary)."""
        self._flush(keep_last=self.start_is_droppable())

    def _flush(self, *, keep_last: bool) -> None:
        self._flushed_at = time.monotonic()
        if self._stores is not None:
            self._stores.flush(keep_last=keep_last)

    def _grow(self, size: int) -> None:
        """Makes a larger journal for steps of `size` bytes; the running states move into it."""
        self._flush(keep_last=False)
        journal = self._new_journal(2 * size)
        if self._stores is not None:
            self._stores.move(journal)
        journal.publish(durable=self._durable)
        self.journal = journal

    def _new_journal(self, step_capacity: int = 0) -> Journal:
        """A journal with room for steps of variable size of at least `step_capacity` bytes."""
        channels = self.channels
        areas = plan_areas(
            self.fixed_layout(), self.num_envs, self.options.chunk_size, step_capacity,
            vector=self.is_vector and not self._apart, infos=channels.info is not None,
            frames=bool(channels.cameras),
        )  # fmt: skip
        description = {
            **self.place.identity(),
            "boot": boot_id(),
            "seals": "rows" if self._sealed else "records",
            "vector": self.is_vector,
            "channels": [channels.steps, channels.images, *channels[2:6]],
            "definitions": {str(c): self.container.definitions(c).hex() for c in self.container.channels},
        }
        return Journal(self.place.journal, areas, description)

    def close(self) -> None:
        """Writes the rest, the episode index and the summary, and removes the journal.

        Where it raises, `leave_unfinished` or `break_off` must follow.
        """
        if self.closed:
            return
        if self.journal is None and (not self._is_cut or self._may_be_removed()):
            self._leave()
            return
        self.flush()
        data = self.index.encode(self.container.chunk_rows)
        self.container.add_attachment(INDEX_NAME, INDEX_MEDIA_TYPE, data, time.time_ns())
        self.container.finish()
        self.take_place()
        self._chunks.warn_if_deleted()
        if self._durable:  # before the journal goes
            sync_file(self.lock.fd, str(self.path))
            sync_directory(self.place.file.parent)
        if self.journal is not None:
            self.journal.remove()
        else:
            self.place.remove_of_killed()
        self.closed = True
        self.let_go()

    def let_go(self) -> None:
        """Lets go of the file, its lock and the journal, as they are. Calling it again goes on with what is left.
        RecordingError as `FileLock.release`."""
        _live.discard(self)
        self.on_close()
        self.container.close()
        try:
            self._chunks.close()
            if self._stores is not None:
                self._stores.let_go()
                self._stores = self.rows = self.vector = self.events = self.infos = None
                self.frames, self.streams = [], ()
            if self.journal is not None:
                self.journal.close()
        finally:
            self.lock.release()

    def break_off(self) -> None:
        """Finishes the recording from its file and its journal, as after a killed process.

        What is in memory is not used. Calling it again goes on with what is left.

        RecordingError if the disk refuses. The file and the journal hold everything that was recorded.
        """
        if self.closed:
            return
        if self.lock.replaces or (self.journal is None and self._may_be_removed()):
            self._leave()
            return
        options = RecordOptions(
            compression=self.options.compression, mode="a", durability=self.options.durability
        )
        # errors name the file as its user does, unless the process has changed its directory since
        is_there = os.path.realpath(self.path) == str(self.place.file)
        try:
            self.let_go()
            self.place.remove_unnamed()
            with warnings.catch_warnings():
                warnings.simplefilter("ignore", UserWarning)  # no journal: it was not needed yet
                finish_in_place(self.path if is_there else self.place.file, options)
        except TupliError:
            self.leave_unfinished()
            raise
        self.closed = True

    def leave_unfinished(self) -> None:
        """Releases the file, its lock and the journal; the next writer that appends continues from here."""
        self.closed = True
        self.let_go()

    def _may_be_removed(self) -> bool:
        """Whether a file without a step goes when it is closed."""
        return self.options.mode != "a" and not self._keep_empty

    def _leave(self) -> None:
        """No step was recorded: what is appended to or replaced stays as it was, and a new file would only be in the
        way."""
        if self.journal is not None:
            self.journal.remove()
        with contextlib.suppress(OSError):
            self.place.remove_unnamed()
            if self._is_cut:
                self.lock.unlink()
            self.place.remove_of_killed()
        self.closed = True
        self.let_go()

    def abandon(self) -> None:
        """In a forked child: lets go of the file and its lock without writing; the parent goes on."""
        self.closed = True
        self.failed = (
            f"{self.path} is recorded by the process that opened it, not by a forked child; "
            "wrap the environment here"
        )
        self.lock.release()
        self.on_close()


def finish_in_place(path: Path, options: RecordOptions) -> None:
    """Finishes a recording that its writer has left unfinished; a finished one stays as it is.

    Raises:
        RecordingError: somebody records to it, or the disk refuses.
        FormatError: it is damaged.
    """
    writer = RecordingWriter(path, options)
    try:
        writer.close()
    except BaseException:
        writer.leave_unfinished()
        raise


def _kind(envs: int, vector: bool) -> str:
    return f"a vector environment of {envs}" if vector else "a single environment"


def _abandon_all() -> None:
    for writer in list(_live):
        writer.abandon()
    _live.clear()


os.register_at_fork(after_in_child=_abandon_all)
