"""The interface of all stores of rows.

1. A row is committed by its last store, once all of it is in the journal: of `sequence` and `log_time` in a row of
   constant size, of the end of a log. Whoever reads the journal finds the whole row, or nothing of it.
2. Committed rows stay in the journal until they are in the file: at every moment the two together hold each of them. A
   half is written over only when its chunks are in the file.
3. The running row, of which a state is known and the step is not, is in the journal too; it moves with its store.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Protocol

from tupli_mcap.arrays import Array
from tupli_mcap.journal.file import Journal

Put = Callable[[Any, Any, Any, Any, Any], None]


class RowStore(Protocol):
    """Keeps rows in an area of the journal until they are in the file."""

    def flush(self) -> None:
        """Writes the committed rows that are not in the file yet."""
        ...


class MovingStore(RowStore, Protocol):
    """One that may have a journal together with steps of variable size, for which the journal grows."""

    def move(self, journal: Journal) -> None:
        """Goes on in another journal. Everything committed must be in the file: only the running row moves."""
        ...


class StepStore(Protocol):
    """The steps of one environment.

    Attributes:
        count: rows of the channel so far, those of earlier sessions included.
        total: the running episode's return so far.
        holds_episodes: rows hold all that an episode is.
    """

    @property
    def count(self) -> int: ...

    @property
    def total(self) -> Any: ...

    @property
    def holds_episodes(self) -> bool: ...

    @property
    def put(self) -> Put:
        """Completes and commits the running row (action, state, reward, terminal, timeout); the state starts the next
        one. StepError if something cannot be stored exactly, and then nothing has changed."""
        ...

    @property
    def put_state(self) -> Callable[[Any], None]:
        """Starts the running row over: the state of a reset."""
        ...

    @property
    def put_whole(self) -> Put:
        """Writes and commits the running row (state, action, reward, terminal, timeout); the state after it is not
        known. StepError as `put`."""
        ...

    def put_many(
        self, states: Any, actions: Any, rewards: Any, terminals: Array, timeouts: Array, episodes: Any
    ) -> None:
        """As `put_whole` of several steps, which lie along the first axis of all arrays.

        Args:
            episodes: the number of the running episode, of which all steps are; with `holds_episodes`, it may be an
                array with the number of each step's episode.

        Raises:
            StepError: something cannot be stored exactly; nothing is recorded.
        """
        ...

    def begin_episode(self, episode: int) -> None:
        """The rows from the running one on belong to `episode`."""
        ...

    def pending_state(self) -> bytes:
        """The CDR bytes of the running row's state, as they follow `episode` and `env` in `/final_state`."""
        ...


class BatchStore(Protocol):
    """The steps of the sub-environments of a vector environment. Batches have the sub-environments first."""

    def row_counts(self) -> list[int]:
        """The rows of each channel so far, those of earlier sessions included."""
        ...

    def put_state(self, states: Any, mask: Array | None = None) -> None:
        """The states of a reset: of all sub-environments, or of those in `mask`."""
        ...

    def check(
        self,
        actions: Any,
        states: Any,
        rewards: Array,
        terminals: Array,
        timeouts: Array,
        active: Array | None,
    ) -> Any:
        """A batch as `put` takes it; StepError if it cannot be stored.

        `active`: which sub-environments took a step; None: all of them. The others were reset.
        """
        ...

    def put(self, batch: Any, numbers: Array, *, ends: bool) -> None:
        """Writes a checked batch.

        Args:
            numbers: of each sub-environment's episode, plus 2**32 times the step (uint64).
            ends: a flag is set.
        """
        ...

    def pending_state(self, i: int) -> bytes:
        """As `StepStore.pending_state`, of one sub-environment."""
        ...
