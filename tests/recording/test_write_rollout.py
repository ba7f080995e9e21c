"""Recordings of arrays: rollouts of one or many environments, and lists of episodes."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from gymnasium import spaces
from gymnasium.vector import AutoresetMode, SyncVectorEnv
from gymnasium.vector.utils import concatenate, create_empty_array
from mcap.reader import make_reader

import tupli_mcap
from tupli_mcap import EpisodeWriter, Recording, RecordingError, StepError, verify_recording, write_rollout
from tupli_mcap.arrays import Array, arrays_at
from tupli_mcap.vector import RecordEpisodes as RecordVector

STEPS, N = 200, 3


def rollout(mode: AutoresetMode, path: Path) -> dict[str, Any]:
    """A rollout as a user collects it, and the recording that `RecordEpisodes` makes of it."""
    make = lambda: gym.wrappers.TimeLimit(gym.make("CartPole-v1"), 15)  # noqa: E731
    env = RecordVector(SyncVectorEnv([make] * N, autoreset_mode=mode), path)
    rng = np.random.default_rng(0)
    columns: dict[str, list[Any]] = {name: [] for name in ("s", "a", "r", "terminal", "timeout", "next")}
    state, _ = env.reset(seed=3)
    for _ in range(STEPS):
        action = rng.integers(0, 2, N)
        after, reward, terminal, timeout, info = env.step(action)
        last = after.copy()
        for i in np.flatnonzero(info.get("_final_obs", [])):
            last[i] = info["final_obs"][i]
        for name, value in zip(columns, (state, action, reward, terminal, timeout, last), strict=True):
            columns[name].append(np.copy(value))
        done = terminal | timeout
        if mode is AutoresetMode.DISABLED and done.any():
            after, _ = env.reset(options={"reset_mask": done})
        state = after
    env.close()
    arrays = {name: np.stack(values) for name, values in columns.items()}
    arrays["s"] = np.concatenate([arrays["s"], state[None]])
    return arrays


@pytest.mark.parametrize("mode", list(AutoresetMode))
def test_a_rollout_is_what_the_wrapper_records(tmp_path: Path, mode: AutoresetMode) -> None:
    got = rollout(mode, tmp_path / "wrapped.mcap")
    write_rollout(
        tmp_path / "arrays.mcap", got["s"], got["a"], got["r"], got["terminal"], got["timeout"],
        next_states=got["next"], autoreset=mode.value, action_space=spaces.Discrete(2),
    )  # fmt: skip
    assert verify_recording(tmp_path / "arrays.mcap").problems == []
    with Recording(tmp_path / "wrapped.mcap") as wrapped, Recording(tmp_path / "arrays.mcap") as written:
        order = [np.lexsort((index["first_row"], index["env"])) for index in (wrapped.index, written.index)]
        assert len(order[0]) == len(order[1]) > 3 * N
        for i, j in zip(*order, strict=True):
            expected, found = wrapped.episodes[int(i)], written.episodes[int(j)]
            assert (expected.end, wrapped.index["env"][i]) == (found.end, written.index["env"][j])
            for name in ("states", "actions", "rewards", "terminals", "timeouts", "final_state"):
                np.testing.assert_array_equal(getattr(expected, name), getattr(found, name), name)
            assert wrapped.index["return"][i] == written.index["return"][j]


def messages(path: Path) -> dict[str, list[tuple[int, bytes]]]:
    """Everything that a recording says, but when."""
    found: dict[str, list[tuple[int, bytes]]] = {}
    with path.open("rb") as file:
        for _, channel, message in make_reader(file).iter_messages(log_time_order=False):
            found.setdefault(channel.topic, []).append((message.sequence, message.data))
    return found


NESTED = spaces.Dict(
    {"a": spaces.Box(-9, 9, (3,)), "b": spaces.Tuple([spaces.Discrete(4), spaces.Box(0, 9, (0,))])}
)


@pytest.mark.sampled(5)
@pytest.mark.parametrize("known", ["all", "none", "some"])
@pytest.mark.parametrize(
    ("space", "reward"),
    [
        (spaces.Box(-9, 9, (2, 3), np.float64), None),
        (NESTED, None),
        (spaces.Box(-9, 9, (0,)), None),  # without a byte
        (spaces.Discrete(9), spaces.Box(-9, 9, (2,), np.float64)),
    ],
)
def test_many_episodes_at_once_are_as_one_after_another(
    tmp_path: Path, space: Any, reward: Any, known: str
) -> None:
    """Byte for byte the same messages, over many changes of halves of the journal, with rewards that overflow."""
    rng, n = np.random.default_rng(0), 900
    space.seed(1)
    states, finals = (
        concatenate(space, [space.sample() for _ in range(n)], create_empty_array(space, n)) for _ in range(2)
    )
    actions, rewards = rng.normal(size=(n, 2)), rng.normal(size=n)
    rewards[[100, 200, 300]] = np.inf, -np.inf, np.nan
    if reward is not None:
        rewards = rng.normal(size=(n, 2))
    terminals, timeouts = rng.random(n) < 0.1, rng.random(n) < 0.02
    terminals[400:700] = timeouts[400:700] = False  # longer than a half
    terminals[-1] = True
    stops = np.flatnonzero(terminals | timeouts) + 1
    unknown = {"all": range(0), "none": range(len(stops)), "some": range(3, 40)}[known]
    given = (space, spaces.Box(-9, 9, (2,), np.float64))
    options: dict[str, Any] = {"reward_space": reward, "num_envs": 2, "chunk_size": 5000, "capture": "none"}
    with EpisodeWriter(tmp_path / "single.mcap", *given, **options) as writer:
        begin = 0
        for i, stop in enumerate(stops.tolist()):
            writer.begin(env=1)
            part = slice(begin, stop)
            steps = (arrays_at(column, part) for column in (states, actions, rewards, terminals, timeouts))
            writer.steps(*steps, env=1)
            writer.end(None if i in unknown else arrays_at(finals, i), env=1)
            begin = stop
    with EpisodeWriter(tmp_path / "many.mcap", *given, **options) as writer:
        for first, last in ((0, 3), (3, 40), (40, len(stops))):
            part = slice(stops[first - 1] if first else 0, stops[last - 1])
            steps = (arrays_at(column, part) for column in (states, actions, rewards, terminals, timeouts))
            after = None if first in unknown else arrays_at(finals, slice(first, last))
            writer.episodes(*steps, after, env=1)
            assert len(Recording(tmp_path / "many.mcap").episodes) == last
    assert messages(tmp_path / "single.mcap") == messages(tmp_path / "many.mcap")
    assert verify_recording(tmp_path / "many.mcap").problems == []
    with Recording(tmp_path / "single.mcap") as single, Recording(tmp_path / "many.mcap") as many:
        for name in single.index.dtype.names:
            if not name.endswith("time"):
                np.testing.assert_array_equal(single.index[name], many.index[name], name)
        assert (many.index["start_time"] <= many.index["end_time"]).all()


def test_many_episodes_at_once_need_their_ends(tmp_path: Path) -> None:
    with EpisodeWriter(tmp_path / "r.mcap", spaces.Box(-1, 1, (2,)), spaces.Discrete(2)) as writer:
        steps = np.zeros((3, 2), np.float32), np.zeros(3, np.int64), np.zeros(3)
        with pytest.raises(StepError, match="expected whole episodes, found no flag at the last step"):
            writer.episodes(*steps, [True, False, False], None, np.zeros((1, 2), np.float32))
        writer.begin()
        with pytest.raises(StepError, match=r"an episode is running; call end\(\) or discard\(\) first"):
            writer.episodes(*steps, [True, False, True], None, np.zeros((2, 2), np.float32))
    assert list(tmp_path.iterdir()) == []


def test_a_value_that_cannot_be_stored_leaves_whole_episodes(tmp_path: Path) -> None:
    n = 30_000
    states, finals, ends = np.zeros((n, 2), np.float32), np.ones((n // 10, 2)), np.arange(n) % 10 == 9
    finals[2000] = 0.1  # float32 cannot hold it
    with pytest.raises(StepError, match="state: expected values that float32 holds exactly, found float64"):
        write_rollout(
            tmp_path / "r.mcap", states, np.zeros((n, 1)), np.ones(n), ends, final_states=finals,
            autoreset="disabled",
        )  # fmt: skip
    with Recording(tmp_path / "r.mcap") as recording:
        assert set(recording.index["length"]) == {10}
        assert 0 < len(recording.episodes) <= 2000
        assert all(episode.final_state[0] == 1 for episode in recording.episodes)
    assert verify_recording(tmp_path / "r.mcap").problems == []


def test_final_states_come_from_where_they_are_known(tmp_path: Path) -> None:
    states = np.arange(7, dtype=np.float32)[:, None]
    done = np.array([False, True, False, False, False, True])
    rewards, actions = np.zeros(6), np.zeros((6, 1))

    def finals(**more: Any) -> list[Any]:
        write_rollout(tmp_path / "r.mcap", states, actions, rewards, done, mode="w", **more)
        with Recording(tmp_path / "r.mcap") as recording:
            return [None if e.final_state is None else float(e.final_state[0]) for e in recording.episodes]

    assert finals(autoreset="next-step") == [2, 6]
    assert finals(autoreset="same-step") == [None, None]
    assert finals(autoreset="disabled") == [None, None]  # the caller has reset
    assert finals(autoreset="same-step", final_states=np.array([[8.0], [9.0]], np.float32)) == [8, 9]
    assert finals(autoreset="same-step", final_observations=np.array([[8.0], [9.0]], np.float32)) == [8, 9]
    assert finals(autoreset="same-step", next_observations=states[1:] + 10) == [12, 16]
    done[1] = False
    assert finals() == [6]


@pytest.mark.parametrize("listed", [True, False])
def test_next_states_say_the_final_state(tmp_path: Path, listed: bool) -> None:
    states = np.arange(4.0)[:, None]  # one more than there are steps
    given = [states, np.zeros((3, 1)), np.zeros(3), np.array([False, False, True]), states[1:] + 10]
    *arrays, after = [[array] for array in given] if listed else given
    write_rollout(tmp_path / "r.mcap", *arrays, next_states=after)
    assert tupli_mcap.open(tmp_path / "r.mcap")[0].final_state == [13.0]


def test_many_episodes_of_which_one_has_a_final_state(tmp_path: Path) -> None:
    states, n = np.arange(3001, dtype=np.float32)[:, None], 3000  # one more than there are steps
    ends = np.arange(n) % 10 == 9
    ends[-1] = False
    write_rollout(tmp_path / "r.mcap", states, np.zeros((n, 1)), np.ones(n), ends, autoreset="disabled")
    with Recording(tmp_path / "r.mcap") as recording:
        *others, last = recording.episodes
        assert len(others) == 299 and all(episode.final_state is None for episode in others)
        np.testing.assert_array_equal(last.final_state, [3000])
        np.testing.assert_array_equal(recording.read().states, states[:-1])
        assert set(recording.index["length"]) == {10}
    assert verify_recording(tmp_path / "r.mcap").problems == []


def test_lists_are_episodes(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    lengths = [3, 1, 7]
    states = [rng.normal(size=(n + (i != 1), 2)) for i, n in enumerate(lengths)]
    actions = [rng.normal(size=(n, 2)) for n in lengths]
    rewards = [rng.normal(size=n) for n in lengths]
    write_rollout(
        tmp_path / "r.mcap", states, actions, rewards, [True, False, False], timeouts=[False, False, np.eye(7)[6]],
        infos=[{"x": np.arange(n)} for n in lengths], episode_metadata=[{"k": n} for n in lengths],
    )  # fmt: skip
    data = tupli_mcap.open(tmp_path / "r.mcap")
    assert [e.end for e in data] == ["terminal", "interrupted", "timeout"]
    assert [e.metadata for e in data] == [{"k": 3}, {"k": 1}, {"k": 7}]
    assert data[1].final_state is None
    np.testing.assert_array_equal(data[2].final_state, states[2][7])
    np.testing.assert_array_equal(data[2].states, states[2][:7])
    assert [info["x"] for info in data[2].infos] == list(range(7))


def test_ragged_arrays_of_an_npz_are_episodes(tmp_path: Path) -> None:
    def ragged(*arrays: Array) -> Array:
        held = np.empty(len(arrays), object)
        held[:] = arrays
        return held

    states = [np.arange(6.0).reshape(3, 2), np.arange(8.0).reshape(4, 2)]
    flags = [np.array([False, True]), np.array([False, False, True])]
    columns = {"states": ragged(*states), "actions": ragged(np.zeros(2), np.ones(3)), "dones": ragged(*flags)}
    np.savez(tmp_path / "old.npz", rewards=ragged(np.ones(2), np.zeros(3)), **columns)
    old = np.load(tmp_path / "old.npz", allow_pickle=True)
    write_rollout(tmp_path / "r.mcap", old["states"], old["actions"], old["rewards"], old["dones"])
    with Recording(tmp_path / "r.mcap") as recording:
        for episode, given in zip(recording.episodes, states, strict=True):
            assert np.array_equal(episode.all_states, given) and episode.end == "terminal"
        assert recording.returns.tolist() == [2, 0]


def test_seeds_and_a_dict_of_infos_for_each_step_are_kept(tmp_path: Path) -> None:
    """In lists of episodes, in arrays of sub-environments, and in arrays of one."""
    lists, vector, single = (tmp_path / f"{name}.mcap" for name in ("lists", "vector", "single"))
    lengths = [3, 1]
    infos: Any = [[{"x": i} if i else {"first": "yes"} for i in range(n)] for n in lengths]
    states, scalars = [np.zeros((n, 1)) for n in lengths], [np.zeros(n) for n in lengths]
    write_rollout(lists, states, scalars, scalars, infos=infos, seeds=[5, None])
    data = tupli_mcap.open(lists)
    assert [e.seed for e in data] == [5, None]
    assert [list(e.infos) for e in data] == infos

    ends = np.zeros((6, 2), np.bool_)
    ends[[1, 3], 0] = ends[5, :] = True
    told = [[{"step": t, "env": env} for env in range(2)] for t in range(6)]
    for given in (None, told):
        write_rollout(
            vector, np.zeros((6, 2, 1)), ends * 1.0, ends * 1.0, ends, infos=given, seeds=np.array([7, 8]),
            autoreset="disabled", mode="w",
        )  # fmt: skip
        data = tupli_mcap.open(vector)
        assert sorted((e.env, e.seed or 0, len(e)) for e in data) == [
            (0, 0, 2),
            (0, 0, 2),
            (0, 7, 2),
            (1, 8, 6),
        ]
    (second,) = data.filter("env == 1")
    assert list(second.infos) == [{"step": t, "env": 1} for t in range(6)]

    write_rollout(
        single, np.zeros((6, 1)), ends[:, 0], ends[:, 0] * 1.0, ends[:, 0], seeds=7, autoreset="disabled"
    )
    assert [e.seed for e in tupli_mcap.open(single)] == [7, None, None]


def test_tensors_dicts_and_images_are_understood(tmp_path: Path) -> None:
    torch = pytest.importorskip("torch")
    images = np.random.default_rng(0).integers(0, 255, (5, 2, 16, 16, 3)).astype(np.uint8)
    states = {"camera": torch.tensor(images), "joints": torch.rand(5, 2, 4, requires_grad=True)}
    actions = (torch.zeros(5, 2, dtype=torch.int64), torch.zeros(5, 2, dtype=torch.bool))
    write_rollout(tmp_path / "r.mcap", states, actions, torch.ones(5, 2), infos={"p": torch.rand(5, 2)})
    assert verify_recording(tmp_path / "r.mcap").problems == []
    with Recording(tmp_path / "r.mcap") as recording:
        assert recording.num_envs == 2
        for env, episode in enumerate(recording.episodes):
            np.testing.assert_array_equal(episode.states["camera"], images[:, env])
            np.testing.assert_array_equal(episode.states["joints"], states["joints"][:, env].detach())
            assert len(episode.infos) == 5


def test_refuses_a_dtype_that_numpy_does_not_have(tmp_path: Path) -> None:
    torch = pytest.importorskip("torch")
    states = torch.zeros(5, 3, dtype=torch.bfloat16)
    with pytest.raises(StepError, match=r"found Tensor of torch\.bfloat16 .*convert it first"):
        write_rollout(tmp_path / "r.mcap", states, np.zeros(5), np.zeros(5))
    assert not (tmp_path / "r.mcap").exists()


def test_texts_need_their_space(tmp_path: Path) -> None:
    words = np.array([["pick", "it"], ["up", "now"]])
    with pytest.raises(
        StepError, match="states: expected numbers, found <U4; convert it, or pass observation_space"
    ):
        write_rollout(tmp_path / "r.mcap", words, np.zeros((2, 2)), np.zeros((2, 2)))
    space = spaces.Text(10)
    write_rollout(tmp_path / "r.mcap", words, np.zeros((2, 2)), np.zeros((2, 2)), observation_space=space)
    with Recording(tmp_path / "r.mcap") as recording:
        assert [list(e.states) for e in recording.episodes] == [["pick", "up"], ["it", "now"]]


STATES, ACTIONS, REWARDS = np.zeros((4, 2)), np.zeros((4, 1)), np.zeros(4)
ENDS = np.array([True, True, False, False])


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ((STATES, ACTIONS, REWARDS, ENDS), 'autoreset: an episode ends at step 0, and the arrays go on; pass'),
        ((STATES, ACTIONS[1:], REWARDS), r"actions: expected arrays that begin with \(4,\), .* found \(3, 1\)"),
        ((STATES[1:], ACTIONS, REWARDS), r"states: expected arrays that begin with \(4,\) or \(5,\), as rewards"),
        ((np.zeros((2, 4, 1)), np.zeros((2, 3, 1)), np.zeros((2, 3))), r"found \(2, 4, 1\); arrays are \[T, N, …\]"),
        ((SimpleNamespace(x=STATES), ACTIONS, REWARDS), "found SimpleNamespace; give arrays in a dict or a tuple"),
        ((STATES, ACTIONS, REWARDS, REWARDS + 2), r"terminals: expected flags of shape \(4,\), .* found float64"),
        ((STATES, ACTIONS, np.zeros((4, 2, 2))), r"rewards: expected an array \[T\] or \[T, N\]"),
        (({"a": np.zeros((5, 1)), "b": STATES}, ACTIONS, REWARDS), "states: .* of one length, found 5 and 4"),
        (([{"a": STATES, "b": np.zeros(5)}], [ACTIONS], [REWARDS]), "episode 0: states: .* found 4 and 5"),
        ((STATES, ACTIONS, None), "rewards: expected arrays, or a list of one for each episode, found None"),
        (([STATES], [ACTIONS], [REWARDS, REWARDS]), "states: expected a list of one for each of 2 episodes, found 1"),
        (([STATES], [ACTIONS], [REWARDS[1:]]), r"episode 0: actions: expected arrays that begin with \(3,\)"),
        (([STATES], [ACTIONS], [REWARDS], [ENDS]), "^episode 0: expected no flag before the last step, 3, found one"),
        (([STATES], [ACTIONS], [REWARDS], ["no"]), "^episode 0: terminals: expected true or false, found array.'no'"),
        (([STATES], [ACTIONS], [REWARDS], [0], [np.nan]), "^episode 0: timeouts: expected true or false, "),
    ],
)  # fmt: skip
def test_what_does_not_fit_is_refused(tmp_path: Path, given: tuple[Any, ...], message: str) -> None:
    with pytest.raises(StepError, match=message):
        write_rollout(tmp_path / "r.mcap", *given)
    assert list(tmp_path.iterdir()) == []


def test_a_reward_alone_is_no_episode(tmp_path: Path) -> None:
    path = tmp_path / "r.mcap"
    with pytest.raises(
        StepError, match=r"^episode 1: rewards: expected an array of one for each step, found"
    ):
        write_rollout(path, [STATES, STATES[:1]], [ACTIONS, ACTIONS[:1]], [REWARDS, 1.0], [True, True])
    with Recording(path) as recording:
        assert [len(episode) for episode in recording.episodes] == [4]


def test_an_end_where_a_reset_should_be_is_refused(tmp_path: Path) -> None:
    with pytest.raises(
        StepError, match="expected a reset at step 1, after an end, found another end; pass autoreset"
    ):
        write_rollout(tmp_path / "r.mcap", STATES, ACTIONS, REWARDS, ENDS, autoreset="next-step")
    with pytest.raises(
        StepError, match="autoreset: expected one of next-step, same-step, disabled, found 'never'"
    ):
        write_rollout(tmp_path / "r.mcap", STATES, ACTIONS, REWARDS, ENDS, autoreset="never")
    with pytest.raises(StepError, match="expected states or observations, which mean the same, found both"):
        write_rollout(tmp_path / "r.mcap", STATES, ACTIONS, REWARDS, observations=STATES)
    assert list(tmp_path.iterdir()) == []


def test_the_run_is_told_as_to_the_other_recorders(tmp_path: Path) -> None:
    told: Any = {"name": "ppo", "metadata": {"lr": 0.1}, "tags": ["old"], "split": "eval"}
    arrays = [np.zeros((2, 2))], [np.zeros(2)], [np.zeros(2)]
    path = write_rollout(tmp_path, *arrays, episode_metadata=[{"task": 1}], **told, capture="none")
    assert path.parent == tmp_path and path.name.startswith("ppo")
    (episode,) = tupli_mcap.open(path)
    assert episode.metadata == {"task": 1}
    assert {key: getattr(episode.run, key) for key in told} == {**told, "tags": ("old",)}
    assert not episode.run.command
    assert write_rollout(tmp_path / "r.mcap", *arrays) == tmp_path / "r.mcap"


def test_infos_seeds_and_metadata_that_do_not_fit_are_refused(tmp_path: Path) -> None:
    arrays = np.zeros((2, 2)), np.zeros(2), np.zeros(2)
    with pytest.raises(StepError, match="infos: expected arrays by name, or a dict for each step, found"):
        write_rollout(tmp_path / "r.mcap", *arrays, infos=[{"x": 1}, None])
    with pytest.raises(
        StepError, match=r"infos: expected arrays that begin with \(2,\), as rewards, found \(1,\)"
    ):
        write_rollout(tmp_path / "r.mcap", *arrays, infos=[{"x": 1}])
    with pytest.raises(StepError, match="seeds: expected one for each of 2 sub-environments, found 3"):
        write_rollout(tmp_path / "r.mcap", np.zeros((2, 2, 1)), *[np.zeros((2, 2))] * 2, seeds=3)
    with pytest.raises(StepError, match="seeds: expected a list of one for each of 1 episodes, found 3"):
        write_rollout(tmp_path / "r.mcap", *([array] for array in arrays), seeds=3)
    with pytest.raises(
        StepError, match="^episode_metadata: expected a dict, .*found .*; give the episodes as lists"
    ):
        write_rollout(tmp_path / "r.mcap", *arrays, episode_metadata=[{"task": 1}])
    with pytest.raises(RecordingError, match=r"metadata\['code'\] is a .*module, .*; convert it"):
        write_rollout(tmp_path / "r.mcap", *arrays, metadata={"code": np})
    assert not (tmp_path / "r.mcap").exists()


def test_infos_may_be_nested(tmp_path: Path) -> None:
    path, n = tmp_path / "r.mcap", 4
    write_rollout(
        path, np.zeros((n, 1), np.float32), np.zeros(n, np.int64), np.ones(n),
        infos={"episode": {"r": np.arange(n)}}, autoreset="disabled",
    )  # fmt: skip
    assert [info["episode"]["r"] for info in Recording(path).episodes[0].infos] == [0, 1, 2, 3]
