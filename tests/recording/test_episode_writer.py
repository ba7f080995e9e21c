"""Episodes recorded without an environment, step by step."""

from __future__ import annotations

import copy
import gc
import os
import random
import sys
import warnings
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest
from environments import same
from gymnasium import spaces
from killing.moments import Moment, lay_trap

import tupli_mcap
from tupli_mcap import (
    EpisodeWriter,
    RecordEpisodes,
    Recording,
    RecordingError,
    SpaceError,
    StepError,
    journal_path,
    recover_recording,
    verify_recording,
)

BOX = spaces.Box(-1, 1, (3,), np.float32)
TEXT = spaces.Dict({"note": spaces.Text(30), "x": BOX})
CAMERA = spaces.Dict({"camera": spaces.Box(0, 255, (8, 8, 3), np.uint8), "x": BOX})
TALKING = spaces.Dict({"camera": spaces.Box(0, 255, (8, 8, 3), np.uint8), "note": spaces.Text(9)})
SPACES = {"box": BOX, "text": TEXT, "camera": CAMERA, "camera and text": TALKING}
ACTIONS = spaces.Discrete(9)


class Told(NamedTuple):
    """What an episode should be."""

    env: int
    seed: int | None
    steps: list[tuple[Any, ...]]
    end: str
    final: Any
    metadata: dict[str, Any]


class Script:
    """Calls of a writer, drawn by chance, and what they record."""

    def __init__(self, space: Any, num_envs: int | None, seed: int, count: int = 120) -> None:
        rng, space = random.Random(seed), copy.deepcopy(space)
        space.seed(seed)
        self.calls: list[tuple[str, int, tuple[Any, ...], dict[str, Any]]] = []
        running = [-1] * (num_envs or 1)  # steps so far
        over = [False] * len(running)
        for _ in range(count):
            env = rng.randrange(len(running))
            more: dict[str, Any] = {"env": env}
            if running[env] < 0 or (over[env] and rng.random() < 0.5):
                more |= {"metadata": {"n": len(self.calls)}, "seed": rng.choice([None, 7])}
                self.calls.append(("begin", env, (), more))
                running[env], over[env] = 0, False
            elif over[env] or rng.random() < 0.12:
                name = rng.choice(["end", "end", "discard"])
                state = (rng.choice([None, space.sample()]),) if name == "end" else ()
                self.calls.append((name, env, state, more))
                running[env] = -1
            elif rng.random() < 0.03:
                self.calls.append(("flush", env, (), {}))
            else:
                ends = rng.choice([(True, False), (False, True)]) if rng.random() < 0.1 else (False, False)
                values = (space.sample(), np.int64(rng.randrange(9)), rng.uniform(-1, 1), *ends)
                self.calls.append(("step", env, values, more))
                running[env], over[env] = running[env] + 1, any(ends)

    def run(self, writer: EpisodeWriter, told: Any = lambda: None) -> None:
        for name, _, values, more in self.calls:
            getattr(writer, name)(*values, **more)
            told()

    def episodes(self, count: int, *, closed: bool = False) -> list[Told]:
        """What so many of the calls have recorded."""
        found: list[Told] = []
        running: dict[int, tuple[int, dict[str, Any]]] = {}

        def end(env: int, final: Any = None, more: dict[str, Any] | None = None) -> None:
            place, facts = running.pop(env, (-1, {}))
            if place >= 0:
                found[place] = found[place]._replace(final=final, metadata=facts["metadata"] | (more or {}))

        for name, env, values, more in self.calls[:count]:
            if name == "begin":
                end(env)
                running[env] = (-1, more)
            elif name == "step":
                place, facts = running[env]
                if place < 0:
                    place = len(found)
                    found.append(Told(env, facts["seed"], [], "", None, {}))
                    running[env] = (place, facts)
                how = "terminal" if values[3] else "timeout" if values[4] else "interrupted"
                found[place] = found[place]._replace(steps=[*found[place].steps, values], end=how)
            elif name != "flush":
                end(env, *values, more={"discarded": True} if name == "discard" else None)
        for env in list(running) if closed else ():
            end(env)
        return found


def read(path: Path) -> list[Told]:
    with Recording(path) as recording:
        return [
            Told(e.env, e.seed, [_plain(step) for step in e], e.end, e.final_state, e.metadata)
            for e in recording.episodes
        ]


def _plain(step: Any) -> tuple[Any, ...]:
    state, action, reward, terminal, timeout, _ = step
    return state, action, float(reward), terminal, timeout


@pytest.mark.sampled(9)
@pytest.mark.parametrize("durability", ["os", "step"])
@pytest.mark.parametrize("num_envs", [None, 1, 3])
@pytest.mark.parametrize("name", SPACES)
def test_episodes_are_as_they_were_told(
    tmp_path: Path, name: str, num_envs: int | None, durability: Any
) -> None:
    space, path = SPACES[name], tmp_path / "r.mcap"
    script = Script(space, num_envs, 3, 600)
    with EpisodeWriter(
        path, space, ACTIONS, num_envs=num_envs, chunk_size=3000, durability=durability
    ) as writer:
        script.run(writer)
    expected = script.episodes(len(script.calls), closed=True)
    assert any("discarded" in told.metadata for told in expected)
    kept = [told for told in expected if "discarded" not in told.metadata]
    assert len(kept) > 10
    assert same(read(path), kept)
    assert verify_recording(path).problems == []
    with Recording(path) as recording:
        assert recording.is_vector == (num_envs is not None)
    assert [file.name for file in tmp_path.iterdir()] == ["r.mcap"]


def test_gymnasium_s_names_mean_the_same(tmp_path: Path) -> None:
    states = np.arange(9, dtype=np.float32).reshape(3, 3) / 10
    with EpisodeWriter(tmp_path / "r.mcap", BOX, ACTIONS) as writer:
        for end in ({"terminated": True}, {"truncated": True}):
            writer.begin()
            writer.step(observation=states[0], action=1, reward=0.5, terminated=False, truncated=False)
            writer.step(observation=states[1], action=2, reward=1.0, **end)
            writer.end(final_observation=states[2])
        writer.begin()
        with pytest.raises(StepError, match="expected state or observation, which mean the same, found both"):
            writer.step(states[0], 1, 0.0, observation=states[0])
        with pytest.raises(StepError, match="expected terminal or terminated"):
            writer.step(states[0], 1, 0.0, True, terminated=True)
        with pytest.raises(StepError, match="state: expected .*found None"):
            writer.step(action=1, reward=0.0)
    with Recording(tmp_path / "r.mcap") as recording:
        assert [episode.end for episode in recording] == ["terminal", "timeout"]
        for episode in recording:
            assert np.array_equal(episode.all_states, states)


def test_the_environment_has_a_name(tmp_path: Path) -> None:
    for name in ("arm", "legs"):
        for _ in range(2):
            with EpisodeWriter(tmp_path / f"{name}.mcap", BOX, ACTIONS, environment=name, mode="a") as writer:
                writer.begin()
                writer.step(BOX.sample(), 1, 0.0)
    states = np.zeros((3, 3), np.float32)
    path = tupli_mcap.write_rollout(
        tmp_path, states, np.ones(3, np.int64), np.zeros(3), action_space=ACTIONS, environment="arm"
    )
    assert path.name.startswith("arm_")
    with Recording(tmp_path / "arm.mcap") as recording:
        assert [run.environment for run in recording.runs] == ["arm"]
    assert len(tupli_mcap.open(tmp_path).filter("run.environment = 'arm'")) == 3
    with pytest.raises(RecordingError, match="environment: expected a name, found None"):
        EpisodeWriter(tmp_path / "x.mcap", BOX, ACTIONS, environment=None)  # type: ignore[arg-type]


@pytest.mark.sampled(4)
@pytest.mark.parametrize("call", ["step", "begin", "end", "discard", "flush"])
@pytest.mark.parametrize(
    ("name", "num_envs"), [("box", None), ("text", 2), ("camera", 2), ("camera and text", None)]
)
def test_a_killed_process_loses_no_step(tmp_path: Path, name: str, num_envs: int | None, call: str) -> None:
    durabilities: tuple[Any, ...] = ("os", "os", "step")
    for seed, durability in enumerate(durabilities):
        path, rng = tmp_path / f"{seed}.mcap", random.Random(seed)
        script = Script(SPACES[name], num_envs, seed)
        times = sum(one[0] == call for one in script.calls)
        moment = Moment("by hand", (f"EpisodeWriter.{call}", f"Recorder.{call}"), times=min(times, 40))
        done = _die(script, SPACES[name], moment, rng, path, num_envs=num_envs, durability=durability)
        assert done < len(script.calls)
        if not path.exists():
            continue
        found = read(path)
        running = script.calls[done]  # which it died in
        after = running[2][0] if running[0] == "step" else None
        assert any(_agree(found, script.episodes(done + more), running[1], after) for more in (0, 1)), (
            seed,
            done,
        )
        problems = [p for p in verify_recording(path).problems if p.severity != "note"]
        assert problems == []
        if journal_path(path).exists():
            recover_recording(path, tmp_path / "whole.mcap", overwrite=True)
            assert same(read(tmp_path / "whole.mcap"), found)
        EpisodeWriter(path, SPACES[name], ACTIONS, num_envs=num_envs, mode="a").close()
        assert not path.exists() or same(read(path), found)


def _agree(found: list[Told], expected: list[Told], env: int, after: Any) -> bool:
    """Whether two lists are the same, but that the state `after` the last step of a running episode may be known."""
    if len(found) != len(expected):
        return False
    for one, other in zip(found, expected, strict=True):
        if other.final is None and one.env == env and after is not None and same(one.final, after):
            one = one._replace(final=None)
        if not same(one, other):
            return False
    return True


def _die(script: Any, space: Any, moment: Moment, rng: random.Random, path: Path, **options: Any) -> int:
    """Runs a script in a process that is killed; returns how many calls had returned."""
    read_end, write_end = os.pipe()
    gc.collect()
    pid = os.fork()
    if pid == 0:
        try:
            warnings.simplefilter("ignore")
            writer = EpisodeWriter(path, space, ACTIONS, chunk_size=700, **options)
            lay_trap(moment, rng, int(10 ** rng.uniform(0, 3)), lambda *_: None)
            script.run(writer, lambda: os.write(write_end, b"."))
        finally:
            os._exit(0)
    os.close(write_end)
    done = 0
    while data := os.read(read_end, 4096):
        done += len(data)
    os.close(read_end)
    _, status = os.waitpid(pid, 0)
    assert os.WIFSIGNALED(status)  # not by an exception
    return done


def test_a_killed_process_loses_none_of_many_steps(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    states, rewards = rng.random((500, 3)).astype(np.float32), rng.random(500)
    parts = np.split(np.arange(500), np.cumsum(rng.integers(1, 60, 9)))

    class Parts:
        def run(self, writer: EpisodeWriter, told: Any) -> None:
            for part in parts:
                if part[0] == 0:
                    writer.begin()
                writer.steps(states[part], np.full(len(part), 4), rewards[part])
                told()

    for seed in range(12):
        path = tmp_path / f"{seed}.mcap"
        moment = Moment("by hand", ("SingleRows._put_rows",), times=9)
        done = _die(Parts(), BOX, moment, random.Random(seed), path)
        assert done < len(parts)
        (told,) = read(path) or [None]
        if told is None and not done:
            continue
        assert len(told.steps) >= (parts[done - 1][-1] + 1 if done else 1)
        # its death may leave the next state behind
        assert told.final is None or np.array_equal(told.final, states[len(told.steps)])
        np.testing.assert_array_equal([step[0] for step in told.steps], states[: len(told.steps)])
        np.testing.assert_array_equal([step[2] for step in told.steps], rewards[: len(told.steps)])


def test_a_killed_process_loses_none_of_many_episodes(tmp_path: Path) -> None:
    """Of calls that have returned; of the one it dies in, steps and final states that are not recorded yet."""
    rng = np.random.default_rng(0)
    states, finals, rewards = (
        rng.random((500, 3)).astype(np.float32),
        rng.random((50, 3), np.float32),
        rng.random(500),
    )
    ends = np.arange(500) % 10 == 9
    calls = [slice(0, 1), slice(1, 12), slice(12, 30), slice(30, 50)]  # episodes

    class Calls:
        def run(self, writer: EpisodeWriter, told: Any) -> None:
            for call in calls:
                part = slice(call.start * 10, call.stop * 10)
                actions, flags = np.full(len(rewards[part]), 4), (ends[part], None)
                writer.episodes(states[part], actions, rewards[part], *flags, finals[call])
                told()

    for seed in range(9):
        path = tmp_path / f"{seed}.mcap"
        function = ("SingleRows._put_rows", "Stream._put_together", "EpisodeLog.extend")[seed % 3]
        done = _die(Calls(), BOX, Moment("by hand", (function,), times=3), random.Random(seed), path)
        assert done < len(calls)
        found = read(path)
        whole = calls[done - 1].stop if done else 0
        assert len(found) >= whole
        steps = [step for told in found for step in told.steps]
        assert same(
            [(step[0], step[2]) for step in steps],
            list(zip(states, rewards.tolist(), strict=False))[: len(steps)],
        )
        for i, told in enumerate(found):
            assert told.end == "terminal" or i == len(found) - 1
            assert same(told.final, finals[i]) or (told.final is None and i >= whole)
        assert [p for p in verify_recording(path).problems if p.severity != "note"] == []
        EpisodeWriter(path, BOX, ACTIONS, mode="a").close()
        assert same(read(path), found)


@pytest.mark.parametrize("call", ["step", "begin", "end", "discard"])
def test_what_interrupts_a_call_loses_no_step(tmp_path: Path, call: str) -> None:
    """Ctrl-C at any line: closing finishes the file from its journal."""
    for seed in range(8):
        path, rng = tmp_path / f"{seed}.mcap", random.Random(seed)
        script, returned = Script(TEXT if seed % 2 else BOX, 2, seed), []
        writer = EpisodeWriter(path, TEXT if seed % 2 else BOX, ACTIONS, num_envs=2, chunk_size=700)
        left, occurrence = rng.randint(1, 60), rng.randint(1, 5)

        def trace(frame: Any, event: str, arg: Any) -> Any:
            nonlocal left, occurrence
            if event == "call":
                occurrence -= frame.f_code.co_qualname == f"EpisodeWriter.{call}"
                return trace if occurrence <= 0 and "tupli_mcap" in frame.f_code.co_filename else None
            left -= event == "line"
            if left == 0:
                raise KeyboardInterrupt
            return trace

        before = sys.gettrace()
        sys.settrace(trace)
        with pytest.raises(KeyboardInterrupt):
            script.run(writer, lambda: returned.append(None))  # noqa: B023 - called at once
        sys.settrace(before)
        writer.close()
        count = len(returned)
        expected = [
            script.episodes(count + more, closed=closed) for more in (0, 1) for closed in (False, True)
        ]
        kept = [[one for one in told if "discarded" not in one.metadata] for told in expected]
        found = read(path) if path.exists() else []
        after = script.calls[count][2][0] if script.calls[count][0] == "step" else None
        assert any(_agree(found, told, script.calls[count][1], after) for told in [*expected, *kept]), seed
        assert not path.exists() or verify_recording(path).problems == []


def test_the_state_after_the_last_step_is_not_made_up(tmp_path: Path) -> None:
    path = tmp_path / "r.mcap"
    state = np.ones(3, np.float32)
    writer = EpisodeWriter(path, BOX, ACTIONS)
    writer.begin()
    for i in range(3):
        writer.step(state * i, 1, 0.5)
    with Recording(path) as recording:
        assert recording.episodes[0].final_state is None
    writer.close()
    assert read(path)[0].final is None


def test_the_time_of_a_step_is_kept(tmp_path: Path) -> None:
    steps = np.zeros((6, 3), np.float32)
    with EpisodeWriter(tmp_path / "a.mcap", BOX, ACTIONS, step_seconds=1 / 50) as writer:
        writer.begin()
        writer.step(steps[0], ACTIONS.sample(), 0.0, timeout=True)
    tupli_mcap.write_rollout(tmp_path / "b.mcap", steps, steps, np.zeros(6), step_seconds=1 / 50)
    for name in ("a.mcap", "b.mcap"):
        with Recording(tmp_path / name) as recording:
            assert recording.labels.step_seconds == 1 / 50
    around = tupli_mcap.open(tmp_path / "b.mcap").delta_windows({"action": [0, 0.02]}, unit="seconds")
    assert around[0]["action"].shape == (2, 3)
    for wrong in (0, -1.0, float("nan"), "fast", True, 10**400):
        with pytest.raises(RecordingError, match="step_seconds: expected a time above 0, or None, found"):
            EpisodeWriter(tmp_path / "c.mcap", BOX, ACTIONS, step_seconds=wrong)  # type: ignore[arg-type]


def test_metadata_seeds_infos_and_labels_are_kept(tmp_path: Path) -> None:
    path = tmp_path / "r.mcap"
    with EpisodeWriter(path, BOX, ACTIONS, labels={"state": ["x", "y", "z"]}) as writer:
        writer.begin(seed=3, options={"level": 2}, metadata={"operator": "Ann"})
        writer.step(np.zeros(3, np.float32), 1, 1.0, info={"grip": 0.5})
        writer.step(np.ones(3, np.float32), 2, 2.0, True)
        writer.end(np.ones(3, np.float32), metadata={"success": True})
    (episode,) = tupli_mcap.open(path)
    assert (episode.seed, episode.options) == (3, {"level": 2})
    assert episode.metadata == {"operator": "Ann", "success": True}
    assert [dict(info or {}) for info in episode.infos] == [{"grip": 0.5}, {}]
    assert "labels.json" in Recording(path).attachments


def test_metadata_are_those_that_were_given(tmp_path: Path) -> None:
    with EpisodeWriter(tmp_path / "r.mcap", BOX, spaces.Discrete(4)) as writer:
        given: dict[str, Any] = {"words": ["a"]}
        writer.begin(metadata=given)
        given["words"].append(object())
        writer.step(np.zeros(3, np.float32), 1, 0.0, True, False)
        writer.end()
    assert Recording(tmp_path / "r.mcap").episodes[0].metadata == {"words": ["a"]}


def test_many_steps_at_once_are_as_one_after_another(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    states, actions = rng.random((900, 3)).astype(np.float32), rng.integers(0, 9, 900)
    rewards, ends = rng.random(900), np.arange(900) == 899
    with EpisodeWriter(tmp_path / "a.mcap", BOX, ACTIONS, num_envs=2, chunk_size=5000) as writer:
        writer.begin(env=1)
        for i in range(900):
            writer.step(states[i], actions[i], rewards[i], bool(ends[i]), env=1)
        writer.end(states[0], env=1)
    chunk_size: Any = np.int64(5000)
    with EpisodeWriter(tmp_path / "b.mcap", BOX, ACTIONS, num_envs=2, chunk_size=chunk_size) as writer:
        writer.begin(env=1)
        for part in np.array_split(np.arange(900), [1, 2, 300, 310]):
            writer.steps(states[part], actions[part], rewards[part], ends[part], env=1)
            assert len(Recording(tmp_path / "b.mcap").episodes[0]) == part[-1] + 1
        writer.end(states[0], env=1)
    assert same(read(tmp_path / "a.mcap"), read(tmp_path / "b.mcap"))
    assert verify_recording(tmp_path / "b.mcap").problems == []


KEPT = {  # spaces and options, by how steps are kept
    "rows": (BOX, {}),
    "rows of several leaves": (spaces.Dict({"x": BOX, "n": spaces.Discrete(4)}), {}),
    "sealed rows": (BOX, {"durability": "step"}),
    "images": (CAMERA, {}),
    "logs": (TEXT, {}),
}


def batch(space: spaces.Space[Any], n: int) -> tuple[Any, Any, Any]:
    """States, actions and rewards of `n` steps."""
    states = [space.sample() for _ in range(n)]
    if isinstance(space, spaces.Dict):
        columns: Any = {key: [state[key] for state in states] for key in space}
        return (
            {key: rows if key == "note" else np.stack(rows) for key, rows in columns.items()},
            np.arange(n),
            np.arange(n) / 2,
        )
    return np.stack(states), np.arange(n), np.arange(n) / 2


@pytest.mark.parametrize("infos", [False, True])
@pytest.mark.parametrize("is_first", [True, False])
@pytest.mark.parametrize("kind", KEPT)
def test_steps_that_are_refused_leave_nothing(tmp_path: Path, kind: str, is_first: bool, infos: bool) -> None:
    space, options = KEPT[kind]
    states, actions, rewards = batch(space, 3)
    longer, _, _ = batch(space, 4)
    info = [{"n": i} for i in range(3)]
    strange = {**states, "more": rewards} if isinstance(states, dict) else states.astype(np.complex64)
    refused: list[tuple[tuple[Any, ...], str]] = [
        ((states, actions[:2], rewards), "actions: expected one for each of 3 steps, found 2"),
        ((states, np.arange(4), rewards), "actions: expected one for each of 3 steps, found 4"),
        ((longer, actions, rewards), "states: expected one for each of 3 steps, found 4"),
        ((batch(space, 2)[0], actions, rewards), "states: expected one for each of 3 steps, found 2"),
        ((states, 4, rewards), "actions: expected an array of 3 entries, found 4"),
        ((states, actions, 0.5), "rewards: expected an array of one for each step, found 0.5"),
        ((states, [0, 1, "left"], rewards), "action"),
        ((states, actions, [0.0, 0.5, "much"]), "reward"),
        ((strange, actions, rewards), "state"),
    ]
    with EpisodeWriter(tmp_path / "r.mcap", space, ACTIONS, **options) as writer:
        writer.begin()
        if not is_first:
            writer.steps(states, actions, rewards)
        for arguments, match in refused:
            with pytest.raises(StepError, match=match):
                writer.steps(*arguments, infos=info if infos else None)
        if infos:
            with pytest.raises(StepError, match="infos: expected one for each of 3 steps, found 2"):
                writer.steps(states, actions, rewards, infos=info[:2])
        writer.steps(states, actions, rewards, infos=info if infos else None)
        writer.end()
    (episode,) = Recording(tmp_path / "r.mcap").episodes
    assert episode.rewards.tolist() == [0, 0.5, 1] * (1 if is_first else 2)
    assert episode.return_ == episode.rewards.sum()
    assert same(
        episode[-1].state, {k: v[2] for k, v in states.items()} if isinstance(states, dict) else states[2]
    )
    if infos:
        assert [step.info for step in episode][-3:] == info
    assert verify_recording(tmp_path / "r.mcap").problems == []


@pytest.mark.parametrize("kind", KEPT)
def test_episodes_that_are_refused_leave_nothing(tmp_path: Path, kind: str) -> None:
    space, options = KEPT[kind]
    states, actions, rewards = batch(space, 5)
    ends, never = [0, 1, 0, 0, 1], [0] * 5
    (finals, _, _), (more, _, _), (fewer, _, _) = (batch(space, n) for n in (2, 3, 1))
    strange = {**finals, "x": np.full((2, 3), "a")} if isinstance(finals, dict) else [["a"] * 3] * 2
    with EpisodeWriter(tmp_path / "r.mcap", space, ACTIONS, **options) as writer:
        for given, match in (
            (more, "final_states: expected one for each of 2 episodes, found 3"),
            (fewer, "final_states: expected one for each of 2 episodes, found 1"),
            (strange, "state"),
        ):
            with pytest.raises(StepError, match=match):
                writer.episodes(states, actions, rewards, ends, never, given)
        with pytest.raises(StepError, match="rewards: expected an array of one for each step, found None"):
            writer.episodes(states, actions, None, ends, never)
        with pytest.raises(StepError, match="actions: expected one for each of 5 steps, found 4"):
            writer.episodes(states, actions[:4], rewards, ends, never, finals)
        with pytest.raises(StepError, match="action"):
            writer.episodes(states, ["left", *actions[1:]], rewards, ends, never, finals)
        writer.episodes(states, actions, rewards, ends, never, finals)
    found = Recording(tmp_path / "r.mcap").episodes
    assert [(len(episode), episode.end) for episode in found] == [(2, "terminal"), (3, "terminal")]
    assert all(episode.final_state is not None for episode in found)
    assert verify_recording(tmp_path / "r.mcap").problems == []


def test_a_discarded_episode_leaves_nothing(tmp_path: Path) -> None:
    path, state = tmp_path / "r.mcap", np.zeros(3, np.float32)
    with EpisodeWriter(path, BOX, ACTIONS) as writer:
        writer.begin()
        writer.step(state, 1, 1.0)
        writer.discard()
    assert list(tmp_path.iterdir()) == []
    with EpisodeWriter(path, BOX, ACTIONS) as writer:
        writer.begin()
        writer.step(state, 1, 1.0)
        writer.end()
    with EpisodeWriter(path, BOX, ACTIONS, mode="a") as writer:
        writer.begin()
        writer.discard()  # before its first step
        for reward in (2.0, 3.0):
            writer.begin()
            writer.step(state, 1, reward)
            writer.discard() if reward == 2 else writer.end()
    assert [told.steps[0][2] for told in read(path)] == [1.0, 3.0]


def test_what_is_called_out_of_turn_is_refused(tmp_path: Path) -> None:
    state = np.zeros(3, np.float32)
    with EpisodeWriter(tmp_path / "r.mcap", BOX, ACTIONS, num_envs=2) as writer:
        with pytest.raises(StepError, match=r"no episode is running in stream 0; call begin\(\) first"):
            writer.step(state, 1, 1.0)
        with pytest.raises(StepError, match="no episode is running in stream 1"):
            writer.end(env=1)
        with pytest.raises(StepError, match="no episode is running in stream 1"):
            writer.discard(env=1)
        with pytest.raises(StepError, match="env: expected a stream from 0 to 1, found 2"):
            writer.begin(env=2)
        writer.begin()
        with pytest.raises(
            StepError, match=r"an episode is running in stream 0; call end\(\) or discard\(\) first"
        ):
            writer.begin()
        with pytest.raises(StepError, match=r"state: expected .*found"):
            writer.step(np.zeros(4, np.float32), 1, 1.0)
        with pytest.raises(StepError, match="terminal"):
            writer.step(state, 1, 1.0, "yes")  # type: ignore[arg-type]
        writer.step(state, 1, 1.0)
        with pytest.raises(StepError, match="action"):
            writer.step(state, "left", 1.0)
        with pytest.raises(StepError, match="state"):
            writer.end("over")
        with pytest.raises(RecordingError, match="info: expected a dict"):
            writer.step(state, 1, 1.0, info=[1])  # type: ignore[arg-type]
        writer.step(state, 1, 2.0, timeout=True)
        with pytest.raises(StepError, match="the step before has ended the episode in stream 0; call begin"):
            writer.step(state, 1, 1.0)
        with pytest.raises(RecordingError, match="metadata"):
            writer.begin(metadata={"x": object()})
        writer.begin()
    (told,) = read(tmp_path / "r.mcap")
    assert [step[2] for step in told.steps] == [1.0, 2.0]
    with pytest.raises(RecordingError, match="is closed"):
        writer.begin()
    for number in (0, 10**30):
        with pytest.raises(RecordingError, match=f"num_envs: expected .* 1 to 65000 or None, found {number}"):
            EpisodeWriter(tmp_path / "s.mcap", BOX, ACTIONS, num_envs=number)
    with pytest.raises(StepError, match="pass num_envs for several streams"):
        EpisodeWriter(tmp_path / "s.mcap", BOX, ACTIONS).begin(env=1)
    with pytest.raises(SpaceError, match="records a vector environment of 2, found a single environment"):
        EpisodeWriter(tmp_path / "r.mcap", BOX, ACTIONS, mode="a")


def test_a_full_file_is_followed_by_another(tmp_path: Path) -> None:
    state = np.zeros(3, np.float32)
    with EpisodeWriter(tmp_path / "r.mcap", BOX, ACTIONS, max_bytes=2000, chunk_size=500) as writer:
        for i in range(20):
            writer.begin()
            for _ in range(50):
                writer.step(state, i % 9, float(i))
            writer.discard() if i == 3 else writer.end(state)
    assert len(writer.paths) > 2
    assert [e.actions[0] for e in tupli_mcap.open(tmp_path)] == [i % 9 for i in range(20) if i != 3]


def test_an_environment_goes_on_in_the_file_of_a_writer(tmp_path: Path) -> None:
    import gymnasium as gym

    path, env = tmp_path / "r.mcap", gym.make("CartPole-v1")
    with EpisodeWriter(path, env.observation_space, env.action_space) as writer:
        writer.begin()
        writer.step(np.zeros(4, np.float32), 1, 1.0)
    wrapped = RecordEpisodes(env, path, mode="a")
    wrapped.reset(seed=1)
    wrapped.step(0)
    wrapped.close()
    assert [len(told.steps) for told in read(path)] == [1, 1]
    assert verify_recording(path).problems == []


def test_what_is_dropped_is_finished(tmp_path: Path) -> None:
    writer = EpisodeWriter(tmp_path / "r.mcap", BOX, ACTIONS)
    writer.begin()
    writer.step(np.zeros(3, np.float32), 1, 1.0)
    with pytest.raises(RecordingError, match="cannot be pickled or copied"):
        copy.copy(writer)
    del writer
    gc.collect()
    assert Recording(tmp_path / "r.mcap").complete


def test_what_was_discarded_goes_where_the_recording_is(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    writer = EpisodeWriter("r.mcap", BOX, ACTIONS)
    for number in range(2):
        writer.begin(seed=number)
        writer.step(np.zeros(3, np.float32), 0, 0.0)
        writer.discard() if number == 0 else writer.end()
    (tmp_path / "elsewhere").mkdir()
    monkeypatch.chdir(tmp_path / "elsewhere")
    writer.close()
    assert [episode.seed for episode in Recording(tmp_path / "r.mcap").episodes] == [1]


def test_the_info_of_the_last_step_says_whether_it_succeeded(tmp_path: Path) -> None:
    space = spaces.Discrete(2)
    said: dict[str, Any] = {"is_success": True}
    with EpisodeWriter(tmp_path / "r.mcap", space, space) as writer:
        for infos, metadata, ended in (
            ([{}, said], {"k": 1}, True),
            ([said, {}], {}, True),  # not of the last step
            ([{}, said], {"success": False}, True),
            ([{}, said], {}, False),  # interrupted
        ):
            writer.begin(metadata=metadata)
            for i, info in enumerate(infos):
                writer.step(0, 0, 0.0, terminal=ended and i == 1, info=info)
            writer.end()
    found = [episode.metadata for episode in tupli_mcap.open(tmp_path / "r.mcap")]
    assert found == [{"k": 1, "success": True}, {}, {"success": False}, {}]
    arrays = [np.zeros((2, 1))], [np.zeros((2, 1))], [np.zeros(2)], [True]
    tupli_mcap.write_rollout(tmp_path / "w.mcap", *arrays, infos=[{"is_success": np.array([False, True])}])
    assert tupli_mcap.open(tmp_path / "w.mcap")[0].metadata == {"success": True}


@pytest.mark.parametrize("other", [0, 1, 3])
def test_a_renamed_file_keeps_what_was_discarded_and_no_other_file_loses_anything(
    tmp_path: Path, other: int
) -> None:
    path, moved = tmp_path / "a.mcap", tmp_path / "b.mcap"

    def record(count: int, discarded: int) -> EpisodeWriter:
        writer = EpisodeWriter(path, BOX, ACTIONS)
        for number in range(count):
            writer.begin()
            writer.step(BOX.sample(), 1, float(number))
            writer.discard() if number == discarded else writer.end()
        return writer

    writer = record(2, discarded=0)
    path.rename(moved)
    journal_path(path).rename(journal_path(moved))
    if other:
        record(other, discarded=-1).close()
    with pytest.warns(UserWarning, match=r"a\.mcap was renamed or deleted .*\(1 episode\)"):
        writer.close()
    with Recording(moved) as recording:
        assert [episode.metadata for episode in recording.episodes] == [{"discarded": True}, {}]
    if other:
        assert tupli_mcap.open(path).returns.tolist() == [float(number) for number in range(other)]
