"""Episodes made from values: infers spaces from the values, and fits the values to them."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium import spaces

from tupli_mcap.arrays import Array
from tupli_mcap.errors import SpaceError, StorageError
from tupli_mcap.jsonvalue import dumps_plain
from tupli_mcap.recording import EpisodeData, write_recording
from tupli_mcap.schema import Benchmark, Episode, EpisodeHeader
from tupli_mcap.schema.keys import name_within
from tupli_mcap.storage.benchmark_json import declared_spaces, recording_attachments

_NUMBERS = (bool, int, float, np.generic)
_KINDS = "biuf"
_NUMBER = spaces.Box(-np.inf, np.inf, (), np.float64)


def infer_space(values: Sequence[Any], where: str = "value") -> gym.Space[Any]:
    """The narrowest kind of space that all values have in common; bounds are those of the dtype.

    Numbers and flags give a Box of shape (), arrays and regular lists a Box of their shape, arrays that
    differ in their first dimension a stacked Sequence, texts a Text, dicts (of the same keys) a Dict, tuples
    a Tuple. dtypes are the values' common one: int64 for Python integers, float64 for Python floats.

    Raises:
        SpaceError: The values differ in structure or have no space; the message names the place.
    """
    if not len(values):
        raise SpaceError(f"{where}: expected at least one value to infer a space from, found none")
    first = values[0]
    if isinstance(first, Mapping):
        return _dict_space(values, where)
    if isinstance(first, tuple):
        _check_all(values, lambda value: isinstance(value, tuple) and len(value) == len(first), first, where)
        return spaces.Tuple(
            [infer_space([v[i] for v in values], name_within(where, i)) for i in range(len(first))]
        )
    if isinstance(first, str):
        _check_all(values, lambda value: isinstance(value, str), first, where)
        characters = "".join(sorted(set().union(*values))) or " "
        return spaces.Text(max(1, *(len(value) for value in values)), min_length=0, charset=characters)
    return _array_space(values, where)


def conform(value: Any, space: gym.Space[Any]) -> Any:
    """An equal value with the types of an inferred space's samples.
    SpaceError if the value does not have the space's structure, or would be changed."""
    if isinstance(space, spaces.Dict) and isinstance(value, Mapping) and value.keys() == space.spaces.keys():
        return {key: conform(value[key], part) for key, part in space.spaces.items()}
    if isinstance(space, spaces.Tuple) and isinstance(value, tuple) and len(value) == len(space.spaces):
        return tuple(conform(item, part) for item, part in zip(value, space.spaces, strict=True))
    if isinstance(space, spaces.Text) and isinstance(value, str):
        return value
    dtype = space.feature_space.dtype if isinstance(space, spaces.Sequence) else space.dtype
    try:
        given = np.asarray(value)
        array = given if given.dtype == dtype else given.astype(dtype)
    except (TypeError, ValueError, OverflowError) as err:
        raise SpaceError(f"expected a value of {space}, found {value!r:.80}") from err
    if given.dtype.kind not in _KINDS or not (array is given or _same_numbers(given, array)):
        raise SpaceError(f"expected a value of {space}, found {value!r:.80}")
    return dtype.type(array) if isinstance(space, spaces.Discrete) else array  # type: ignore[union-attr]


def _same_numbers(given: Array, cast: Array) -> bool:
    if given.dtype.kind in "iu" and cast.dtype.kind == "f":
        # NumPy would compare them as floats, which cannot tell neighbours beyond 2**53 apart.
        with np.errstate(invalid="ignore"):
            return np.array_equal(cast.astype(given.dtype), given)
    return np.array_equal(cast, given, equal_nan=True)


def _episode_data(
    episode: Episode, space: tuple[gym.Space[Any], gym.Space[Any], gym.Space[Any] | None]
) -> EpisodeData:
    """An episode's values in the form of its spaces (states, actions, rewards; None where rewards are
    numbers).

    Raises:
        SpaceError: A value does not have the space's structure, or would be changed.
        StorageError: A value in the metadata has no JSON form.
    """
    states, actions, rewards = space
    tuples = episode.tuples
    try:
        dumps_plain(episode.metadata)
    except (TypeError, ValueError) as err:
        raise StorageError(f"expected metadata of an episode that JSON can hold: {err}") from err
    infos = [dict(item.info) for item in tuples]
    return EpisodeData(
        states=[conform(item.state, states) for item in tuples],
        actions=[conform(item.action, actions) for item in tuples],
        rewards=[conform(item.reward, _NUMBER if rewards is None else rewards) for item in tuples],
        terminals=[bool(item.terminal) for item in tuples],
        timeouts=[bool(item.timeout) for item in tuples],
        metadata=episode.metadata,
        infos=infos if any(infos) else None,
    )


def _episode_spaces(
    episodes: Sequence[Episode], declared: Sequence[gym.Space[Any]]
) -> tuple[gym.Space[Any], gym.Space[Any], gym.Space[Any] | None]:
    """Spaces of the states, actions and rewards of episodes: the declared ones that fit, else inferred ones."""
    tuples = [item for episode in episodes for item in episode.tuples]
    columns = [[item.state for item in tuples], [item.action for item in tuples]]
    state, action = (
        _declared_or_inferred(column, declared[i : i + 1], where)
        for i, (column, where) in enumerate(zip(columns, ("state", "action"), strict=True))
    )
    rewards = [item.reward for item in tuples]
    for reward in rewards:
        if reward is None or isinstance(reward, str):
            raise SpaceError(f"reward: expected a number, or an array of them, found {reward!r:.80}")
    if all(isinstance(reward, _NUMBERS) or np.shape(reward) == () for reward in rewards):
        return state, action, None
    return state, action, infer_space(rewards, "reward")


def write_episodes(path: Path, episodes: Sequence[Episode], benchmark: Benchmark) -> None:
    """Writes episodes of one benchmark as a recording.

    Raises:
        SpaceError: Values of one kind differ in structure from step to step, or have no space.
        StorageError: A value in the metadata has no JSON form.
    """
    spaces = _episode_spaces(episodes, declared_spaces(benchmark.serialized))
    write_recording(
        path,
        (_episode_data(episode, spaces) for episode in episodes),
        observation_space=spaces[0],
        action_space=spaces[1],
        reward_space=spaces[2],
        benchmark_id=benchmark.id,
        attachments=recording_attachments(benchmark.serialized),
    )


def record_each(
    episodes: Iterable[Episode], record: Callable[[str, Sequence[Episode]], Sequence[EpisodeHeader]]
) -> list[EpisodeHeader]:
    """Stores episodes with a function that records those of one benchmark; returns their headers in the given order.
    StorageError if an episode has no tuple; nothing is stored."""
    groups: dict[str, list[tuple[int, Episode]]] = {}
    for i, episode in enumerate(episodes):
        if not episode.tuples:
            raise StorageError(f"an episode needs at least one tuple, found none in episode {i}")
        groups.setdefault(episode.benchmark_id, []).append((i, episode))
    headers: dict[int, EpisodeHeader] = {}
    for benchmark_id, group in groups.items():
        places, given = zip(*group, strict=True)
        headers.update(zip(places, record(benchmark_id, given), strict=True))
    return [headers[i] for i in sorted(headers)]


def _declared_or_inferred(
    column: Sequence[Any], declared: Sequence[gym.Space[Any]], where: str
) -> gym.Space[Any]:
    for space in declared:
        try:
            if all(space.contains(conform(value, space)) for value in column):
                return space
        except (SpaceError, ValueError, TypeError, AttributeError):
            pass
    return infer_space(column, where)


def _dict_space(values: Sequence[Any], where: str) -> gym.Space[Any]:
    first = values[0]
    _check_all(
        values, lambda value: isinstance(value, Mapping) and value.keys() == first.keys(), first, where
    )
    parts = [(key, infer_space([value[key] for value in values], name_within(where, key))) for key in first]
    return spaces.Dict(parts)


def _array_space(values: Sequence[Any], where: str) -> gym.Space[Any]:
    arrays = [_array(value, where) for value in values]
    dtype = np.result_type(*{array.dtype for array in arrays})
    if dtype.kind == "f" and all(array.dtype.kind in "iu" and array.min(initial=0) >= 0 for array in arrays):
        dtype = np.dtype(np.uint64)  # NumPy would take float64 for signed and unsigned integers
    if dtype.kind not in _KINDS:
        raise SpaceError(f"{where}: expected numbers or flags of one kind, found {dtype}")
    shapes = {array.shape for array in arrays}
    if len(shapes) == 1:
        return _box(shapes.pop(), dtype)
    if len({shape[1:] for shape in shapes}) == 1 and () not in shapes:
        return spaces.Sequence(_box(next(iter(shapes))[1:], dtype), stack=True)
    raise SpaceError(f"{where}: expected values of one shape, found shapes {sorted(shapes)[:5]}")


def _array(value: Any, where: str) -> Array:
    try:
        array = np.asarray(value)
    except ValueError as err:
        raise SpaceError(f"{where}: expected a list with items of one shape, found {value!r:.80}") from err
    if array.dtype.kind not in _KINDS or array.dtype.itemsize > 8:
        kind = f"{type(value).__module__}.{type(value).__qualname__}"
        raise SpaceError(
            f"{where}: expected numbers, flags, texts, arrays, dicts or tuples, found {kind}: {value!r:.80}"
        )
    return array


def _box(shape: tuple[int, ...], dtype: np.dtype[Any]) -> gym.Space[Any]:
    if dtype.kind == "b":
        return spaces.Box(0, 1, shape, np.bool_)
    if dtype.kind == "f":
        return spaces.Box(-np.inf, np.inf, shape, dtype.type)
    limits = np.iinfo(dtype)
    return spaces.Box(limits.min, limits.max, shape, dtype.type)


def _check_all(values: Iterable[Any], test: Any, first: Any, where: str) -> None:
    for i, value in enumerate(values):
        if not test(value):
            raise SpaceError(
                f"{where}: expected every step to be like the first ({first!r:.60}), "
                f"step {i} has {value!r:.60}"
            )
