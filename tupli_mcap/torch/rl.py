"""Transitions for TorchRL: TensorDicts with the keys it expects, in a storage that reads them when they are sampled."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch

from tupli_mcap.arrays import Array
from tupli_mcap.dataset.items import SamplingError, Transitions
from tupli_mcap.dataset.items.transitions import TRANSITION_FIELDS
from tupli_mcap.errors import missing_extra
from tupli_mcap.torch.items import check_state, tensors

try:
    from tensordict import NonTensorStack, TensorDict
    from torchrl.data import ImmutableDatasetWriter, TensorDictReplayBuffer
    from torchrl.data.replay_buffers.storages import Storage
except ImportError as err:
    raise missing_extra("tupli_mcap.torch.rl needs TorchRL", "torchrl") from err


class RecordedStorage(Storage):  # type: ignore[misc]  # untyped
    """The transitions of a dataset by number, read when they are sampled; read-only.

        RecordedStorage(dataset.transitions())

    A TensorDict of B transitions has the keys "observation", "action", "episode" (its place in the query), "mask"
    (False if the next observation was not recorded and repeats the current one: leave such transitions out), and
    under "next": "observation", "reward", "done", "terminated", "truncated", the last four of shape (B, 1).
    "truncated" (and "done") is also True if an episode was interrupted, or goes on with a step that a tuple filter
    left out, so that the following row is not its next step. A Dict space gives a nested TensorDict, a Tuple space
    one with the keys "0", "1", ..., and values that differ in size are non-tensor data. A pickled copy opens the
    files itself.

    Raises:
        SamplingError: the items are no transitions over one step, or lack fields. (For several steps, use TorchRL's
            `MultiStepTransform`.)
    """

    def __init__(self, transitions: Transitions) -> None:
        if not isinstance(transitions, Transitions) or transitions.n_step != 1:
            raise SamplingError(f"expected dataset.transitions() over one step, found {transitions!r:.80}")
        missing = [field for field in TRANSITION_FIELDS if field not in transitions.fields]
        if missing:
            raise SamplingError(f"expected transitions with all fields, found none of {', '.join(missing)}")
        super().__init__(max_size=len(transitions))
        self._transitions = transitions

    def __len__(self) -> int:
        return len(self._transitions)

    def get(self, index: Any) -> TensorDict:
        """The transitions of an integer, a slice, or a tensor, an array or a list of integers, read together; or those
        of a mask.

        Raises:
            IndexError: there is no transition of that number.
            SamplingError: it is something else, or a mask of another length.
        """
        if isinstance(index, tuple) and len(index) == 1:
            (index,) = index
        if isinstance(index, torch.Tensor):
            index = index.numpy()
        if isinstance(index, slice):
            index = np.arange(*index.indices(len(self)))
        numbers = np.asarray(index)
        if numbers.dtype == np.bool_:
            if numbers.shape != (len(self),):
                raise SamplingError(
                    f"expected a mask of {len(self)} transitions, found one of shape {numbers.shape}"
                )
            numbers = np.flatnonzero(numbers)
        batch = self._read(numbers.reshape(-1))
        return batch.reshape(numbers.shape)

    def _read(self, numbers: Array) -> TensorDict:
        transitions = self._transitions[numbers]
        columns = tensors(transitions.asdict())
        breaks = torch.from_numpy(np.isin(transitions.steps, self._transitions.source.breaks))
        terminated = columns["terminals"]
        truncated = columns["timeouts"] | (breaks & ~terminated)
        following = {
            "observation": _nested(columns["next_states"], len(numbers)),
            "reward": _nested(columns["rewards"], len(numbers), flags=True),
            "done": (terminated | truncated)[:, None],
            "terminated": terminated[:, None],
            "truncated": truncated[:, None],
        }
        given = {
            "observation": _nested(columns["states"], len(numbers)),
            "action": _nested(columns["actions"], len(numbers)),
            "episode": columns["episodes"],
            "mask": columns["mask"],
            "next": TensorDict(following, [len(numbers)]),
        }
        return TensorDict(given, [len(numbers)])

    def contains(self, item: Any) -> bool:
        """Whether there is a transition of that number."""
        return 0 <= int(item) < len(self)

    def set(self, cursor: Any, data: Any, *, set_cursor: bool = True) -> None:
        """Refused: always raises SamplingError."""
        raise SamplingError("a RecordedStorage is read-only; add steps to another storage")

    def _empty(self) -> None:
        self.set(None, None)

    def state_dict(self) -> dict[str, Any]:
        """A state that identifies these transitions."""
        return {"items": self._transitions.identity}

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Checks that a state is of the same transitions; SamplingError if not."""
        check_state(state_dict, self._transitions.identity, {})


def replay_buffer(transitions: Transitions, batch_size: int, **options: Any) -> TensorDictReplayBuffer:
    """A replay buffer that samples recorded transitions; nothing can be added to it.

    Args:
        transitions: `dataset.transitions()`.
        options: of `TensorDictReplayBuffer`, such as a sampler, `prefetch` or a transform.
    """
    given = {"writer": ImmutableDatasetWriter(), "collate_fn": _as_it_is, **options}
    return TensorDictReplayBuffer(storage=RecordedStorage(transitions), batch_size=batch_size, **given)


def _as_it_is(batch: TensorDict) -> TensorDict:
    return batch


def _nested(column: Any, rows: int, *, flags: bool = False) -> Any:
    """A column as values of a TensorDict; with `flags`, numbers get a last dimension of length 1."""
    if isinstance(column, tuple):
        column = {str(i): part for i, part in enumerate(column)}
    if isinstance(column, dict):
        return TensorDict({key: _nested(part, rows, flags=flags) for key, part in column.items()}, [rows])
    if isinstance(column, list):
        return NonTensorStack(*column)
    return column[:, None] if flags and column.ndim == 1 else column
