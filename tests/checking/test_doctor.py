"""The doctor: each check on a recording that has the defect and on one that has not; healthy data stays quiet."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from environments import Sampler, Scripted, roll
from gymnasium import spaces
from mcap.reader import make_reader
from mcap.writer import Writer
from typer.testing import CliRunner

from tupli_mcap import (
    EpisodeData,
    F,
    FileStorage,
    RecordEpisodes,
    Recording,
    RecordingError,
    TupliDataset,
    TupliEnvWrapper,
    merge_recordings,
    rewrite_recording,
    vector,
    write_recording,
)
from tupli_mcap.cli import app
from tupli_mcap.doctor import CHECKS, Diagnosis, Finding, Place, Severity, examine
from tupli_mcap.doctor.steps import Largest, Sample
from tupli_mcap.recording.blocks import BLOCK_BYTES, blocks
from tupli_mcap.wrappers.rollout import record_rollouts

ERROR, WARNING, INFO = Severity.ERROR, Severity.WARNING, Severity.INFO
UNIT = spaces.Box(-1, 1, (3,), np.float32)
FRAME = np.full((2, 2, 3), 99, np.uint8)
Observe = Callable[[int], Any]


def still(n: int) -> Any:
    return np.float32([np.sin(n), np.cos(n), np.sin(2 * n)])


def record(path: Path, env: gym.Env[Any, Any], steps: int, seed: int = 1) -> Path:
    with RecordEpisodes(env, path) as recorded:
        roll(recorded, steps, seed)
    return path


def scripted(
    path: Path,
    observe: Observe = still,
    space: gym.Space[Any] = UNIT,
    *,
    episodes: int = 3,
    length: int = 10,
    act: Callable[[int], Any] = lambda n: n % 3,
    actions: gym.Space[Any] | None = None,
    reward: Callable[[int], Any] = lambda n: float(n),
) -> Path:
    """Episodes of an environment whose observations, actions and rewards are functions of the step."""
    env = Scripted(observe, space, actions, reward=reward, length=length)
    with RecordEpisodes(env, path) as recorded:
        for _ in range(episodes):
            recorded.reset()
            for n in range(length):
                recorded.step(act(n))
    return path


def by_hand(path: Path, episodes: list[dict[str, Any]]) -> Path:
    """Episodes of an environment with 3 actions; each is given by its length and by what differs."""
    made = []
    for i, facts in enumerate(episodes):
        facts = dict(facts)
        n = facts.pop("length", 4)
        states = [still(100 * i + j) for j in range(n)]
        made.append(
            EpisodeData(
                states,
                facts.pop("actions", [j % 3 for j in range(n)]),
                facts.pop("rewards", [float(j) for j in range(n)]),
                facts.pop("terminals", [j == n - 1 for j in range(n)]),
                facts.pop("timeouts", [False] * n),
                final_state=facts.pop("final_state", still(0)),
                **facts,
            )
        )
    write_recording(path, made, observation_space=UNIT, action_space=spaces.Discrete(3))
    return path


def found(diagnosis: Diagnosis, check: str) -> Finding:
    """The one finding of a check."""
    (finding,) = diagnosis.of(check)
    return finding


def places(finding: Finding) -> list[tuple[int, int | None]]:
    return [(place.episode, place.step) for place in finding.places]


# --- healthy data ---


@pytest.mark.parametrize(
    ("env_id", "steps", "expected"),
    [
        ("CartPole-v1", 3000, set()),
        ("Pendulum-v1", 1000, {"missing-terminals"}),
        ("MountainCar-v0", 1000, {"missing-terminals"}),
        ("MountainCarContinuous-v0", 1998, {"missing-terminals"}),
        ("Acrobot-v1", 1200, {"missing-terminals"}),
        ("FrozenLake-v1", 3000, set()),
        ("CliffWalking-v1", 2000, set()),
        ("Taxi-v4", 2000, {"missing-terminals"}),
        ("Blackjack-v1", 1000, set()),
    ],
)
def test_healthy_environments(tmp_path: Path, env_id: str, steps: int, expected: set[str]) -> None:
    record_rollouts(env_id, tmp_path / "a.mcap", steps=steps, seed=1)
    diagnosis = examine(tmp_path / "a.mcap")
    assert diagnosis.at_least(WARNING) == ()
    usual = {"clock-jump"}  # how busy the machine is
    assert {finding.check for finding in diagnosis.findings} - usual == expected
    assert (diagnosis.files, diagnosis.steps) == (1, steps)
    assert diagnosis.healthy


@pytest.mark.parametrize(
    "space",
    [
        spaces.Box(0, 255, (12, 10, 3), np.uint8),
        spaces.Dict({"note": spaces.Text(8), "x": spaces.Box(-1, 1, (2,))}),
        spaces.Dict({"a": spaces.MultiBinary(4), "b": spaces.Tuple((spaces.MultiDiscrete([3, 4]),))}),
        spaces.Sequence(spaces.Box(-1, 1, (2,))),
        spaces.Graph(spaces.Box(-1, 1, (2,)), spaces.Discrete(3)),
        spaces.OneOf((spaces.Discrete(3), spaces.Box(-1, 1, (2,)))),
        spaces.Box(-1, 1, (0,)),
        spaces.Box(-1, 1, (3,), np.float16),
        spaces.Box(-np.inf, np.inf, (), np.float64),
    ],
    ids=["image", "text", "bits", "sequence", "graph", "oneof", "empty", "half", "scalar"],
)
def test_healthy_spaces(tmp_path: Path, space: gym.Space[Any]) -> None:
    diagnosis = examine(record(tmp_path / "a.mcap", Sampler(space, spaces.Discrete(3)), 210))
    assert diagnosis.at_least(WARNING) == ()
    assert diagnosis.episodes == 30


def test_healthy_vector_recording(tmp_path: Path) -> None:
    record_rollouts("CartPole-v1", tmp_path / "a.mcap", steps=3000, seed=1, num_envs=4)
    assert examine(tmp_path / "a.mcap").at_least(WARNING) == ()


# --- values ---


@pytest.mark.parametrize(
    ("check", "value", "words"), [("nan", np.nan, "NaN"), ("infinity", -np.inf, "infinite")]
)
@pytest.mark.parametrize("dtype", [np.float16, np.float32, np.float64])
def test_not_finite(tmp_path: Path, check: str, value: float, words: str, dtype: Any) -> None:
    def observe(n: int) -> Any:
        state = np.zeros((2, 3), dtype) + dtype(n / 16)
        if n in (4, 10):  # in mid-episode, and the final state
            state[1, 2] = value
        return {"arm": state}

    space = spaces.Dict({"arm": spaces.Box(-np.inf, np.inf, (2, 3), dtype)})
    diagnosis = examine(scripted(tmp_path / "a.mcap", observe, space))
    finding = found(diagnosis, check)
    assert (finding.severity, finding.leaf, finding.dimensions) == (ERROR, "state.arm", ((1, 2),))
    assert (finding.count, finding.total) == (6, 3 * 11 * 6)
    assert places(finding) == [(0, 4), (1, 4), (2, 4), (0, 10), (1, 10)]
    assert f"6 of 198 values are {words} in state.arm[1,2]" == finding.message
    assert diagnosis.worst is ERROR and not diagnosis.healthy
    assert {other.check for other in diagnosis.at_least(WARNING)} == {check, "duplicate-episodes"}


def test_not_finite_rewards_and_actions(tmp_path: Path) -> None:
    path = scripted(
        tmp_path / "a.mcap",
        actions=spaces.Box(-np.inf, np.inf, (2,), np.float64),
        act=lambda n: np.array([n, np.inf if n == 3 else 0.5 * n]),
        reward=lambda n: np.nan if n == 1 else float(n),
        episodes=2,
    )
    diagnosis = examine(path)
    reward, action = found(diagnosis, "nan"), found(diagnosis, "infinity")
    assert (reward.leaf, reward.count, reward.total, places(reward)) == ("reward", 2, 20, [(0, 0), (1, 0)])
    assert reward.dimensions == ()
    assert (action.leaf, action.dimensions, places(action)) == ("action", ((1,),), [(0, 3), (1, 3)])


def test_not_finite_in_values_of_variable_size(tmp_path: Path) -> None:
    space = spaces.Dict({"points": spaces.Sequence(spaces.Box(-9, 9, (2,)))})

    def observe(n: int) -> Any:
        point = np.float32([n / 10, np.nan if n == 2 else 0])
        return {"points": (point,) * (n % 3)}

    finding = found(examine(scripted(tmp_path / "a.mcap", observe, space)), "nan")
    assert (finding.leaf, finding.count, finding.total) == ("state.points", 3, 33)
    assert places(finding) == [(0, 2), (1, 2), (2, 2)]


@pytest.mark.parametrize(
    ("space", "bad", "good", "severity"),
    [
        (spaces.Box(-1, 1, (2,), np.float32), np.float32([0, 1.5]), np.float32([1, -1]), WARNING),
        (spaces.Box(0, 9, (2,), np.int32), np.int32([3, -1]), np.int32([0, 9]), WARNING),
        (spaces.Box(0, 99, (2, 2, 3), np.uint8), FRAME + 1, FRAME, WARNING),
        (spaces.Discrete(4, start=-1), np.int64(3), np.int64(2), ERROR),
        (spaces.Discrete(5, start=2**62), np.int64(2**62 + 5), np.int64(2**62 + 4), ERROR),
        (spaces.MultiDiscrete([2, 3]), np.array([1, 3]), np.array([1, 2]), ERROR),
        (spaces.MultiBinary(2), np.int8([2, 0]), np.int8([1, 0]), ERROR),
        (spaces.Text(3, charset="ab"), "abc", "ab", WARNING),
        (spaces.Text(3, charset="ab"), "aaaa", "aaa", WARNING),
        (spaces.Sequence(spaces.Discrete(2)), (1, 2), (1, 1), ERROR),
        (spaces.OneOf((spaces.Discrete(2), spaces.Discrete(3))), (0, 2), (1, 2), ERROR),
    ],
)  # fmt: skip
def test_outside_of_the_space(
    tmp_path: Path, space: gym.Space[Any], bad: Any, good: Any, severity: Severity
) -> None:
    path = scripted(tmp_path / "bad.mcap", lambda n: bad if n == 6 else good, space)
    finding = found(examine(path), "outside-space")
    assert (finding.severity, finding.leaf) == (severity, "state")
    assert places(finding) == [(0, 6), (1, 6), (2, 6)]
    size = 12 if space.shape == (2, 2, 3) else 1
    assert finding.count == 3 * size
    good_path = scripted(tmp_path / "good.mcap", lambda n: good, space)
    assert examine(good_path).of("outside-space") == ()


def test_the_letters_of_a_space_are_counted(tmp_path: Path) -> None:
    path = scripted(tmp_path / "bad.mcap", lambda n: "äa", spaces.Text(10, min_length=0))
    finding = found(examine(path), "outside-space")
    assert "outside of Text(0..10, 62 characters)" in finding.message
    assert "charset=string.printable" in finding.suggestion


def test_choices_beyond_all_integers(tmp_path: Path) -> None:
    huge = spaces.Discrete(2**62 + 5, start=2**62)
    path = scripted(
        tmp_path / "a.mcap", lambda n: np.int64(2**62 + n), huge, act=lambda n: 2**62, actions=huge
    )
    assert {finding.check for finding in examine(path).findings} == {"duplicate-episodes"}


def test_rounding_errors_at_a_bound_are_no_finding(tmp_path: Path) -> None:
    almost = np.nextafter(np.float32([1, 1, 1]), np.float32(2))
    assert examine(scripted(tmp_path / "a.mcap", lambda n: almost)).of("outside-space") == ()
    over = np.float32([1, 1, 1.0001])
    finding = found(examine(scripted(tmp_path / "b.mcap", lambda n: over)), "outside-space")
    assert (finding.severity, finding.count, finding.dimensions) == (WARNING, 33, ((2,),))


def test_actions_outside_of_their_box(tmp_path: Path) -> None:
    path = scripted(
        tmp_path / "a.mcap",
        actions=spaces.Box(-1, 1, (1,), np.float32),
        act=lambda n: np.float32([n / 4 - 1]),
    )
    finding = found(examine(path), "outside-space")
    assert (finding.severity, finding.leaf, finding.count) == (WARNING, "action", 3)
    assert "clip" in finding.suggestion and "reach from -1 to 1.25" in finding.message


# --- what varies ---


def test_constant_dimensions(tmp_path: Path) -> None:
    def observe(n: int) -> Any:
        return np.float32([0.5, np.sin(n), np.cos(n)])

    path = scripted(tmp_path / "a.mcap", observe, episodes=10)
    finding = found(examine(path), "constant-dimension")
    assert (finding.severity, finding.leaf, finding.dimensions) == (WARNING, "state", ((0,),))
    assert finding.message == "state[0] is always 0.5 in 110 values"
    assert examine(path, thresholds={"constant-dimension": {"min_steps": 101}}).of("constant-dimension") == ()
    assert examine(scripted(tmp_path / "b.mcap", episodes=10)).of("constant-dimension") == ()


@pytest.mark.parametrize(
    ("space", "value", "message"),
    [
        (spaces.Discrete(4), 2, "all 110 values are the same"),
        (
            spaces.Box(0, 255, (4, 4, 3), np.uint8),
            np.ones((4, 4, 3), np.uint8),
            "all 110 frames are the same",
        ),
        (spaces.Box(-1, 1, (2,)), np.float32([0, 1]), "all 110 values are the same"),
        (spaces.Text(3), "abc", "all 110 values are the same"),
    ],
)
def test_a_leaf_that_never_changes(tmp_path: Path, space: gym.Space[Any], value: Any, message: str) -> None:
    diagnosis = examine(scripted(tmp_path / "a.mcap", lambda n: value, space, episodes=10))
    finding = found(diagnosis, "constant-dimension")
    assert (finding.severity, finding.message, finding.dimensions) == (WARNING, message, ())


def test_constant_integers_among_others_are_no_warning(tmp_path: Path) -> None:
    space = spaces.Box(0, 255, (8,), np.uint8)
    path = scripted(tmp_path / "a.mcap", lambda n: np.uint8([n, 7, 7, 7, 7, 7, 7, n]), space, episodes=10)
    finding = found(examine(path), "constant-dimension")
    assert (finding.severity, finding.count, finding.total) == (INFO, 6, 8)
    assert finding.message == (
        "6 of 8 dimensions (state[1], state[2], state[3], state[4], ...) never change in 110 values"
    )


def test_a_dimension_of_one_value_is_as_declared(tmp_path: Path) -> None:
    space = spaces.Box(np.float32([0, -1]), np.float32([0, 1]))
    path = scripted(tmp_path / "a.mcap", lambda n: np.float32([0, np.sin(n)]), space, episodes=10)
    assert examine(path).of("constant-dimension") == ()


@pytest.mark.parametrize("axis", [0, -1])
def test_a_background_of_stacked_frames_is_no_defect(tmp_path: Path, axis: int) -> None:
    def observe(n: int) -> Any:
        return np.uint8([[0, 1], [2, n]])

    screen = Scripted(observe, spaces.Box(0, 255, (2, 2), np.uint8), length=50)
    stack = gym.wrappers.FrameStackObservation(screen, 4)
    space = spaces.Box(0, 255, (2, 2, 4) if axis else (4, 2, 2), np.uint8)
    moved = gym.wrappers.TransformObservation(stack, lambda frames: np.moveaxis(frames, 0, axis), space)
    assert examine(record(tmp_path / "a.mcap", moved, 150)).of("constant-dimension") == ()


@pytest.mark.parametrize("block_bytes", [1, 700, 8 << 20], ids=["single steps", "parts", "whole"])
def test_frozen_frames(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, block_bytes: int) -> None:
    space = spaces.Box(0, 255, (2, 2, 3), np.uint8)

    def observe(n: int) -> Any:
        return np.full((2, 2, 3), n if n < 15 or n > 44 else 15, np.uint8)  # 15 to 44: 30 frames

    path = scripted(tmp_path / "a.mcap", observe, space, length=60)
    monkeypatch.setattr("tupli_mcap.recording.blocks.BLOCK_BYTES", block_bytes)
    finding = found(examine(path), "frozen-frames")
    assert (finding.severity, finding.leaf, finding.count) == (WARNING, "state", 3 * 29)
    assert places(finding) == [(0, 16)]
    assert finding.message == "30 frames in a row are equal; 48% of all frames repeat the one before"
    assert examine(path, thresholds={"frozen-frames": {"frames": 31}}).of("frozen-frames") == ()


@pytest.mark.parametrize("block_bytes", [1, 8 << 20], ids=["single steps", "whole"])
@pytest.mark.parametrize("frame_format", ["png", "jpeg"])
def test_frozen_recorded_frames(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, frame_format: Any, block_bytes: int
) -> None:
    class Filmed(Scripted):
        metadata = {"render_modes": ["rgb_array"]}
        render_mode = "rgb_array"

        def render(self) -> Any:
            shown = self._step if self._step < 15 or self._step > 44 else 15
            return np.full((8, 8, 3), 4 * shown, np.uint8)

    path = tmp_path / "a.mcap"
    with RecordEpisodes(
        Filmed(still, UNIT, length=60), path, frames=True, frame_format=frame_format
    ) as recorded:
        roll(recorded, 120)
    monkeypatch.setattr("tupli_mcap.recording.blocks.BLOCK_BYTES", block_bytes)
    finding = found(examine(path), "frozen-frames")
    assert (finding.severity, finding.leaf, finding.count, finding.total) == (
        WARNING, "camera 'render'", 2 * 29, 2 * 61
    )  # fmt: skip
    assert places(finding) == [(0, 16)]
    assert finding.message == "30 frames in a row are equal; 48% of all frames repeat the one before"
    assert examine(path, thresholds={"frozen-frames": {"frames": 31}}).of("frozen-frames") == ()


# --- episodes ---


def test_one_step_episodes_stand_out(tmp_path: Path) -> None:
    path = by_hand(tmp_path / "a.mcap", [{"length": 1 if i in (2, 5) else 12} for i in range(20)])
    finding = found(examine(path), "one-step-episodes")
    assert (finding.severity, finding.count, finding.total) == (WARNING, 2, 20)
    assert places(finding) == [(2, None), (5, None)]
    short = by_hand(tmp_path / "b.mcap", [{"length": 1 + i % 3} for i in range(20)])
    assert examine(short).of("one-step-episodes") == ()


def test_one_step_at_the_end_of_a_recording_is_no_episode_of_one_step(tmp_path: Path) -> None:
    path = by_hand(tmp_path / "a.mcap", [{"length": 12}, {"length": 1, "terminals": [False]}])
    assert examine(path).of("one-step-episodes") == ()


def test_episodes_without_any_end(tmp_path: Path) -> None:
    never = {"terminals": [False] * 4}
    finding = found(examine(by_hand(tmp_path / "a.mcap", [never] * 5)), "missing-terminals")
    assert (finding.severity, finding.count) == (WARNING, 5)
    assert finding.message == "none of 5 episodes ends in a terminal state: all are interrupted"
    assert places(finding) == [(0, None), (1, None), (2, None), (3, None), (4, None)]
    timeouts = {**never, "timeouts": [False, False, False, True]}
    finding = found(examine(by_hand(tmp_path / "b.mcap", [timeouts] * 5)), "missing-terminals")
    assert (finding.severity, finding.message[-12:]) == (INFO, "5 by timeout")
    assert examine(by_hand(tmp_path / "c.mcap", [{}, timeouts])).of("missing-terminals") == ()
    assert examine(by_hand(tmp_path / "d.mcap", [never])).of("missing-terminals") == ()


@pytest.mark.parametrize("lengths", [(120,), (30, 1)])
def test_each_run_may_end_with_an_interrupted_episode(tmp_path: Path, lengths: tuple[int, ...]) -> None:
    """As in recordings of several runs that were merged."""
    runs = [tmp_path / f"{i}.mcap" for i in range(4)]
    for path in runs:
        with RecordEpisodes(
            gym.make("MountainCar-v0", max_episode_steps=150 if len(lengths) == 1 else 30), path
        ) as env:
            for length in lengths:
                env.reset()
                for _ in range(length):
                    env.step(env.action_space.sample())
    assert examine(runs).at_least(WARNING) == ()
    merge_recordings(runs, tmp_path / "merged.mcap")
    assert examine(tmp_path / "merged.mcap").at_least(WARNING) == ()


class EarlyReset(gym.Wrapper[Any, Any, Any, Any]):
    """Resets by itself, and gives the fresh observation with the last reward, as same-step autoreset does."""

    def step(self, action: Any) -> Any:
        state, reward, terminal, timeout, info = self.env.step(action)
        if terminal or timeout:
            state, _ = self.env.reset()
        self.fresh = state
        return state, reward, terminal, timeout, info

    def reset(self, **_: Any) -> Any:
        return (self.fresh if hasattr(self, "fresh") else self.env.reset()[0]), {}


@pytest.mark.parametrize("block_bytes", [1, 8 << 20])
@pytest.mark.parametrize(
    "space", [UNIT, spaces.Dict({"a": UNIT, "b": spaces.Text(9)})], ids=["array", "text"]
)
def test_final_states_of_the_next_episode(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, space: gym.Space[Any], block_bytes: int
) -> None:
    monkeypatch.setattr("tupli_mcap.recording.blocks.BLOCK_BYTES", block_bytes)
    bad = record(tmp_path / "bad.mcap", EarlyReset(Sampler(space, spaces.Discrete(3))), 70)
    finding = found(examine(bad), "final-state-is-reset")
    assert (finding.severity, finding.count, finding.total) == (WARNING, 9, 9)
    assert places(finding) == [(i, 7) for i in range(5)]
    good = record(tmp_path / "good.mcap", Sampler(space, spaces.Discrete(3)), 70)
    assert examine(good).of("final-state-is-reset") == ()


def test_final_states_of_episodes_that_all_start_alike_may_be_chance(tmp_path: Path) -> None:
    path = scripted(tmp_path / "a.mcap", lambda n: still(n % 10), episodes=5)
    assert examine(path).of("final-state-is-reset") == ()


def test_stepping_on_without_a_reset(tmp_path: Path) -> None:
    with RecordEpisodes(Scripted(still, UNIT, length=4), tmp_path / "a.mcap") as env:
        for _ in range(3):
            env.reset()
            for _ in range(5):
                env.step(0)
    finding = found(examine(tmp_path / "a.mcap"), "missing-reset")
    assert (finding.severity, finding.count, finding.total) == (WARNING, 3, 6)
    assert places(finding) == [(1, None), (3, None), (5, None)]
    assert examine(tmp_path / "a.mcap").of("final-state-is-reset") == ()
    assert examine(scripted(tmp_path / "b.mcap")).of("missing-reset") == ()


# --- copies ---


def test_duplicate_episodes_across_recordings(tmp_path: Path) -> None:
    first = record(tmp_path / "a.mcap", gym.make("CartPole-v1"), 200, seed=1)
    second = record(tmp_path / "b.mcap", gym.make("CartPole-v1"), 60, seed=1)
    third = record(tmp_path / "c.mcap", gym.make("CartPole-v1"), 60, seed=2)
    with Recording(second) as recording:
        whole = int((recording.index["end"] != 2).sum())
    diagnosis = examine([first, second, third])
    finding = found(diagnosis, "duplicate-episodes")
    assert (finding.severity, finding.count, finding.total) == (WARNING, whole, diagnosis.episodes)
    assert finding.places == (Place(str(first), 0), Place(str(second), 0))
    assert f"{whole} of them across recordings" in finding.message
    assert examine([first, third]).of("duplicate-episodes") == ()


@pytest.mark.parametrize(
    ("space", "observe", "by_chance"),
    [
        (spaces.Discrete(4), lambda n: n % 4, True),
        (spaces.Box(0, 9, (2,), np.int64), lambda n: np.array([n % 4, 0]), True),
        (UNIT, still, False),
        (spaces.Tuple((spaces.Discrete(4), UNIT)), lambda n: (n % 4, still(n)), False),
        (spaces.Text(1), lambda n: "abcd"[n % 4], False),
        (spaces.Sequence(UNIT), lambda n: (still(n),), False),
    ],
    ids=["discrete", "integers", "floats", "tuple", "text", "sequence of floats"],
)
def test_duplicates_by_chance_are_no_finding(
    tmp_path: Path, space: gym.Space[Any], observe: Observe, by_chance: bool
) -> None:
    for length in (5, 60):
        path = scripted(tmp_path / f"{length}.mcap", observe, space, length=length)
        if length == 5 and by_chance:
            assert examine(path).of("duplicate-episodes") == ()
            continue
        finding = found(examine(path), "duplicate-episodes")
        assert (finding.severity, finding.count, finding.total) == (WARNING, 2, 3)
        assert places(finding) == [(0, None), (1, None), (2, None)]


def test_episodes_that_differ_in_a_text_are_no_duplicates(tmp_path: Path) -> None:
    texts = iter(range(1000))
    path = scripted(tmp_path / "a.mcap", lambda n: str(next(texts)), spaces.Text(4))
    assert examine(path).of("duplicate-episodes") == ()


@pytest.mark.parametrize("block_bytes", [1, 500, 20_000])
@pytest.mark.parametrize("variable", [False, True], ids=["constant", "variable"])
def test_findings_do_not_depend_on_blocks(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, block_bytes: int, variable: bool
) -> None:
    parts = {"x": UNIT, "cam": spaces.Box(0, 255, (2, 2, 3), np.uint8)}
    space = spaces.Dict({**parts, **({"note": spaces.Text(4)} if variable else {})})
    clock = Clock(monkeypatch)

    def observe(n: int) -> Any:
        clock.now += 5 * 10**9 if n == 70 else 10**6
        state = still(n) if n != 33 else np.float32([0, np.nan, 2])
        frame = np.full((2, 2, 3), n if n < 40 else 40, np.uint8)
        return {"x": state, "cam": frame, **({"note": "abc"[n % 3]} if variable else {})}

    def reward(n: int) -> float:
        return 1e7 if n == 21 else float(n % 5)

    path = scripted(tmp_path / "a.mcap", observe, space, length=80, reward=reward)
    whole = examine(path)
    expected = {
        "nan",
        "outside-space",
        "frozen-frames",
        "reward-outliers",
        "duplicate-episodes",
        "clock-jump",
    }
    assert expected <= {finding.check for finding in whole.findings}
    monkeypatch.setattr("tupli_mcap.recording.blocks.BLOCK_BYTES", block_bytes)
    assert examine(path) == whole
    assert found(whole, "duplicate-episodes").count == 2


@pytest.mark.parametrize(
    "large", [spaces.Box(0, 255, (300, 300, 3), np.uint8), spaces.Box(0, 5, (300, 300))], ids=["rgb", "depth"]
)
@pytest.mark.parametrize("other", [spaces.Text(4), UNIT], ids=["variable", "constant"])
def test_a_block_fits_into_memory(large: spaces.Box, other: gym.Space[Any], tmp_path: Path) -> None:
    """Also of a camera beside a text, such as a robot's instruction."""
    state = {"cam": np.zeros(large.shape, large.dtype), "other": "abc" if other != UNIT else still(0)}
    space = spaces.Dict({"cam": large, "other": other})
    path = scripted(tmp_path / "a.mcap", lambda n: state, space, length=80)
    with Recording(path) as recording:
        read = list(blocks(recording, np.arange(len(recording.index))))
        assert sum(map(len, read)) == recording.index["length"].sum()
        assert max(block.leaves["state_cam"].nbytes for block in read) <= BLOCK_BYTES


def test_repeated_seeds(tmp_path: Path) -> None:
    def seeded(path: Path, seeds: list[int | None]) -> Path:
        return by_hand(path, [{"seed": seed} for seed in seeds])

    finding = found(examine(seeded(tmp_path / "a.mcap", [7, 7, 1, 7])), "repeated-seed")
    assert (finding.severity, finding.count, places(finding)) == (
        WARNING,
        3,
        [(0, None), (1, None), (3, None)],
    )
    finding = found(examine(seeded(tmp_path / "b.mcap", [1, 2, 3, 1, 2, 3])), "repeated-seed")
    assert (finding.severity, finding.count) == (INFO, 2)
    assert examine(seeded(tmp_path / "c.mcap", [1, 2, None, None])).of("repeated-seed") == ()


# --- rewards ---


def test_reward_outliers(tmp_path: Path) -> None:
    rewards = [[1.0] * 10 for _ in range(10)]
    rewards[3][4], rewards[7][0] = 1e6, -1e5
    path = by_hand(tmp_path / "a.mcap", [{"length": 10, "rewards": r} for r in rewards])
    finding = found(examine(path), "reward-outliers")
    assert (finding.severity, finding.count, places(finding)) == (WARNING, 2, [(3, 4), (7, 0)])
    assert (finding.total, finding.leaf) == (90, "reward")
    assert "the furthest is 1e+06" in finding.message


@pytest.mark.parametrize(("spikes", "told"), [(63, "63 rewards are"), (65, "at least 64 rewards are")])
def test_reward_outliers_are_counted_up_to_a_limit(tmp_path: Path, spikes: int, told: str) -> None:
    rewards = [1e6 if i < spikes else i % 5.0 for i in range(1000)]
    finding = found(
        examine(by_hand(tmp_path / "a.mcap", [{"length": 1000, "rewards": rewards}])), "reward-outliers"
    )
    assert finding.message.startswith(told)


@pytest.mark.parametrize("bonus", [1.0, 100.0, -1000.0])
def test_a_bonus_at_the_end_is_no_outlier(tmp_path: Path, bonus: float) -> None:
    rng = np.random.default_rng(0)
    episodes = [{"length": 10, "rewards": [*rng.normal(size=9), bonus if i % 7 else 0.0]} for i in range(30)]
    assert examine(by_hand(tmp_path / "a.mcap", episodes)).of("reward-outliers") == ()


@pytest.mark.parametrize("success", [100.0, -1000.0])
def test_a_rare_success_is_no_outlier(tmp_path: Path, success: float) -> None:
    """As of MountainCarContinuous: most episodes end at the limit of steps, some at the goal."""
    rng = np.random.default_rng(0)
    at_limit = {"terminals": [False] * 10, "timeouts": [False] * 9 + [True]}
    episodes = [
        {"length": 10, "rewards": [*rng.uniform(-0.1, 0, size=9), success]}
        if i in (3, 9, 20)
        else {"length": 10, "rewards": rng.uniform(-0.1, 0, size=10).tolist(), **at_limit}
        for i in range(27)
    ]
    assert examine(by_hand(tmp_path / "a.mcap", episodes)).of("reward-outliers") == ()


def test_a_terminal_reward_far_from_all_others_is_an_outlier(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    episodes = [{"length": 2, "rewards": [0.0, 1e6 if i == 5 else rng.normal()]} for i in range(30)]
    finding = found(examine(by_hand(tmp_path / "a.mcap", episodes)), "reward-outliers")
    assert (finding.count, finding.total, places(finding)) == (1, 30, [(5, 1)])
    assert "among terminal steps; the furthest is 1e+06" in finding.message


def test_rewards_that_are_equal_but_for_rounding_are_no_scale(tmp_path: Path) -> None:
    """As of CarRacing, whose rewards are differences of sums: -0.1 a step, and some tiles."""
    sums = np.cumsum([1000 / 283 if i % 10 == 5 else -0.1 for i in range(400)])
    rewards = np.diff(sums, prepend=0.0).tolist()
    assert len({reward for reward in rewards if reward < 0}) > 1
    assert (
        examine(by_hand(tmp_path / "a.mcap", [{"length": 400, "rewards": rewards}])).of("reward-outliers")
        == ()
    )
    rewards[100] = 1e6
    path = by_hand(tmp_path / "b.mcap", [{"length": 400, "rewards": rewards}])
    assert places(found(examine(path), "reward-outliers")) == [(0, 100)]


def test_rewards_whose_sums_overflow_are_no_outliers(tmp_path: Path) -> None:
    episodes = [{"length": 11, "rewards": [1e308] * 11}] * 3
    assert examine(by_hand(tmp_path / "a.mcap", episodes)).of("reward-outliers") == ()


# --- actions ---


@pytest.mark.parametrize(
    ("space", "act", "unused", "dimension"),
    [
        (spaces.Discrete(4, start=-1), lambda n: n % 3 - 1, "2", ()),
        (spaces.MultiDiscrete([3, 4]), lambda n: np.array([n % 3, 1 + n % 3]), "0", ((1,),)),
        (spaces.MultiBinary(2), lambda n: np.int8([1, n % 2]), "0", ((0,),)),
    ],
)
def test_actions_that_never_occur(
    tmp_path: Path, space: gym.Space[Any], act: Callable[[int], Any], unused: str, dimension: Any
) -> None:
    path = scripted(tmp_path / "a.mcap", actions=space, act=act, episodes=10)
    finding = found(examine(path), "unused-action")
    assert (finding.severity, finding.leaf, finding.count) == (WARNING, "action", 1)
    assert finding.message.endswith(f"never occurs in 100 steps: {unused}")
    assert finding.dimensions == dimension
    few = scripted(tmp_path / "b.mcap", actions=space, act=act, episodes=3)
    assert examine(few).of("unused-action") == ()


@pytest.mark.parametrize("pieces", [1, 7, 100, 5000])
@pytest.mark.parametrize("total", [100, 200_000])
def test_samples_are_every_nth_value(pieces: int, total: int) -> None:
    sample = Sample(total)
    values = np.arange(total)
    for piece in np.array_split(values, pieces):
        sample.put(piece)
    assert sample.seen == total
    assert np.array_equal(sample.values, values[:: 4 if total > 100 else 1])


def test_the_largest_values_with_their_places() -> None:
    values = np.random.default_rng(0).integers(0, 300, 5000).astype(float)
    largest = Largest(k=10)
    for start in range(0, 5000, 123):
        largest.put(values[start : start + 123], lambda i, start=start: (0, start + i))
    order = np.lexsort((np.arange(5000), -values))[:10]
    assert largest.values == [(values[i], (0, int(i))) for i in order]


# --- clocks ---


class Clock:
    """The wall clock, and what is added to it."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        import time

        self.now = 1_700_000_000 * 10**9
        monkeypatch.setattr(time, "time_ns", lambda: self.now)


@pytest.mark.parametrize(("seconds", "severity"), [(2, INFO), (3600, WARNING)])
def test_clock_jumps(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, seconds: int, severity: Severity
) -> None:
    clock = Clock(monkeypatch)

    def observe(n: int) -> Any:
        clock.now += seconds * 10**9 if n == 7 else 10**6
        return still(n)

    finding = found(examine(scripted(tmp_path / "a.mcap", observe)), "clock-jump")
    assert (finding.severity, finding.count, finding.total) == (severity, 3, 27)
    assert places(finding) == [(0, 6), (1, 6), (2, 6)]
    assert "the median is 1.0 ms" in finding.message


def test_clocks_of_sub_environments(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    clock = Clock(monkeypatch)
    envs = gym.make_vec("CartPole-v1", 3, vectorization_mode="sync")
    with vector.RecordEpisodes(envs, tmp_path / "a.mcap") as env:
        env.action_space.seed(1)
        env.reset(seed=1)
        for n in range(8):
            clock.now += 30 * 10**9 if n == 5 else 10**6
            env.step(env.action_space.sample())
    finding = found(examine(tmp_path / "a.mcap"), "clock-jump")
    assert (finding.count, finding.total, places(finding)) == (3, 21, [(0, 5), (1, 5), (2, 5)])


# --- files ---


def test_empty_unfinished_and_unreadable_files(tmp_path: Path) -> None:
    (tmp_path / "text.mcap").write_text("no recording")
    good = record(tmp_path / "good.mcap", gym.make("CartPole-v1"), 50)
    with Recording(good) as recording:
        rewrite_recording(recording, tmp_path / "empty.mcap", episodes=[])
    data = good.read_bytes()
    with good.open("rb") as file:
        (first, *_) = make_reader(file).get_summary().chunk_indexes  # type: ignore[union-attr]
    at = first.chunk_start_offset + first.chunk_length - 10
    (tmp_path / "zdamaged.mcap").write_bytes(data[:at] + bytes([data[at] ^ 255]) + data[at + 1 :])
    diagnosis = examine(tmp_path)
    assert diagnosis.files == 4
    bad = diagnosis.of("unreadable")
    assert [Path(finding.path).name for finding in bad] == ["text.mcap", "zdamaged.mcap"]
    assert all(finding.severity is ERROR for finding in bad)
    assert bad[0].suggestion == "give a recording (.mcap), or see what tupli-mcap recover can save"
    assert bad[1].suggestion == "run 'tupli-mcap recover' to save what is undamaged"
    (tmp_path / "nothing.mcap").touch()
    assert "delete it or record again" in found(examine(tmp_path / "nothing.mcap"), "unreadable").suggestion
    (tmp_path / "nothing.mcap").unlink()
    assert diagnosis.steps == 50
    with RecordEpisodes(gym.make("CartPole-v1"), tmp_path / "live.mcap") as env:
        env.reset(seed=1)
        env.step(0)
        assert found(examine(tmp_path / "live.mcap"), "unfinished").message == "a process is writing to it"
        for end in ("", ".journal"):
            shutil.copy(tmp_path / f"live.mcap{end}", tmp_path / f"killed.mcap{end}")
    assert examine(tmp_path / "live.mcap").of("unfinished") == ()
    finding = found(examine(tmp_path / "killed.mcap"), "unfinished")
    assert finding.suggestion == "finish it with 'tupli-mcap recover --in-place'"
    for said in ("now finished; nothing was lost", "as before; nothing was wrong with it"):
        done = CliRunner().invoke(app, ["recover", "--in-place", str(tmp_path / "killed.mcap")])
        assert done.exit_code == 0 and said in " ".join(done.output.split())
    assert examine(tmp_path / "killed.mcap").of("unfinished") == ()


def test_a_file_of_another_program_is_not_sent_to_recover(tmp_path: Path) -> None:
    with (tmp_path / "bag.mcap").open("wb") as file:
        writer = Writer(file)
        writer.start(profile="ros2")
        writer.finish()
    finding = found(examine(tmp_path / "bag.mcap"), "unreadable")
    assert "no tupli_mcap recording" in finding.message
    assert finding.suggestion.startswith('"mcap doctor"')


# --- what can be examined ---


def test_every_kind_of_source(tmp_path: Path) -> None:
    storage = FileStorage(tmp_path / "lab")
    env = TupliEnvWrapper(gym.make("CartPole-v1"), storage=storage)
    env.store(name="cartpole")
    roll(env, 200)
    env.close()
    (path,) = (tmp_path / "lab").rglob("*.mcap")
    headers = storage.list_episodes()
    whole = examine(path)
    assert (whole.episodes, whole.steps) == (len(headers), 200)
    for source in (
        str(path),
        tmp_path / "lab",
        [path],
        storage,
        TupliDataset(storage),
        TupliDataset.from_files(path),
    ):
        assert examine(source).steps == 200
    with Recording(path) as recording:
        assert examine(recording) == whole
        assert recording.episodes[0].rewards[0] == 1  # it stays open
    long = F("n_tuples") > 20
    wanted = [header.n_tuples for header in headers if header.n_tuples > 20]
    assert 0 < len(wanted) < len(headers)
    for source in (path, storage, TupliDataset(storage)):
        part = examine(source, episode_filter=long)
        assert (part.episodes, part.steps) == (len(wanted), sum(wanted))
    chosen = TupliDataset(storage).with_episode_filter(long)
    assert examine(chosen).steps == sum(wanted)
    storage.delete_episode(headers[0].id)
    assert examine(path).episodes == len(headers) - 1


def test_nothing_of_a_file_is_executed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "a.mcap"
    with RecordEpisodes(Sampler(UNIT, spaces.Discrete(3)), path, capture_env="pickle") as env:
        env.reset(seed=1)
        for _ in range(50):
            _, _, terminal, timeout, _ = env.step(env.action_space.sample())
            if terminal or timeout:
                env.reset()
    with Recording(path) as recording:
        assert "env.cloudpickle" in recording.attachments
    before = {item: item.stat() for item in tmp_path.iterdir()}

    def refuse(*_: Any, **__: Any) -> None:
        raise AssertionError("code from a file")

    for target in ("pickle.loads", "pickle.load", "cloudpickle.loads", "gymnasium.make", "builtins.exec"):
        monkeypatch.setattr(target, refuse)
    assert examine(path).steps == 50
    assert {item: item.stat() for item in tmp_path.iterdir()} == before


def test_what_cannot_be_examined(tmp_path: Path) -> None:
    missing = examine(tmp_path / "missing.mcap")
    assert found(missing, "unreadable").message.startswith(f"{tmp_path / 'missing.mcap'} does not exist")
    assert "holds no recording" in found(examine(tmp_path), "unreadable").message
    with pytest.raises(RecordingError, match="expected a path, Recording, Dataset or storage, found 3"):
        examine(3)  # type: ignore[arg-type]
    with pytest.raises(RecordingError, match="there is no check 'nam'; checks are unfinished, nan, "):
        examine(tmp_path, checks=["nam"])
    with pytest.raises(RecordingError, match="'nan' has no threshold 'least'; it has none"):
        examine(tmp_path, thresholds={"nan": {"least": 3}})
    for wrong in (float("nan"), -1, "30", None, True):
        with pytest.raises(RecordingError, match=f"from 0 on for frozen-frames.frames, found {wrong!r}"):
            examine(tmp_path, thresholds={"frozen-frames": {"frames": wrong}})
    with pytest.raises(RecordingError, match="list of ids of checks"):
        examine(tmp_path, checks="nan")


def test_checks_are_chosen_and_documented(tmp_path: Path) -> None:
    path = scripted(tmp_path / "a.mcap", lambda n: np.float32([0, 0, np.nan]), episodes=10)
    everything = {finding.check for finding in examine(path).findings}
    assert {"nan", "constant-dimension", "duplicate-episodes"} <= everything
    assert {f.check for f in examine(path, checks=["nan"]).findings} == {"nan"}
    assert {f.check for f in examine(path, skip=["nan"]).findings} == everything - {"nan"}
    for name, check in CHECKS.items():
        assert check.id == name and len(check.summary) < 60
        assert len(check.explanation) > 20


# --- the command ---


def run(*args: object) -> tuple[int, str]:
    result = CliRunner().invoke(app, ["doctor", *map(str, args)])
    if result.exception is not None and not isinstance(result.exception, SystemExit):
        raise result.exception
    return result.exit_code, result.stdout


def test_command_exit_codes(tmp_path: Path) -> None:
    good = record(tmp_path / "good.mcap", gym.make("CartPole-v1"), 50)
    warned = scripted(tmp_path / "warned.mcap", lambda n: np.float32([9, 0, n / 10]))
    bad = scripted(tmp_path / "bad.mcap", lambda n: np.float32([0, 0, np.nan]))
    code, out = run(good)
    assert code == 0 and out.splitlines()[-1].startswith("healthy")
    for path, codes in ((good, (0, 0, 0)), (warned, (0, 1, 0)), (bad, (1, 1, 0))):
        assert tuple(run(path, "--fail-on", level)[0] for level in ("error", "warning", "never")) == codes
    assert run(bad, "--skip", "nan")[0] == 0
    assert run(bad, "--check", "outside-space", "--fail-on", "warning")[0] == 0
    assert run(tmp_path / "missing.mcap", "--fail-on", "never")[0] == 1
    assert run(bad, "--check", "nam")[0] == 2
    assert run(bad, "--filter", "nonsense = 1")[0] == 2
    assert run(warned, "--fail-on", "warning", "--check", "unused-action")[0] == 0
    many = "unused-action.steps_each=5"
    few = scripted(tmp_path / "few.mcap", act=lambda n: n % 2)
    assert run(few, "--fail-on", "warning", "--check", "unused-action", "--set", many)[0] == 1
    for wrong in (
        "unused-action.nothing=3",
        "nothing.frames=3",
        *(many.replace("5", to) for to in ("many", "nan", "-1")),
    ):
        assert run(few, "--set", wrong)[0] == 2
    assert run(bad, "--filter", "n_tuples > 10") == (
        0,
        "nothing to examine: 1 recording, 0 episodes, 0 steps\n",
    )


def test_command_output(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "data").mkdir()
    monkeypatch.chdir(tmp_path / "data")
    for name in ("a", "b"):
        scripted(Path(f"{name}.mcap"), lambda n: np.float32([np.sin(n), 0.5, np.nan if n == 4 else 0]))
    Path("c.mcap").write_text("no recording")
    monkeypatch.setenv("COLUMNS", "80")
    code, out = run()
    assert code == 1
    assert out.startswith(
        "error    nan · state\n"
        "         a.mcap:\n"
        "         3 of 99 values are NaN in state[2]\n"
        "         at episode:step 0:4, 1:4, 2:4\n"
        "         also in b.mcap\n"
        "         → drop these episodes, and find the division or sensor that made NaN\n\n"
        "error    unreadable\n"
        "         c.mcap: expected an MCAP file, found b'no recor"
    )
    assert max(map(len, out.splitlines())) <= 80
    assert out.endswith(": 3 recordings, 6 episodes, 60 steps\n")
    assert "duplicate" in out and "duplicate" not in run("--level", "error")[1]
    code, text = run("--json")
    document = json.loads(text)["result"]
    assert code == 1 and {"version": 1, **document} == examine(".").to_dict()
    assert list(document) == ["healthy", "worst", "files", "episodes", "steps", "findings"]
    assert document["findings"][0] == {
        "check": "nan",
        "severity": "error",
        "path": "a.mcap",
        "message": "3 of 99 values are NaN in state[2]",
        "suggestion": "drop these episodes, and find the division or sensor that made NaN",
        "leaf": "state",
        "dimensions": [[2]],
        "count": 3,
        "total": 99,
        "places": [{"path": "a.mcap", "episode": i, "step": 4} for i in range(3)],
    }
    assert run("--list")[1].count("\n") == len(CHECKS) + 1
    listed = json.loads(run("--list", "--json")[1])["result"]
    assert [check["id"] for check in listed] == list(CHECKS)
    assert {"frames": 30} in [check["thresholds"] for check in listed]
