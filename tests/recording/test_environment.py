"""Environments as data: when a spec is enough, what a pickle keeps, and what never runs unasked."""

from __future__ import annotations

import dataclasses
import json
import pickle
import random
import subprocess
import sys
import textwrap
import threading
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from environments import Counter
from gymnasium.utils import EzPickle
from hypothesis import given, settings, strategies as st

from tupli_mcap import trust
from tupli_mcap.environment import EnvironmentRecord, Snapshot, build, capture, note
from tupli_mcap.errors import FormatError, TupliError, UntrustedError


@pytest.fixture(autouse=True)
def _config(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("TUPLI_MCAP_CONFIG_DIR", str(tmp_path / "config"))


class Engine(gym.Env[Any, Any], EzPickle):
    """Pickles as its constructor's arguments, as environments around C libraries do."""

    observation_space = gym.spaces.Box(0, 1, (1,))
    action_space = gym.spaces.Discrete(2)

    def __init__(self, size: int = 1) -> None:
        EzPickle.__init__(self, size)
        self.size = size
        self.friction = 0.5
        self.world = open(__file__)  # noqa: PTH123, SIM115 - stands for something that cannot be pickled

    def close(self) -> None:
        self.world.close()


# --- a spec where it is enough ---


@pytest.mark.parametrize(
    "env_id", ["CartPole-v1", "MountainCar-v0", "Pendulum-v1", "FrozenLake-v1", "Blackjack-v1"]
)
def test_registered_environments_need_no_pickle(env_id: str) -> None:
    env = gym.make(env_id)
    record = capture(env)
    assert record.spec is not None
    assert record.pickle is None
    assert record.name == env_id
    assert record.versions["gymnasium"] == gym.__version__


def test_spec_rebuilds_arguments_limits_and_wrappers() -> None:
    env = gym.wrappers.TimeAwareObservation(
        gym.make("MountainCar-v0", max_episode_steps=999, goal_velocity=0.03)
    )
    record = capture(env)
    assert record.spec is not None
    built = build(record)
    assert [type(layer) for layer in _layers(built)] == [type(layer) for layer in _layers(env)]
    assert built.unwrapped.goal_velocity == 0.03  # type: ignore[attr-defined]
    assert built.spec is not None
    assert built.spec.max_episode_steps == 999
    assert built.observation_space == env.observation_space


def _layers(env: gym.Env[Any, Any]) -> list[gym.Env[Any, Any]]:
    return [env, *_layers(env.env)] if isinstance(env, gym.Wrapper) else [env]


def test_looking_at_an_environment_does_not_change_its_digest() -> None:
    env = gym.make("CartPole-v1")
    digest = capture(env).digest
    assert env.spec is not None
    env.action_space.seed(3)
    env.action_space.sample()
    env.observation_space.sample()
    assert capture(env).digest == digest
    assert capture(gym.make("CartPole-v1")).digest == digest


@pytest.mark.parametrize(
    "change",
    [
        lambda env: setattr(env.unwrapped, "gravity", 3.7),
        lambda env: setattr(env, "_max_episode_steps", 7),  # inner state of the TimeLimit
        lambda env: setattr(env.unwrapped, "extra", [1, 2]),
        lambda env: env.reset(seed=0),
    ],
)
def test_what_a_spec_does_not_say_is_pickled(change: Any) -> None:
    env = gym.make("CartPole-v1")
    plain = capture(env).digest
    change(env)
    record = capture(env)
    assert record.spec is None
    assert record.pickle is not None
    assert record.digest != plain
    built = build(record, trust=True)
    assert vars(built.unwrapped).get("extra") == vars(env.unwrapped).get("extra")
    assert built.unwrapped.gravity == env.unwrapped.gravity  # type: ignore[attr-defined]
    assert built._max_episode_steps == env._max_episode_steps  # type: ignore[attr-defined]


class Plant(Counter):
    """Gives its attributes constants, arguments, and what it makes of them."""

    gain = 1.0

    def __init__(self, start: float = 0.0, *, limit: int = 9, scale: float = 2.0) -> None:
        super().__init__(start)
        self.limit = limit
        scale = float(scale)
        self.scale = scale
        self.mass: float = 0.5
        self.kind = "tank" if limit > 5 else "pipe"
        self.__secret = None
        self.low = self.high = 0
        self.area = self.mass * limit

    def widen(self) -> None:
        self.mass = 1.5
        self.area += 1


def test_a_spec_is_enough_where_classes_say_how_attributes_came_about() -> None:
    gym.register("TupliPlant-v0", entry_point=f"{__name__}:Plant")
    try:

        def captured(**changes: Any) -> EnvironmentRecord:
            env = gym.make("TupliPlant-v0", limit=4, scale="3")
            for name, value in changes.items():
                setattr(env.unwrapped, name, value)
            return capture(env, by_reference=True)

        assert captured().spec is not None
        for change in (
            {"limit": 5}, {"limit": 4.0}, {"mass": 0.6}, {"gain": 1.0}, {"_Plant__secret": 3}, {"step": print},
            {"colour": "red"},
        ):  # fmt: skip
            assert captured(**change).pickle is not None, change  # type: ignore[arg-type]
        # What the code of the class itself gives, and what a constructor computes.
        for change in (
            {"mass": 1.5},
            {"area": 7.0},
            {"kind": "lake"},
            {"scale": 1.0},
            {"low": 2},
            {"start": 5.0},
        ):
            assert captured(**change).spec is not None, change  # type: ignore[arg-type]
    finally:
        del gym.registry["TupliPlant-v0"]


class Valve(Counter):
    """Assigns its attributes by property setters."""

    def __init__(self, start: float = 0.0, *, opening: int = 1) -> None:
        super().__init__(start)
        self.opening = opening
        self.leak = False
        self.width = 2
        self._hot = True

    @property
    def opening(self) -> int:
        return self._opening

    @opening.setter
    def opening(self, value: int) -> None:
        self._opening = value

    @property
    def leak(self) -> bool:
        return self._leak

    @leak.setter
    def leak(self, value: bool) -> None:
        self._leak = value

    @property
    def width(self) -> float:
        return self._width

    @width.setter
    def width(self, value: float) -> None:
        self._width = value / 2

    @property
    def hot(self) -> bool:
        return self._hot

    @hot.setter
    def hot(self, value: bool) -> None:
        self._hot = value


def test_what_was_set_through_a_property_is_pickled() -> None:
    gym.register("TupliValve-v0", entry_point=f"{__name__}:Valve")
    try:
        for change, is_spec in (
            ({}, True), ({"opening": 4}, True), ({"leak": False}, True), ({"hot": True}, True), ({"width": 3}, True),
            ({"opening": 5}, False), ({"leak": True}, False), ({"hot": False}, False),
        ):  # fmt: skip
            env = gym.make("TupliValve-v0", opening=4)
            for name, value in change.items():
                setattr(env.unwrapped, name, value)
            assert (capture(env, by_reference=True).spec is not None) == is_spec, change
    finally:
        del gym.registry["TupliValve-v0"]
    normalized = gym.wrappers.NormalizeObservation(gym.make("CartPole-v1"))
    assert capture(normalized).spec is not None
    normalized.update_running_mean = False
    assert capture(normalized).pickle is not None


def test_a_wrapper_that_hides_itself_from_the_spec_is_pickled() -> None:
    class Hidden(gym.RewardWrapper[Any, Any]):
        spec = property(lambda self: self.env.spec)  # type: ignore[assignment]

        def reward(self, reward: Any) -> Any:
            return -reward

    assert capture(Hidden(gym.make("CartPole-v1"))).pickle is not None
    limited = gym.wrappers.TimeLimit(gym.make("CartPole-v1"), 1000)  # outside of the one of 500 steps
    assert capture(limited).pickle is not None
    assert capture(gym.make("CartPole-v1"), pickled=True).name == "CartPole-v1"


def test_wrappers_that_a_spec_cannot_hold_are_pickled() -> None:
    env = gym.wrappers.TransformReward(gym.make("CartPole-v1"), lambda reward: reward * 2)
    record = capture(env)
    assert record.spec is None
    built = build(record, trust=True)
    built.reset(seed=0)
    assert built.step(0)[1] == 2.0


def test_local_registrations_are_pickled_unless_by_reference() -> None:
    gym.register("TupliCounter-v0", entry_point=f"{__name__}:Counter")
    try:
        env = gym.make("TupliCounter-v0", start=2.0)
        assert capture(env).spec is None
        assert capture(env, by_reference=True).spec is not None
    finally:
        del gym.registry["TupliCounter-v0"]


def test_arguments_whose_keys_are_no_texts_are_pickled() -> None:
    gym.register("TupliCounter-v0", entry_point=f"{__name__}:Counter")
    try:
        env = gym.make("TupliCounter-v0", start={"a": [{0: 1.0}]})
        assert note(env).spec is None
        built = build(capture(env, by_reference=True), trust=True)
        assert built.unwrapped.start == {"a": [{0: 1.0}]}  # type: ignore[attr-defined]
    finally:
        del gym.registry["TupliCounter-v0"]


def test_digest_of_a_spec_ignores_fields_at_their_default() -> None:
    spec = capture(gym.make("CartPole-v1")).spec
    assert spec is not None
    told = {key: value for key, value in spec.items() if key != "nondeterministic"}
    assert EnvironmentRecord("a", spec=spec).digest == EnvironmentRecord("b", spec=told).digest
    assert (
        EnvironmentRecord("a", spec={**spec, "nondeterministic": True}).digest
        != EnvironmentRecord("a", spec=spec).digest
    )


# --- the caller's environment is left alone ---


def test_capturing_changes_nothing_in_the_environment() -> None:
    env = gym.make("CartPole-v1")
    env.reset(seed=5)
    before = pickle.dumps(env)
    random.seed(1)
    np.random.seed(1)
    expected = random.random(), np.random.random()
    random.seed(1)
    np.random.seed(1)
    capture(env)
    assert (random.random(), np.random.random()) == expected
    assert pickle.dumps(env) == before


def test_snapshot_keeps_the_state_it_was_taken_in() -> None:
    env = Counter(start=4.0)
    snapshot = Snapshot(env, copies=True)
    env.start = 9.0
    copy = snapshot.copy()
    assert isinstance(copy, Counter)
    assert copy.start == 4.0
    assert build(snapshot.record(), trust=True).unwrapped.start == 4.0  # type: ignore[attr-defined]


def test_an_environment_that_cannot_be_pickled_fails_only_when_needed() -> None:
    env = Counter()
    env.lock = threading.Lock()  # type: ignore[attr-defined]
    snapshot = Snapshot(env, copies=True)
    with pytest.raises(TupliError, match=r"the environment .*Counter cannot be pickled \(TypeError: .*lock"):
        snapshot.record()
    copy = snapshot.copy()
    assert copy.lock is env.lock  # type: ignore[attr-defined]
    copy.lock = None  # type: ignore[attr-defined]
    assert capture(copy).pickle is not None


def test_what_cannot_be_captured_stays_open() -> None:
    env = Engine()
    env.__dict__.pop("_ezpickle_args")
    with pytest.raises(TupliError, match="cannot be"):
        capture(env)
    assert not env.world.closed
    env.close()


def test_changes_to_an_environment_that_pickles_as_its_arguments_are_kept() -> None:
    env = Engine(size=3)
    env.friction = 0.1
    built = build(capture(env), trust=True)
    assert built.unwrapped.size == 3  # type: ignore[attr-defined]
    assert built.unwrapped.friction == 0.1  # type: ignore[attr-defined]
    other = Engine(size=3)
    assert capture(env).digest != capture(other).digest
    for one in (env, other, built):
        one.close()


# --- classes that only this process has ---


def test_a_locally_defined_class_is_pickled_by_value() -> None:
    class Local(Counter):
        bonus = 2.0

        def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
            observation, reward, *rest = super().step(action)
            return (observation, reward + self.bonus, *rest)

    record = capture(Local())
    assert record.digest == capture(Local()).digest
    built = build(record, trust=True)
    built.reset()
    assert built.step(0)[1] == 3.0
    with pytest.raises(TupliError, match="cannot be pickled"):
        capture(Local(), by_reference=True)


def test_loading_does_not_redefine_the_live_class() -> None:
    class Local(Counter):
        bonus = 2.0

    record = capture(Local())
    Local.bonus = 5.0
    step = Local.step
    built = build(record, trust=True)
    assert built.unwrapped.bonus == 2.0  # type: ignore[attr-defined]
    assert Local.bonus == 5.0
    assert Local.step is step


def test_by_value_works_in_another_process(tmp_path: Path) -> None:
    script = tmp_path / "define.py"
    helper = tmp_path / "windy_helper.py"
    helper.write_text("def push(x):\n    return x + 10.0\n")
    script.write_text(
        textwrap.dedent("""
        import sys, pathlib
        import gymnasium as gym, numpy as np
        import windy_helper
        from tupli_mcap.environment import capture

        SCALE = 3.0

        class Mine(gym.Env):
            observation_space = gym.spaces.Box(-1, 1, (1,))
            action_space = gym.spaces.Discrete(2)
            def reset(self, *, seed=None, options=None):
                return np.zeros(1, np.float32), {}
            def step(self, action):
                return np.zeros(1, np.float32), windy_helper.push(SCALE), False, False, {}

        record = capture(gym.wrappers.TimeLimit(Mine(), 5))
        pathlib.Path(sys.argv[1]).write_bytes(record.pickle)
        pathlib.Path(sys.argv[2]).write_bytes(record.to_json())
        """)
    )
    paths = [str(tmp_path / "env.cloudpickle"), str(tmp_path / "benchmark.json")]
    subprocess.run([sys.executable, str(script), *paths], check=True, cwd=tmp_path)
    script.unlink()
    record = EnvironmentRecord.from_json(Path(paths[1]).read_bytes(), Path(paths[0]).read_bytes())
    assert record.classes == ("gymnasium.wrappers.common:TimeLimit", "__main__:Mine")
    # A module used through its name needs the module; the class itself came along.
    sys.path.insert(0, str(tmp_path))
    try:
        built = build(record, trust=True)
    finally:
        sys.path.remove(str(tmp_path))
        sys.modules.pop("windy_helper", None)
    built.reset()
    assert built.step(0)[1] == 13.0


# --- trust ---


def test_a_pickle_runs_only_if_trusted() -> None:
    record = capture(Counter())
    with pytest.raises(
        UntrustedError,
        match=rf"bytes of pickled Python code .*Counter.*tupli-mcap trust FILE.*{record.digest}",
    ):
        build(record)
    build(record, trust=True)
    trust.trust(record.digest)
    assert build(record).unwrapped.start == 0.0  # type: ignore[attr-defined]
    changed = dataclasses.replace(record, pickle=(record.pickle or b"") + b".")
    with pytest.raises(UntrustedError, match="pickled Python code"):
        build(changed)


def test_a_foreign_spec_builds_nothing() -> None:
    spec = dict(capture(gym.make("CartPole-v1")).spec or {})
    cases = {
        r"registered here as": {**spec, "entry_point": "os:system"},
        r"not registered here": {**spec, "id": "Unheard-v0"},
        r"'module:Unheard-v0', an id that is not": {**spec, "id": "module:Unheard-v0"},
        r"the wrapper 'os:system', none of those that need no trust": {
            **spec,
            "additional_wrappers": [{"name": "x", "entry_point": "os:system", "kwargs": {}}],
        },
        r"the wrapper 'gymnasium.wrappers.rendering:RecordVideo'": {
            **spec,
            "additional_wrappers": [
                {
                    "name": "x",
                    "entry_point": "gymnasium.wrappers.rendering:RecordVideo",
                    "kwargs": {"video_folder": "/x"},
                }
            ],
        },
        r"the wrapper 'None'": {**spec, "additional_wrappers": [3]},
        r"additional wrappers of type str": {**spec, "additional_wrappers": "os:system"},
    }
    for message, foreign in cases.items():
        with pytest.raises(UntrustedError, match=message):
            build(EnvironmentRecord("CartPole-v1", spec=foreign))


def test_arguments_that_may_name_files_or_code_need_trust() -> None:
    """Some environments open files or make other environments by names that they are given."""
    spec = dict(capture(gym.make("FrozenLake-v1", map_name="8x8")).spec or {})
    assert spec["kwargs"] == {"map_name": "8x8"}
    build(EnvironmentRecord("FrozenLake-v1", spec=spec))
    build(
        EnvironmentRecord(
            "FrozenLake-v1", spec={**spec, "kwargs": {"desc": ["SF", "FG"], "is_slippery": False}}
        )
    )
    for value in (
        "evil_module:Env-v0",
        "os.system",
        "../x.xml",
        "~",
        "a\nb",
        ["S", {"deep": ["http://x"]}],
        {"a.b": 1},
    ):
        foreign = {**spec, "kwargs": {"map_name": value}}
        with pytest.raises(
            UntrustedError, match=r"the argument 'map_name', which holds .* may name a file or code"
        ):
            build(EnvironmentRecord("FrozenLake-v1", spec=foreign))
    limit = {
        "name": "T",
        "entry_point": "gymnasium.wrappers:TimeLimit",
        "kwargs": {"max_episode_steps": "a/b"},
    }
    with pytest.raises(
        UntrustedError, match=r"the argument 'max_episode_steps' of the wrapper 'T', which holds 'a/b'"
    ):
        build(EnvironmentRecord("FrozenLake-v1", spec={**spec, "additional_wrappers": [limit]}))
    record = EnvironmentRecord("FrozenLake-v1", spec={**spec, "kwargs": {"map_name": "a/b"}})
    with pytest.raises(TupliError, match=r"cannot be rebuilt here .*KeyError"):
        build(record, trust=True)


def test_numbers_that_may_fill_the_memory_need_trust() -> None:
    spec = dict(capture(gym.make("CartPole-v1")).spec or {})

    def stacked(size: int) -> EnvironmentRecord:
        entry_point = "gymnasium.wrappers.stateful_observation:FrameStackObservation"
        stack = {"name": "F", "entry_point": entry_point, "kwargs": {"stack_size": size}}
        return EnvironmentRecord("CartPole-v1", spec={**spec, "additional_wrappers": [stack]})

    assert build(stacked(4)).observation_space.shape == (4, 4)
    with pytest.raises(
        UntrustedError, match="'stack_size' of the wrapper 'F', which holds 100000000 and may be a size"
    ):
        build(stacked(10**8))
    for value in (1 << 21, -(1 << 21), [[1], {"a": 1 << 400}]):
        with pytest.raises(UntrustedError, match="the argument 'length', which holds .* may be a size"):
            build(EnvironmentRecord("CartPole-v1", spec={**spec, "kwargs": {"length": value}}))
    for value in (1 << 20, 1e300, True, [1, 2.5]):
        with pytest.raises(TupliError, match="unexpected keyword argument 'length'"):  # it was tried
            build(EnvironmentRecord("CartPole-v1", spec={**spec, "kwargs": {"length": value}}))


def test_no_window_opens_without_trust() -> None:
    spec = dict(capture(gym.make("CartPole-v1")).spec or {})
    for mode in ("human", "a window", ["human"], 3):
        record = EnvironmentRecord("CartPole-v1", spec={**spec, "kwargs": {"render_mode": mode}})
        assert build(record).render_mode is None
        assert build(record, render_mode="rgb_array").render_mode == "rgb_array"
    pictures = EnvironmentRecord("CartPole-v1", spec={**spec, "kwargs": {"render_mode": "rgb_array"}})
    assert build(pictures).render_mode == "rgb_array"
    trust.trust(record.digest)
    with pytest.raises(TupliError, match=r"cannot be rebuilt here"):
        build(record)  # with the mode that it has
    window = {"name": "H", "entry_point": "gymnasium.wrappers.rendering:HumanRendering", "kwargs": {}}
    with pytest.raises(UntrustedError, match="the wrapper 'gymnasium.wrappers.rendering:HumanRendering'"):
        build(EnvironmentRecord("CartPole-v1", spec={**pictures.spec, "additional_wrappers": [window]}))  # type: ignore[dict-item]


def test_registered_arguments_are_known_here() -> None:
    gym.register("TupliNamed-v0", entry_point=f"{__name__}:Counter", kwargs={"start": "a.b/c"})
    try:
        spec = {"id": "TupliNamed-v0", "entry_point": f"{__name__}:Counter", "kwargs": {"start": "a.b/c"}}
        build(EnvironmentRecord("x", spec=spec))
        with pytest.raises(UntrustedError, match="may name a file or code"):
            build(EnvironmentRecord("x", spec={**spec, "kwargs": {"start": "a.b/d"}}))
    finally:
        del gym.registry["TupliNamed-v0"]


def test_naming_a_wrapper_imports_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    """`gymnasium.wrappers` imports some of its wrappers (and PyTorch, JAX) when it is asked for their names."""
    spec = dict(capture(gym.make("CartPole-v1")).spec or {})
    before = set(sys.modules)
    for name in ("JaxToNumpy", "JaxToTorch", "NumpyToTorch"):
        wrapper = {"name": name, "entry_point": f"gymnasium.wrappers:{name}", "kwargs": {}}
        with pytest.raises(UntrustedError, match=f"the wrapper 'gymnasium.wrappers:{name}'"):
            build(EnvironmentRecord("CartPole-v1", spec={**spec, "additional_wrappers": [wrapper]}))
    assert set(sys.modules) == before


def test_the_vector_entry_point_is_this_machine_s() -> None:
    spec = dict(capture(gym.make("CartPole-v1")).spec or {})
    built = build(EnvironmentRecord("CartPole-v1", spec={**spec, "vector_entry_point": "os:system"}))
    assert built.spec is not None
    assert built.spec.vector_entry_point == gym.spec("CartPole-v1").vector_entry_point


def test_a_spec_that_does_not_build_is_one_error() -> None:
    spec = dict(capture(gym.make("CartPole-v1")).spec or {})
    with pytest.raises(TupliError, match=r"cannot be rebuilt here with Python .*nonsense"):
        build(EnvironmentRecord("CartPole-v1", spec={**spec, "kwargs": {"nonsense": 1}}))


def test_a_pickle_of_something_else_is_refused() -> None:
    with pytest.raises(TupliError, match=r"expected a gymnasium\.Env .* found int"):
        build(EnvironmentRecord("x", pickle=pickle.dumps(3)), trust=True)
    with pytest.raises(TupliError, match="cannot be rebuilt here"):
        build(EnvironmentRecord("x", pickle=b"nonsense"), trust=True)


def test_one_flipped_byte_of_an_environment_ends_its_trust() -> None:
    record = capture(Counter())
    trust.trust(record.digest)
    build(record)
    pickled = record.pickle or b""
    for i in range(0, len(pickled), 11):
        changed = bytearray(pickled)
        changed[i] ^= 1
        with pytest.raises(UntrustedError):
            build(dataclasses.replace(record, pickle=bytes(changed)))


def test_all_that_a_spec_says_is_in_its_digest() -> None:
    """Every change of what decides which code runs, and with which arguments, is another environment."""
    wrapper = {"name": "T", "entry_point": "evil:Wrapper", "kwargs": {"a": [1, {"b": "c"}]}}
    spec = {"id": "Evil-v0", "entry_point": "evil:Env", "kwargs": {"x": 1}, "additional_wrappers": [wrapper]}
    trust.trust(EnvironmentRecord("x", spec=spec).digest)
    changes: list[dict[str, Any]] = [
        {"id": "Evil-v1"},
        {"entry_point": "evil:Other"},
        {"entry_point": None},
        {"vector_entry_point": "evil:Env"},
        {"kwargs": {"x": 2}},
        {"kwargs": {"x": 1.5}},
        {"kwargs": {"x": "1"}},
        {"kwargs": {"x": 1, "y": None}},
        {"kwargs": {}},
        {"max_episode_steps": 3},
        {"additional_wrappers": []},
        {"additional_wrappers": [wrapper, wrapper]},
        {"additional_wrappers": [{**wrapper, "name": "U"}]},
        {"additional_wrappers": [{**wrapper, "entry_point": "evil:Wrapper2"}]},
        {"additional_wrappers": [{**wrapper, "kwargs": {"a": [1, {"b": "d"}]}}]},
        {"new_field": 1},
    ]
    for change in changes:
        changed = EnvironmentRecord("x", spec={**spec, **change})
        assert not trust.is_trusted(changed.digest), change
        with pytest.raises(UntrustedError):
            build(changed)
    assert trust.is_trusted(
        EnvironmentRecord("y", spec=spec, versions={"python": "2"}).digest
    )  # claims for people


def test_own_specs_with_telling_arguments_are_not_signed(tmp_path: Path) -> None:
    """Only a benchmark that is stored, or a pickle that is asked for, is signed as this user's own."""
    from tupli_mcap import FileStorage, RecordEpisodes, Recording, TupliEnvWrapper

    gym.register("TupliTold-v0", entry_point="gymnasium.envs.toy_text.frozen_lake:FrozenLakeEnv")
    try:
        env = gym.make("TupliTold-v0", desc=["SF.", "FFG"])
        with FileStorage(tmp_path / "lab") as storage, RecordEpisodes(env, tmp_path / "a.mcap") as recorded:
            wrapper = TupliEnvWrapper(gym.make("TupliTold-v0", desc=["SF.", "FFG"]), storage)
            recorded.reset(seed=0)
            recorded.step(0)
            recorded.flush()
            with Recording(tmp_path / "a.mcap") as recording:
                assert recording.benchmark.record.spec is not None
                with pytest.raises(UntrustedError, match="may name a file or code"):
                    recording.benchmark.make_env()
                wrapper.store(name="lake")
                recording.benchmark.make_env()
                trust.untrust(recording.benchmark.record.digest)
                with pytest.raises(UntrustedError, match="may name a file or code"):
                    recording.benchmark.make_env()
    finally:
        del gym.registry["TupliTold-v0"]


# --- benchmark.json ---


def test_json_round_trip() -> None:
    for record in (capture(gym.make("CartPole-v1")), capture(Counter())):
        again = EnvironmentRecord.from_json(
            record.to_json({"id": "x", "metadata": {"größe": 1}}), record.pickle
        )
        assert again == dataclasses.replace(record, benchmark={"id": "x", "metadata": {"größe": 1}})
        assert again.digest == record.digest


def test_defects_in_benchmark_json_are_format_errors() -> None:
    record = capture(Counter())
    good = json.loads(record.to_json())

    def changed(**environment: Any) -> bytes:
        return json.dumps({**good, "environment": {**good["environment"], **environment}}).encode()

    cases: list[tuple[bytes, bytes | None, str]] = [
        (b"", None, "not a benchmark document"),
        (b"\xff\xfe", None, "not a benchmark document"),
        (b"[" * 100_000, None, "not a benchmark document"),
        (b"3", None, "not a benchmark document"),
        (json.dumps({**good, "version": 2}).encode(), record.pickle, "version"),
        (record.to_json(), None, "is missing beside it"),
        (record.to_json(), (record.pickle or b"")[:-1], "expected a pickled environment of"),
        (changed(digest="0" * 64), record.pickle, "expected an environment with digest 0000"),
        (changed(pickle=None), None, "expected an environment with digest"),
        (changed(spec={"id": "CartPole-v1"}), record.pickle, "found both"),
        (changed(spec=3), record.pickle, "environment.spec"),
        (changed(spec={"id": float("nan")}, pickle=None), None, "not strict JSON"),
    ]
    for data, beside, message in cases:
        with pytest.raises(FormatError, match=message):
            EnvironmentRecord.from_json(data, beside)


@settings(max_examples=200, deadline=None)
@given(data=st.data())
def test_a_damaged_document_is_the_right_one_or_a_format_error(data: st.DataObject) -> None:
    good = bytearray(GOOD.to_json())
    for _ in range(data.draw(st.integers(1, 3))):
        good[data.draw(st.integers(0, len(good) - 1))] = data.draw(st.integers(0, 255))
    try:
        record = EnvironmentRecord.from_json(bytes(good), GOOD.pickle)
    except FormatError:
        return
    assert record.digest == GOOD.digest


GOOD = EnvironmentRecord(
    "cart", spec={"id": "CartPole-v1", "kwargs": {"a": [1, 2.5, None]}}, versions={"python": "3"}
)


def test_what_was_changed_is_captured() -> None:
    env = gym.make("CartPole-v1")
    env.unwrapped.gravity = 5.0  # type: ignore[attr-defined]
    env.unwrapped.secret = None  # type: ignore[attr-defined]
    copy = build(capture(env), trust=True)
    assert vars(copy.unwrapped)["gravity"] == 5.0
    assert vars(copy.unwrapped)["secret"] is None
