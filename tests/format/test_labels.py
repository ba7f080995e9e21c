"""Names of dimensions and values: read from documentation, chosen, stored, read back."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from environments import Sampler
from gymnasium import spaces
from gymnasium.wrappers import FrameStackObservation, RescaleAction
from jsonschema import Draft202012Validator

import tupli_mcap
from tupli_mcap import F, FilterError, FormatError, RecordEpisodes, Recording, SpaceError
from tupli_mcap.dataset.columns.labels import StepLabels
from tupli_mcap.environment import documented_labels
from tupli_mcap.schema import evaluate_columns, parse_filter
from tupli_mcap.spaces.labels import LABELS_NAME, Labels
from tupli_mcap.vector import RecordEpisodes as RecordVector

SCHEMA = json.loads((Path(__file__).parents[2] / "schemas" / "labels.schema.json").read_text())
CART_POLE = ("Cart Position", "Cart Velocity", "Pole Angle", "Pole Angular Velocity")
PUSHES = ("Push cart to the left", "Push cart to the right")


def record(env: Any, path: Path, **kwargs: Any) -> Recording:
    with RecordEpisodes(env, path, **kwargs) as recorder:
        recorder.reset(seed=1)
        recorder.step(recorder.action_space.sample())
    return Recording(path)


@pytest.mark.parametrize(
    ("name", "dimensions", "values", "seconds"),
    [
        ("CartPole-v1", {"state": CART_POLE}, {"action": PUSHES}, 0.02),
        (
            "Pendulum-v1",
            {"state": ("x = cos(theta)", "y = sin(theta)", "Angular Velocity"), "action": ("Torque",)},
            {},
            0.05,
        ),
        (
            "Acrobot-v1",
            {
                "state": (
                    *(f"{f} of theta{i}" for i in (1, 2) for f in ("Cosine", "Sine")),
                    *(f"Angular velocity of theta{i}" for i in (1, 2)),
                )
            },
            {"action": tuple(f"apply {i} torque to the actuated joint" for i in (-1, 0, 1))},
            0.2,
        ),
        (
            "FrozenLake-v1",
            {},
            {"action": ("Move left", "Move down", "Move right", "Move up")},
            0.25,
        ),
    ],
)
def test_gymnasium_documents_its_environments(
    name: str, dimensions: Any, values: Any, seconds: float, tmp_path: Path
) -> None:
    labels = record(gym.make(name), tmp_path / "r.mcap").labels
    assert labels == Labels(dimensions, values, pytest.approx(seconds))
    stored = Recording(tmp_path / "r.mcap").read_attachment(LABELS_NAME)
    Draft202012Validator(SCHEMA).validate(json.loads(stored))


def test_a_wrapper_may_change_what_a_dimension_is() -> None:
    stacked = FrameStackObservation(gym.make("CartPole-v1"), 3)
    assert documented_labels(stacked) == Labels({}, {"action": PUSHES}, 0.02)
    scaled = RescaleAction(gym.make("Pendulum-v1"), np.float32(-1), np.float32(1))
    assert documented_labels(scaled).dimensions["action"] == ("Torque",)


class Arm(gym.Env[Any, Any]):
    """An arm.

    ## Observation Space
    | Num | Observation |
    |-----|-------------|
    | 0   | shoulder    |
    | 2   | elbow       |

    ## Action Space
    - 0: `open`
    - 1: **close**
    """

    observation_space = spaces.Dict(
        {"joints": spaces.Box(-1, 1, (2,)), "held": spaces.Discrete(3, start=5), "words": spaces.Text(5)}
    )
    action_space = spaces.Discrete(2)

    def reset(self, *, seed: int | None = None, options: Any = None) -> tuple[Any, dict[str, Any]]:
        super().reset(seed=seed)
        return self.observation_space.sample(), {}

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        return self.observation_space.sample(), 0.0, False, False, {}

    @property
    def dt(self) -> float:
        raise RuntimeError("not known yet")


def test_only_what_is_whole_is_taken(tmp_path: Path) -> None:
    assert record(Arm(), tmp_path / "r.mcap").labels == Labels({}, {"action": ("open", "close")}, None)


class Dashes(Arm):
    """## Action Space
    | Num | Action | Min |
    |-----|--------|-----|
    | 0   | lift   | -1  |
    | 1   | -      | -1  |
    """


def test_a_dash_is_no_name(tmp_path: Path) -> None:
    assert record(Dashes(), tmp_path / "r.mcap").labels.values == {"action": ("lift", "1")}


class Longer(Arm):
    """An arm that says no more than what it is."""


def test_a_subclass_need_not_say_it_again(tmp_path: Path) -> None:
    assert record(Longer(), tmp_path / "r.mcap").labels.values == {"action": ("open", "close")}


class Joystick(Arm):
    """## Action Space
    - 0: something else
    - 1: something else
    """

    def get_action_meanings(self) -> list[str]:
        return ["NOOP", "FIRE"]


def test_what_an_environment_says_of_its_actions_counts_more(tmp_path: Path) -> None:
    assert record(Joystick(), tmp_path / "r.mcap").labels.values == {"action": ("NOOP", "FIRE")}


@pytest.mark.parametrize(
    ("joints", "held", "action"),
    [
        ("state['joints']", "state['held']", "action"),
        ("states['joints']", "states['held']", "actions"),
        ("observations['joints']", "observation.held", "action"),
        ("state.joints", "states.held", "action"),
        ("joints", "held", "actions"),
    ],
)
def test_names_may_be_chosen(joints: str, held: str, action: str, tmp_path: Path) -> None:
    given = {joints: ["shoulder", "elbow"], held: ["a", "b", "c"], action: ["x", "y"]}
    labels = record(Arm(), tmp_path / "r.mcap", labels=given).labels
    assert labels.dimensions == {"state.joints": ("shoulder", "elbow")}
    stored = json.loads(Recording(tmp_path / "r.mcap").read_attachment(LABELS_NAME))
    assert stored["dimensions"] == {"state['joints']": ["shoulder", "elbow"]}  # the format's spelling
    assert labels.values == {"state.held": ("a", "b", "c"), "action": ("x", "y")}


@pytest.mark.parametrize(
    ("given", "match"),
    [
        ({"action": ["a", "b"], "actions": ["a", "b"]}, "expected names for action once"),
        ({"elbows": ["a", "b"]}, r"labels: expected one of \[.*state\.joints.*found 'elbows'"),
        ({"state.joint": ["a", "b"]}, r"found 'state.joint' \(did you mean 'state.joints'\?\)"),
        ({"state['joints']": ["a"]}, r"labels: expected 2 names for state\.joints .* found 1"),
        ({"state['held']": ["a", "b"]}, r"expected 1 or 3 names for state\.held"),
        ({"state['words']": ["a"]}, r"expected no names for state\.words"),
        ({"action": ["left", ""]}, "expected names of 1 to 200 characters for action"),
        ({"action": ["left", "ri\nght"]}, "expected names of 1 to 200 characters for action"),
        ({"action": 3}, "expected names of 1 to 200 characters for action, found 3"),
        (["left", "right"], r"labels: expected a dict, such as .*, found \['left', 'right'\]"),
    ],
)
def test_chosen_names_must_fit(given: Any, match: str, tmp_path: Path) -> None:
    with pytest.raises(SpaceError, match=match):
        RecordEpisodes(Arm(), tmp_path / "r.mcap", labels=given)
    assert list(tmp_path.iterdir()) == []


def test_of_sub_environments(tmp_path: Path) -> None:
    envs = gym.vector.SyncVectorEnv([lambda: gym.make("CartPole-v1")] * 2)
    with RecordVector(envs, tmp_path / "r.mcap", labels={"action": ["left", "right"]}) as recorder:
        recorder.reset(seed=1)
        recorder.step(recorder.action_space.sample())
    assert Recording(tmp_path / "r.mcap").labels == Labels(
        {"state": CART_POLE}, {"action": ("left", "right")}, 0.02
    )


@pytest.mark.parametrize("mode", ["vector_entry_point", "async"])
def test_of_sub_environments_that_are_not_at_hand(mode: str, tmp_path: Path) -> None:
    envs = gym.make_vec("CartPole-v1", num_envs=2, vectorization_mode=mode)
    with RecordVector(envs, tmp_path / "r.mcap") as recorder:
        recorder.reset(seed=1)
        recorder.step(recorder.action_space.sample())
    labels = Recording(tmp_path / "r.mcap").labels
    assert labels.dimensions == {"state": CART_POLE} and labels.values == {"action": PUSHES}


@pytest.mark.parametrize(("name", "seconds"), [("Pendulum-v1", 1 / 30), ("FrozenLake-v1", 1 / 4), ("", None)])
def test_other_processes_are_not_asked_how_long_a_step_takes(
    name: str, seconds: float | None, tmp_path: Path
) -> None:
    """It is one frame, as the metadata of the vector environment has it."""

    def make() -> gym.Env[Any, Any]:
        space = gym.spaces.Discrete(2)
        return gym.make(name) if name else Sampler(space, space)

    with RecordVector(gym.vector.AsyncVectorEnv([make] * 2), tmp_path / "r.mcap") as recorder:
        recorder.reset(seed=1)
        for _ in range(3):
            recorder.step(recorder.action_space.sample())
    assert Recording(tmp_path / "r.mcap").labels.step_seconds == seconds


def test_what_a_wrapper_of_sub_environments_changed_has_no_name(tmp_path: Path) -> None:
    stack = [lambda env: gym.wrappers.FrameStackObservation(env, 2)]
    envs = gym.make_vec("CartPole-v1", num_envs=2, vectorization_mode="async", wrappers=stack)
    with RecordVector(envs, tmp_path / "r.mcap") as recorder:
        recorder.reset(seed=1)
        recorder.step(recorder.action_space.sample())
    labels = Recording(tmp_path / "r.mcap").labels
    assert labels.dimensions == {} and labels.values == {"action": PUSHES}


@pytest.mark.parametrize(
    "data",
    [
        b"\xff",
        b"[]",
        b'{"dimensions": 3}',
        b'{"dimensions": {"state": ["a"]}}',
        b'{"values": {"action": ["a", 3]}}',
        b'{"values": {"state": ["a", "b", "c", "d"]}}',
        b'{"dimensions": {"action": ["a", "b"]}}',
        b'{"values": {"action": ["a", "b\\u0000"]}}',
        b'{"step_seconds": 0}',
        b'{"step_seconds": NaN}',
        b'{"step_seconds": %s}' % (b"9" * 400),
        b'{"step_seconds": "1"}',
        b"[" * 10_000,
        b'"' + b"a" * (1 << 20) + b'"',
    ],
    ids=range(14),
)
def test_others_are_refused(data: bytes, tmp_path: Path) -> None:
    attachments = {LABELS_NAME: ("application/json", data)}
    recording = record(gym.make("CartPole-v1"), tmp_path / "r.mcap", attachments=attachments)
    with pytest.raises(FormatError, match=r"r\.mcap: labels\.json: expected"):
        _ = recording.labels


def test_of_leaves_that_are_not_there_are_ignored(tmp_path: Path) -> None:
    data = json.dumps({"dimensions": {"state['x']": ["a"]}, "later": 1, "values": {"action": ["a", "b"]}})
    attachments = {LABELS_NAME: ("application/json", data.encode())}
    recording = record(gym.make("CartPole-v1"), tmp_path / "r.mcap", attachments=attachments)
    assert recording.labels == Labels({}, {"action": ("a", "b")})


def test_a_table_has_a_column_for_each_dimension(tmp_path: Path) -> None:
    pytest.importorskip("pandas")

    def columns(
        space: spaces.Space[Any], action: spaces.Space[Any], labels: dict[str, list[str]]
    ) -> list[str]:
        path = tmp_path / f"{len(list(tmp_path.iterdir()))}.mcap"
        record(Sampler(space, action), path, labels=labels)
        table = tupli_mcap.open(path).to_pandas()
        return [name for name in table if str(name).startswith(("state", "action"))]

    equal = {"state": ["x", "x", "x (1)", "state of charge"], "action": ["push"]}
    assert columns(spaces.Box(-1, 1, (4,)), spaces.Box(-1, 1, (1,)), equal) == [
        "state.x", "state.x (1)", "state.x (1) (2)", "state.state of charge", "action.push"
    ]  # fmt: skip
    dotted = spaces.Dict({"arm.x": spaces.Box(-1, 1, ()), "arm": spaces.Dict({"x": spaces.Box(-1, 1, ())})})
    assert columns(dotted, spaces.Dict({"action": spaces.Discrete(2)}), {}) == [
        "state.arm.x", 'state."arm.x"', "action.action"
    ]  # fmt: skip
    pair = spaces.Tuple([spaces.Discrete(2), spaces.Box(-1, 1, (1,))])
    assert columns(pair, spaces.Discrete(2), {"state[1]": ["x"]}) == ["state[0]", "state[1]: x", "action"]


@pytest.mark.parametrize("given", [None, {"action": ["x", "y"]}], ids=["attached", "both"])
def test_labels_that_are_given_win_over_attached_ones(tmp_path: Path, given: Any) -> None:
    attachments = {LABELS_NAME: ("application/json", b'{"dimensions": {}, "values": {"action": ["a", "b"]}}')}
    box, two = spaces.Box(-1, 1, (1,)), spaces.Discrete(2)
    with tupli_mcap.EpisodeWriter(
        tmp_path / "w.mcap", box, two, labels=given, attachments=attachments
    ) as writer:
        writer.begin()
        writer.step(np.zeros(1, np.float32), 0, 1.0, True)
    record(Sampler(box, two), tmp_path / "r.mcap", labels=given, attachments=attachments)
    expected = {"action": ("x", "y") if given else ("a", "b")}
    for name in ("w.mcap", "r.mcap"):
        assert Recording(tmp_path / name).labels.values == expected


def test_labels_on_which_recordings_differ_are_not_used(tmp_path: Path) -> None:
    pytest.importorskip("pandas")
    same, sources = {"action": ["left", "right"]}, []
    for name, labels in (("a", ["p", "q"]), ("b", ["q", "p"]), ("c", None)):
        env = Sampler(spaces.Box(-1, 1, (2,)), spaces.Box(-1, 1, (2,)))
        given = same if labels is None else {"state": labels, **same}
        sources.append(tmp_path / f"{name}.mcap")
        record(env, sources[-1], labels=given)
    names = ["action.left", "action.right", "state[0]", "state[1]"]
    with pytest.warns(UserWarning, match=r"a\.mcap and .*b\.mcap have different labels of state; indexes"):
        table = tupli_mcap.open(tmp_path).to_pandas()
    assert sorted(name for name in table if str(name).startswith(("state", "action"))) == names
    agreeing = tupli_mcap.open(sources[::2]).to_pandas()
    assert {"state.p", "state.q"} < set(agreeing)
    with pytest.warns(UserWarning, match="have different labels of state; indexes"):
        tupli_mcap.merge_recordings(sources, tmp_path / "all.mcap")
    assert Recording(tmp_path / "all.mcap").labels == Labels({"action": ("left", "right")}, {})


def test_filters_of_steps_understand_them(tmp_path: Path) -> None:
    parts = {"joints": spaces.Box(-9, 9, (2,)), "held": spaces.Discrete(3, start=5), "mode": spaces.Text(9)}
    given = {"joints": ["shoulder", "elbow"], "held": ["a", "b", "c"], "action": ["left", "right"]}
    with tupli_mcap.EpisodeWriter(
        tmp_path / "r.mcap", spaces.Dict(parts), spaces.Discrete(2), labels=given
    ) as writer:
        writer.begin()
        for i in range(6):
            state = {"joints": np.array([i, -i], np.float32), "held": 5 + i % 3, "mode": "ab"[i // 3]}
            writer.step(state, i % 2, 1.0, i == 5, info={"phase": "grasp" if i < 2 else "lift"})
    dataset = tupli_mcap.open(tmp_path)

    def steps(test: Any) -> list[int]:
        return dataset.filter_steps(test).read(["states"]).states["joints"][:, 0].astype(int).tolist()

    assert steps("state.joints.elbow < -3") == steps("observation.joints.shoulder > 3") == [4, 5]
    assert steps('action = "right"') == [1, 3, 5]
    assert steps('action != "right" and not state.held = "a"') == [2, 4]
    assert steps(F("states.held").isin(["a", "c"])) == [0, 2, 3, 5]
    assert steps("next_state.held = 'a' and state.joints[0] < 3") == [2]
    assert steps("info.phase == 'grasp'") == [0, 1]
    assert steps("state.mode = 'b' or info.phase ~ 'gra'") == [0, 1, 3, 4, 5]
    for wrong, why in (
        ('action = "rihgt"', r"did you mean 'right'\?"),
        ('action > "left"', "with =, != or in"),
    ):
        with pytest.raises(FilterError, match=f"'action' is one of left, right: .*{why}"):
            steps(wrong)
    with Recording(tmp_path / "r.mcap") as recording:
        assert recording.filter_steps("action = 'left'").n_steps == 3


def test_filters_of_steps_understand_labels_of_single_numbers_and_repeated_ones(tmp_path: Path) -> None:
    parts = {
        "height": spaces.Box(-9, 9, ()),
        "speed": spaces.Box(-9, 9, (1,)),
        "q": spaces.Box(-9, 9, (2, 2)),
    }
    given = {
        "height": ["metres"],
        "speed": ["m/s"],
        "q": ["x", "y", "x", "z"],
        "action": ["stay", "go", "stay"],
    }
    path = tmp_path / "r.mcap"
    with tupli_mcap.EpisodeWriter(path, spaces.Dict(parts), spaces.Discrete(3), labels=given) as writer:
        writer.begin()
        for i in range(6):
            state = {name: np.full(space.shape, i, np.float32) for name, space in parts.items()}
            writer.step(state, i % 3, 1.0, i == 5)
    both = Labels({"action": ("gear",)}, {"action": ("stay", "go", "stay")})
    with Recording(path) as recording:
        layout, columns = recording.layout, recording.read()

        def steps(test: str) -> list[int]:
            chosen = recording.filter_steps(test).read(["states"]).states["height"]
            return chosen.astype(int).tolist()

        assert steps("state.height.metres > 3") == steps('state.speed."m/s" > 3') == [4, 5]
        assert steps('action = "stay"') == [0, 2, 3, 5]
        assert steps('action != "stay"') == steps('action in ["go"]') == [1, 4]
        assert steps('state.q.y > 3 and action = "stay"') == [5]
        several = r"which is that of 2; name one by its index: state\.q\[0,0\], state\.q\[1,0\]"
        with pytest.raises(FilterError, match=several):
            steps("state.q.x > 3")
    named = StepLabels(layout, both).applied(parse_filter('action.gear = "go"'))
    assert evaluate_columns(named, {"action": columns.actions}).tolist() == [False, True, False] * 2
