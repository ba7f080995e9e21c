"""`write_rollout` writes a recording from arrays that hold whole rollouts."""

from __future__ import annotations

import itertools
import math
import os
from collections.abc import Iterable, Iterator, Mapping, Sequence, Sized
from pathlib import Path
from typing import Any, Final, Literal, NamedTuple

import gymnasium as gym
import numpy as np

from tupli_mcap.arrays import Array, arrays_at, map_arrays
from tupli_mcap.errors import StepError
from tupli_mcap.recording.write.options import Capture, Mode
from tupli_mcap.schema.keys import name_within
from tupli_mcap.spaces.exact import exact_flag, shorten
from tupli_mcap.wrappers.episode_writer import EpisodeWriter, count_of, flags_of, one_of

Autoreset = Literal["next-step", "same-step", "disabled"]
_MODES: Final = {"nextstep": "next-step", "samestep": "same-step", "disabled": "disabled"}
_CHUNK: Final = 256 * 1024
_TOGETHER: Final = 1 << 13  # steps that are written at once; a killed process loses their final states
# Up to this many streams, chunks are as large as those of one: they all have room in the journal.
_MANY: Final = 16
_CHOOSE: Final = (
    'pass autoreset="next-step" if the step after an end is a reset, whose action was ignored, "same-step" if the step '
    'that ends an episode already resets, "disabled" if you have reset between the steps'
)


class _Segment(NamedTuple):
    """Steps of one episode, or if `whole` of several, each ended by a flag; they have a final state each, or none."""

    env: int
    states: Any
    actions: Any
    rewards: Any
    terminals: Array
    timeouts: Array
    final_state: Any
    infos: Any
    metadata: Mapping[str, Any]
    seed: Any = None
    whole: bool = False
    name: str = ""  # for messages


def write_rollout(
    path: str | os.PathLike[str],
    states: Any = None,
    actions: Any = None,
    rewards: Any = None,
    terminals: Any = None,
    timeouts: Any = None,
    *,
    next_states: Any = None,
    final_states: Any = None,
    infos: Any = None,
    episode_metadata: Any = None,
    seeds: Any = None,
    autoreset: Autoreset | str | None = None,
    observation_space: gym.Space[Any] | None = None,
    action_space: gym.Space[Any] | None = None,
    reward_space: gym.Space[Any] | None = None,
    labels: Mapping[str, Sequence[str]] | None = None,
    attachments: Mapping[str, tuple[str, bytes]] | None = None,
    compression: str = "zstd",
    mode: Mode = "x",
    benchmark_id: str = "",
    name: str | None = None,
    metadata: Mapping[str, Any] | None = None,
    tags: Sequence[str] = (),
    split: str = "",
    environment: str = "",
    step_seconds: float | None = None,
    capture: Capture = "all",
    observations: Any = None,
    terminations: Any = None,
    truncations: Any = None,
    next_observations: Any = None,
    final_observations: Any = None,
) -> Path:
    """Writes a recording from arrays that hold whole rollouts, and returns its path.

        write_rollout("run.mcap", observations, actions, rewards, terminations, truncations, autoreset="next-step")
        write_rollout("demos.mcap", states=[s0, s1], actions=[a0, a1], rewards=[r0, r1], terminals=[True, False])

    Arrays are NumPy's, or have `__dlpack__` or `__array__` (torch, JAX). States and actions may be dicts and tuples of
    arrays, as their spaces are. Arrays hold T steps: [T, …], or [T, N, …] for N sub-environments, each of which becomes
    a stream of episodes of its own. In lists, and in arrays of objects, each entry is an episode: [T of this one, …].

    Args:
        path: the recording (.mcap), or a directory, in which a new file is named by `name` and time.
        states: what the actions were chosen on. If there is one more than there are steps (T + 1), it is the state
            after the last one, unless `next_states` or `final_states` say it; if that step ended an episode and
            `autoreset` is "same-step" or "disabled", it is the first one of the next episode, and no final state.
        terminals, timeouts: whether a step ended its episode; in lists, one flag for each episode will do. By default
            false. Steps after the last end are an interrupted episode.
        next_states: the state after each step, in arrays as long as the actions; final states are taken from it,
            also that of the last step, and nothing else.
        final_states: instead of that, one for each episode that a flag ends, in the order of
            `numpy.argwhere(terminals | timeouts)`; in lists, one for each episode, None if it is not known.
        infos: name -> array, along the same axes as the rewards; or a dict for each step, in a list of T, or in T lists
            of N; in lists of episodes, either of these for each episode.
        episode_metadata: of every episode; in lists, one for each or one for all.
        seeds: that of the reset before the first step, for sub-environments a list of N; in lists, one for each
            episode. None: not known.
        autoreset: what the row after an end is, if arrays continue after one. "next-step": a reset; its action and
            reward are left out. "same-step": a step of the next episode, whose first state follows the end.
            "disabled": the same, and the caller has reset between the steps, also after the last one if it is an end.
        observation_space, action_space: by default Boxes of the arrays' dtypes and shapes, without bounds; of
            flags (bool), MultiBinary or Discrete(2), whose values are integers.
        reward_space: for rewards that are arrays.
        labels, attachments, compression, mode, benchmark_id: as `tupli_mcap.RecordEpisodes` takes them.
        name, metadata, tags, split, capture: of the run, as `tupli_mcap.RecordEpisodes` takes them; what belongs to an
            episode is `episode_metadata`.
        environment, step_seconds: what the episodes are of, and how long a step takes (s), as
            `tupli_mcap.EpisodeWriter` takes them.
        observations, terminations, truncations, next_observations, final_observations: Gymnasium's names of states,
            terminals, timeouts, next_states, final_states.

    Raises:
        StepError: arrays do not fit together, or values cannot be stored exactly; the episodes before the first that
            cannot be stored are in the file then, which `mode="w"` replaces.
        SpaceError: a space cannot be recorded.
        RecordingError: the file exists, is being written, or cannot be written.
    """
    given = _Given(
        one_of("states", states, "observations", observations), actions, rewards,
        one_of("terminals", terminals, "terminations", terminations),
        one_of("timeouts", timeouts, "truncations", truncations),
        one_of("next_states", next_states, "next_observations", next_observations),
        one_of("final_states", final_states, "final_observations", final_observations),
        infos, episode_metadata, seeds,
    )  # fmt: skip
    parts, first, lead, count = _rollout_of(given, autoreset, reward_space)
    observations = observation_space or _space(first.states, lead, "states")
    with EpisodeWriter(
        path, observations, action_space or _space(first.actions, lead, "actions"), reward_space=reward_space,
        num_envs=count, labels=labels, attachments=attachments, compression=compression, mode=mode,
        benchmark_id=benchmark_id, chunk_size=_CHUNK * min(count or 1, _MANY), name=name, metadata=metadata,
        tags=tags, split=split, environment=environment, step_seconds=step_seconds, capture=capture,
    ) as writer:  # fmt: skip
        for part in parts:
            try:
                _write(writer, part)
            except StepError as err:
                raise StepError(f"{part.name}{err}") from err
    return writer.path


def _rollout_of(
    given: _Given, autoreset: Any, reward_space: gym.Space[Any] | None
) -> tuple[Iterable[_Segment], _Given, int, int | None]:
    """The parts to write, values for the spaces, how many axes these have before those of one step, and the number of
    streams."""
    given = _Given._make(list(one) if _is_list_of_objects(one) else one for one in given)
    for name, value in zip(given._fields[:3], given, strict=False):
        if value is None:
            raise StepError(f"{name}: expected arrays, or a list of one for each episode, found None")
    if isinstance(given.rewards, list | tuple) and given.rewards and _array(given.rewards[0]).ndim:
        return _episodes(given), _episode(given, 0), 1, None
    if not isinstance(given.episode_metadata, Mapping | None):
        raise StepError(
            "episode_metadata: expected a dict, which is of every episode in the arrays, found "
            f"{shorten(given.episode_metadata)}; give the episodes as lists of arrays for metadata of each"
        )
    given = _Given._make(
        [*(map_arrays(one, _array) for one in given[:-2]), given.episode_metadata, given.seeds]
    )
    lead = _lead(given.rewards, reward_space)
    count = given.rewards.shape[1] if lead == 2 else None
    return _streams(given, lead, _mode(autoreset)), given, lead, count


def _is_list_of_objects(value: Any) -> bool:
    """Whether it is an array of objects, as a .npz has for arrays of different lengths."""
    return isinstance(value, np.ndarray) and value.dtype == np.object_ and value.ndim == 1


class _Given(NamedTuple):
    """The arguments that hold data."""

    states: Any
    actions: Any
    rewards: Any
    terminals: Any
    timeouts: Any
    next_states: Any
    final_states: Any
    infos: Any
    episode_metadata: Any
    seeds: Any


def _write(writer: EpisodeWriter, part: _Segment) -> None:
    steps = part.states, part.actions, part.rewards, part.terminals, part.timeouts
    if part.whole:
        writer.episodes(*steps, part.final_state, env=part.env)
        return
    n = len(part.rewards)
    is_told = part.infos is not None and len(part.infos) > 0
    infos = [arrays_at(part.infos, i) for i in range(n)] if is_told else None
    writer.begin(seed=part.seed, metadata=part.metadata, env=part.env)
    writer.steps(*steps, infos=infos, env=part.env)
    writer.end(part.final_state, env=part.env)


# ---- lists of episodes


def _episodes(given: _Given) -> Iterator[_Segment]:
    """The episodes of lists of arrays."""
    for i in range(len(given.rewards)):
        one = _episode(given, i)
        try:
            states, rewards, n = one.states, _array(one.rewards), count_of(one.rewards)
            if n == 0:
                raise StepError("expected at least one step, found none")
            flags = [_episode_flags(getattr(one, name), n, name) for name in ("terminals", "timeouts")]
        except StepError as err:
            raise StepError(f"episode {i}: {err}") from err
        _check_infos(one.infos)
        for name in ("actions", "next_states", "infos"):
            _check_shape(f"episode {i}: {name}", getattr(one, name), (n,), n)
        _check_shape(f"episode {i}: states", states, (n,), n, n + 1)
        final = one.final_states
        if final is None:
            told = one.next_states is not None or _length(states) == n
            final = arrays_at(one.next_states, n - 1) if told else arrays_at(states, n)
        yield _Segment(
            0, arrays_at(states, slice(n)), one.actions, rewards, flags[0], flags[1], final, one.infos,
            one.episode_metadata or {}, one.seeds, name=f"episode {i}: ",
        )  # fmt: skip


def _episode(given: _Given, i: int) -> _Given:
    """The i-th entry of all given lists."""
    count, entries = len(given.rewards), []
    for name, value in given._asdict().items():
        if value is None or (name == "episode_metadata" and isinstance(value, Mapping)):
            entries.append(value)
            continue
        if isinstance(value, Mapping) or not hasattr(value, "__len__") or len(value) != count:
            found = len(value) if isinstance(value, Sequence) else shorten(value)
            raise StepError(f"{name}: expected a list of one for each of {count} episodes, found {found}")
        entries.append(value[i] if name in ("episode_metadata", "seeds") else map_arrays(value[i], _array))
    return _Given(*entries)


def _episode_flags(given: Any, n: int, name: str) -> Array:
    """Flags of the steps of an episode; a single given flag is that of the last step. StepError if it is no flag."""
    if given is not None and given.ndim:
        return np.asarray(given)
    flags = np.zeros(n, np.bool_)
    flags[-1] = given is not None and exact_flag(given, name)
    return flags


# ---- arrays of steps


def _streams(given: _Given, lead: int, mode: str) -> Iterator[_Segment]:
    """The episodes of arrays [T, …] or [T, N, …], one sub-environment after the other; StepError if arrays do not fit
    together; at once, before anything is written."""
    shape = given.rewards.shape[:lead]
    _check_infos(given.infos)
    for name in ("actions", "next_states", "infos"):
        _check_shape(name, getattr(given, name), shape, shape[0])
    _check_shape("states", given.states, shape, shape[0], shape[0] + 1)
    terminals = flags_of(given.terminals, shape, "terminals")
    timeouts = flags_of(given.timeouts, shape, "timeouts")
    done = terminals | timeouts
    if not mode and done[:-1].any():
        step = np.argwhere(done[:-1])[0][0]
        raise StepError(f"autoreset: an episode ends at step {step}, and the arrays go on; {_CHOOSE}")
    given = given._replace(terminals=terminals, timeouts=timeouts, seeds=_seeds(given.seeds, shape[1:]))
    finals = _Finals(given, done, mode)
    columns = [(env,) for env in range(shape[1])] if lead == 2 else [()]
    spans = [_spans(done[:, *column], mode) for column in columns]
    parts = (_parts(given, finals, *each) for each in zip(columns, spans, strict=True))
    return itertools.chain.from_iterable(parts)


def _seeds(given: Any, streams: tuple[int, ...]) -> Sequence[Any]:
    """The seed of each sub-environment; of the only one if there are none."""
    seeds: Sequence[Any] = [given] * math.prod(streams) if given is None or not streams else given
    if not isinstance(seeds, Sized) or len(seeds) != math.prod(streams):
        raise StepError(
            f"seeds: expected one for each of {streams[0]} sub-environments, found {shorten(given)}"
        )
    return seeds


def _spans(done: Array, mode: str) -> tuple[Array, Array]:
    """First and last steps of the episodes of one sub-environment."""
    last, is_reset = len(done) - 1, mode == "next-step"
    ends = np.flatnonzero(done)
    if not done[last]:
        ends = np.append(ends, last)
    begins = np.append(0, ends[:-1] + 1 + is_reset)
    empty = ends[(begins > ends) & done[ends]]
    if len(empty):
        raise StepError(
            f"autoreset: expected a reset at step {empty[0]}, after an end, found another end; {_CHOOSE}"
        )
    kept = begins <= ends
    return begins[kept], ends[kept]


def _parts(
    given: _Given, finals: _Finals, column: tuple[int, ...], spans: tuple[Array, Array]
) -> Iterator[_Segment]:
    """The episodes of one sub-environment; consecutive whole ones are one part."""
    begins, ends = spans
    alone, known = ~finals.done[ends, *column], finals.known(ends, column)
    env = column[0] if column else 0
    if given.infos is not None or given.episode_metadata:
        alone[:] = True
    alone[0] |= given.seeds[env] is not None
    turns = (np.diff(begins // _TOGETHER) != 0) | (known[1:] != known[:-1])
    cuts = np.flatnonzero(turns | alone[1:] | alone[:-1]) + 1
    for first, stop in itertools.pairwise([0, *cuts.tolist(), len(ends)]):
        whole = stop - first > 1
        rows: Any = slice(begins[first], ends[stop - 1] + 1)
        after = ends[first : stop - 1] + 1
        if (begins[first + 1 : stop] != after).any():  # resets, which are no steps
            rows = np.delete(np.arange(rows.start, rows.stop), after - rows.start)
        where, last = (rows, *column), ends[first:stop] if whole else int(ends[first])
        states, actions, rewards, terminals, timeouts, infos = (
            arrays_at(tree, where) for tree in (*given[:5], given.infos)
        )
        yield _Segment(
            env, states, actions, rewards, terminals, timeouts, finals.at(last, column), infos,
            given.episode_metadata or {}, None if first else given.seeds[env], whole,
        )  # fmt: skip


class _Finals:
    """Finds the states after the last steps of episodes."""

    def __init__(self, given: _Given, done: Array, mode: str) -> None:
        self.done = done
        self._given, self._mode = given, mode
        # the numbers of the ends, in the order of `argwhere`
        self._order = np.cumsum(done.reshape(-1)).reshape(done.shape) - 1
        if given.final_states is not None:
            count = int(np.count_nonzero(done))
            _check_shape("final_states", given.final_states, (count,), count)

    def known(self, last: Any, column: tuple[int, ...]) -> Any:
        """Whether the states after these steps are known: bool, or an array of them."""
        if self._given.next_states is not None:
            return np.ones_like(last, np.bool_)
        done = self.done[last, *column]
        # without a mode, an end is that of the last step, and no row is of a reset
        in_states = (~done | (self._mode in ("", "next-step"))) & (last + 1 < _length(self._given.states))
        return in_states if self._given.final_states is None else in_states | done

    def at(self, last: Any, column: tuple[int, ...]) -> Any:
        """The states after these steps; None if they are not known."""
        given, place = self._given, (last, *column)
        if not np.all(self.known(last, column)):
            return None
        if given.final_states is not None and np.all(self.done[place]):
            return arrays_at(given.final_states, self._order[place])
        if given.next_states is not None:
            return arrays_at(given.next_states, place)
        return arrays_at(given.states, (last + 1, *column))


def _mode(given: Any) -> str:
    if given is None:
        return ""
    text = str(getattr(given, "value", given)).lower().replace("_", "").replace("-", "").replace(" ", "")
    if text not in _MODES:
        raise StepError(f"autoreset: expected one of {', '.join(_MODES.values())}, found {shorten(given)}")
    return _MODES[text]


def _lead(rewards: Array, space: gym.Space[Any] | None) -> int:
    """The number of axes before those of one step: 1, or 2 with sub-environments."""
    own = len(space.shape) if isinstance(space, gym.Space) and space.shape is not None else 0
    if not isinstance(rewards, np.ndarray):
        raise StepError(
            f"rewards: expected an array, or a list of one for each episode, found {shorten(rewards)}"
        )
    lead = rewards.ndim - own
    if lead not in (1, 2) or 0 in rewards.shape[:lead]:
        raise StepError(
            f"rewards: expected an array [T] or [T, N] of T > 0 steps, or a list of one for each episode, "
            f"found shape {rewards.shape}"
        )
    return lead


def _check_infos(infos: Any) -> None:
    is_dicts = isinstance(infos, np.ndarray) and all(isinstance(one, Mapping) for one in infos.flat)
    if not (infos is None or isinstance(infos, Mapping) or is_dicts):
        raise StepError(f"infos: expected arrays by name, or a dict for each step, found {shorten(infos)}")


def _check_shape(name: str, tree: Any, shape: tuple[int, ...], *steps: int) -> None:
    leaves = _leaves(tree)
    for array in leaves:
        if array.shape[: len(shape)] not in [(t, *shape[1:]) for t in steps]:
            expected = " or ".join(str((t, *shape[1:])) for t in steps)
            if array.shape == () and array.dtype == object:
                found = f"{type(array.item()).__name__}; give arrays in a dict or a tuple"
            else:
                found = f"{array.shape}" + "; arrays are [T, N, …]" * (len(shape) > 1)
            raise StepError(f"{name}: expected arrays that begin with {expected}, as rewards, found {found}")
        if len(array) != len(leaves[0]):
            raise StepError(
                f"{name}: expected arrays of one length, found {len(leaves[0])} and {len(array)} entries"
            )


# ---- trees of arrays


def _array(value: Any) -> Array:
    """The array in an object that holds one, without a copy if possible."""
    if isinstance(value, np.ndarray):
        return value
    if hasattr(value, "detach"):  # a tensor that has a gradient, or lies on another device
        value = value.detach().cpu()
    if hasattr(value, "__dlpack__"):
        try:
            found: Array = np.from_dlpack(value)
        except (BufferError, TypeError, RuntimeError, ValueError):
            pass  # an object that DLPack refuses may still be an array
        else:
            return found
    try:
        return np.asarray(value)
    except (TypeError, RuntimeError, ValueError) as err:  # such as a tensor of torch.bfloat16
        kind = f"{type(value).__name__} of {getattr(value, 'dtype', 'unknown dtype')}"
        raise StepError(f"expected an array of numbers, found {kind} ({err}); convert it first") from err


def _leaves(tree: Any) -> list[Array]:
    if tree is None:
        return []
    if isinstance(tree, Mapping):
        tree = tuple(tree.values())
    return [leaf for one in tree for leaf in _leaves(one)] if isinstance(tree, tuple) else [tree]


def _length(tree: Any) -> int:
    return min((len(array) for array in _leaves(tree)), default=0)


def _space(tree: Any, lead: int, name: str) -> gym.Space[Any]:
    """A space for the values in arrays, without their first `lead` axes."""
    if isinstance(tree, Mapping):
        return gym.spaces.Dict(
            {key: _space(value, lead, name_within(name, key)) for key, value in tree.items()}
        )
    if isinstance(tree, tuple):
        return gym.spaces.Tuple([_space(value, lead, name_within(name, i)) for i, value in enumerate(tree)])
    shape, dtype = tree.shape[lead:], tree.dtype
    if dtype.kind == "b":
        return gym.spaces.MultiBinary(shape) if shape else gym.spaces.Discrete(2)
    if dtype.kind in "iu":
        limits = np.iinfo(dtype)
        return gym.spaces.Box(limits.min, limits.max, shape, dtype.type)
    if dtype.kind == "f":
        return gym.spaces.Box(-np.inf, np.inf, shape, dtype.type)
    raise StepError(
        f"{name}: expected numbers, found {dtype}; convert it, or pass observation_space and action_space"
    )
