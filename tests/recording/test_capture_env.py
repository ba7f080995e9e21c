"""What a recording and a benchmark say of their environment, and that nobody else's is made, used or closed for it."""

from __future__ import annotations

import gc
import sys
import threading
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.utils import EzPickle
from gymnasium.vector import AsyncVectorEnv, SyncVectorEnv
from typer.testing import CliRunner

from tupli_mcap import FileStorage, RecordEpisodes, Recording, TupliEnvWrapper, trust
from tupli_mcap.cli import app
from tupli_mcap.environment import EnvironmentRecord, build, note
from tupli_mcap.errors import RecordingError, StorageError, TupliError, UntrustedError
from tupli_mcap.recording.check.verify import verify_recording
from tupli_mcap.schema import F
from tupli_mcap.storage.benchmark_json import unpack
from tupli_mcap.vector import RecordEpisodes as RecordVector
from tupli_mcap.wrappers.rollout import record_rollouts

ID = "tests/Robot-v0"


class Robot(gym.Env[Any, Any]):
    """Counts what happens to any of its kind. No two are the same: each draws its noise when it is made."""

    observation_space = gym.spaces.Box(-1, 1, (1,), np.float32)
    action_space = gym.spaces.Discrete(2)
    metadata = {"render_modes": ["rgb_array"], "render_fps": 10}
    happened: Counter[str] = Counter()

    def __init__(self, port: int = 1, render_mode: str | None = None) -> None:
        self.port = port
        self.render_mode = render_mode
        self.noise = np.random.rand(3)
        self.happened["made"] += 1

    def reset(self, *, seed: int | None = None, options: Any = None) -> tuple[Any, dict[str, Any]]:
        super().reset(seed=seed)
        self.happened["reset"] += 1
        return np.zeros(1, np.float32), {}

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        self.happened["step"] += 1
        return np.zeros(1, np.float32), 1.0, False, False, {}

    def render(self) -> Any:
        self.happened["render"] += 1
        return np.zeros((2, 2, 3), np.uint8)

    def close(self) -> None:
        self.happened["close"] += 1


class EzRobot(Robot, EzPickle):
    """A copy of its pickle is made by its constructor, as MuJoCo's environments are."""

    def __init__(self, port: int = 1, render_mode: str | None = None) -> None:
        EzPickle.__init__(self, port, render_mode)
        super().__init__(port, render_mode)


@pytest.fixture(autouse=True)
def _world(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    monkeypatch.setenv("TUPLI_MCAP_CONFIG_DIR", str(tmp_path / "config"))
    gym.register(ID, entry_point=f"{__name__}:Robot", max_episode_steps=50)
    gym.register("tests/EzRobot-v0", entry_point=f"{__name__}:EzRobot")
    Robot.happened.clear()
    yield
    del gym.registry[ID], gym.registry["tests/EzRobot-v0"]


KINDS = {
    "registered": lambda: gym.make(ID, port=7, render_mode="rgb_array"),
    "registered, pickles as its arguments": lambda: gym.make("tests/EzRobot-v0", port=7),
    "unregistered": lambda: Robot(7),
    "in wrappers": lambda: gym.wrappers.TransformReward(gym.make(ID), lambda reward: reward),
}


def noted(path: Path) -> EnvironmentRecord:
    with Recording(path) as recording:
        return recording.benchmark.record


def signatures(tmp_path: Path) -> list[Path]:
    return sorted((tmp_path / "config").glob("trusted/*"))


# --- nobody else's environment ---


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("capture_env", ["spec", "pickle", None])
def test_wrapping_makes_and_closes_no_other(kind: str, capture_env: Any, tmp_path: Path) -> None:
    env = KINDS[kind]()
    draws = np.random.get_state()[2]
    recorder = RecordEpisodes(env, tmp_path / "r.mcap", capture_env=capture_env)
    assert Robot.happened == {"made": 1}
    assert np.random.get_state()[2] == draws
    recorder.reset(seed=1)
    recorder.step(0)
    recorder.close()
    assert Robot.happened == {"made": 1, "reset": 1, "step": 1, "close": 1}


@pytest.mark.parametrize("kind", KINDS)
def test_storing_makes_and_closes_no_other(kind: str, tmp_path: Path) -> None:
    with FileStorage(tmp_path / "lab") as storage:
        env = TupliEnvWrapper(KINDS[kind](), storage)
        assert Robot.happened == {"made": 1}
        env.store(name="robot")
        if kind != "in wrappers":  # a lambda has no reference
            env.store(name="robot", by_reference=True)
        env.serialize_env(env.env)
        assert Robot.happened == {"made": 1}
        env.reset()
        env.step(0)
        env.close()
        assert Robot.happened == {"made": 1, "reset": 1, "step": 1, "close": 1}


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("capture_env", ["spec", "pickle", None])
def test_wrapping_sub_environments_makes_no_other(kind: str, capture_env: Any, tmp_path: Path) -> None:
    recorder = RecordVector(SyncVectorEnv([KINDS[kind]] * 2), tmp_path / "r.mcap", capture_env=capture_env)
    assert Robot.happened == {"made": 2}
    recorder.reset(seed=1)
    recorder.step(np.zeros(2, np.int64))
    recorder.close()
    assert Robot.happened == {"made": 2, "reset": 2, "step": 2, "close": 2}


def test_a_copy_is_made_for_who_changes_one_and_is_not_closed(tmp_path: Path) -> None:
    class Emptied(TupliEnvWrapper):
        def _serialize(self, env: gym.Env[Any, Any]) -> tuple[gym.Env[Any, Any], list[str]]:
            env.unwrapped.noise = None  # type: ignore[attr-defined]
            return env, []

    class Looked(TupliEnvWrapper):
        def _serialize(self, env: gym.Env[Any, Any]) -> tuple[gym.Env[Any, Any], list[str]]:
            assert env.unwrapped.noise is not None  # type: ignore[attr-defined]
            return env, []

    emptied = unpack(Emptied(gym.make("CartPole-v1"), None).serialize_env(gym.make("CartPole-v1")))
    assert emptied.record.pickle is not None
    env = KINDS["registered, pickles as its arguments"]()
    looked = Looked(env, None)
    assert Robot.happened == {"made": 1}
    assert unpack(looked.serialize_env(env, by_reference=True)).record.spec is not None
    assert Robot.happened["close"] == 0
    assert env.unwrapped.noise is not None


class Copied(TupliEnvWrapper):
    def _serialize(self, env: gym.Env[Any, Any]) -> tuple[gym.Env[Any, Any], list[str]]:
        env.unwrapped.seen = env.unwrapped.noise.copy()  # type: ignore[attr-defined]
        env.unwrapped.noise[:] = 0  # type: ignore[attr-defined]
        env.unwrapped.lock = None  # type: ignore[attr-defined]
        return env, []


@pytest.mark.parametrize("lock", [None, threading.Lock()], ids=["can be pickled", "holds a lock"])
def test_a_copy_shares_no_array_with_its_environment(lock: Any) -> None:
    env = Robot()
    env.lock, before = lock, env.noise.copy()  # type: ignore[attr-defined]
    wrapped = Copied(env, None)
    env.noise += 1
    text = wrapped.serialize_env(env)
    assert (env.noise == before + 1).all()
    stored: Any = build(unpack(text).record, trust=True).unwrapped
    assert (stored.seen == before).all() and (stored.noise == 0).all()


def test_an_environment_without_a_copy_is_only_refused_when_one_is_needed(tmp_path: Path) -> None:
    env = Robot()
    env.rule = np.frompyfunc(abs, 1, 1)  # type: ignore[attr-defined]  # pickles as a name that nobody has
    wrapped = Copied(env, tmp_path, benchmark_id="0" * 64)
    with pytest.raises(TupliError, match="Robot cannot be captured, since it cannot be pickled"):
        wrapped.serialize_env(env)


# --- what is noted ---


def test_the_spec_of_a_registered_environment_is_noted(tmp_path: Path) -> None:
    env = gym.wrappers.RescaleAction(gym.make("Pendulum-v1", g=9.0), np.float32(-1), np.float32(1))
    del env._saved_kwargs["min_action"], env._saved_kwargs["max_action"]  # NumPy's have no JSON
    with RecordEpisodes(env, tmp_path / "r.mcap") as recorder:
        recorder.reset(seed=1)
        recorder.step(recorder.action_space.sample())
    record = noted(tmp_path / "r.mcap")
    assert record.name == "Pendulum-v1" and record.pickle is None and record.spec is not None
    assert record.spec["kwargs"] == {"g": 9.0}
    assert [wrapper["name"] for wrapper in record.spec["additional_wrappers"]] == ["RescaleAction"]
    assert record.classes[0].endswith(":RescaleAction")
    assert record.classes[-1] == "gymnasium.envs.classic_control.pendulum:PendulumEnv"
    assert signatures(tmp_path) == []


def test_the_id_is_kept_where_arguments_have_no_json(tmp_path: Path) -> None:
    record_in(KINDS["in wrappers"](), tmp_path / "r.mcap")
    record = noted(tmp_path / "r.mcap")
    assert (record.name, record.spec, record.pickle) == (ID, None, None)
    record_in(KINDS["in wrappers"](), tmp_path / "p.mcap", capture_env="pickle")
    record = noted(tmp_path / "p.mcap")
    assert record.name == ID and record.pickle is not None


def record_in(env: gym.Env[Any, Any], path: Path, **options: Any) -> None:
    with RecordEpisodes(env, path, **options) as recorder:
        recorder.reset(seed=1)
        recorder.step(recorder.action_space.sample())


def test_reading_the_spec_copies_no_argument(tmp_path: Path) -> None:
    """Gymnasium copies the arguments of inner wrappers, and with a method the environment it is bound to."""
    env: Any = KINDS["registered, pickles as its arguments"]()
    env = gym.wrappers.TimeLimit(gym.wrappers.TransformReward(env, float), 9)
    env.env._saved_kwargs["func"] = env.unwrapped.render
    assert note(env).name == "tests/EzRobot-v0"
    assert Robot.happened == {"made": 1}


def test_an_unregistered_environment_is_named(tmp_path: Path) -> None:
    path = tmp_path / "r.mcap"
    record_in(Robot(), path)
    record = noted(path)
    assert (record.name, record.spec, record.pickle) == (f"{__name__}:Robot", None, None)
    assert record.classes == (f"{__name__}:Robot",)
    assert verify_recording(path).ok
    assert EnvironmentRecord.from_json(record.to_json()) == record
    with pytest.raises(
        TupliError, match=r"found only the names of its classes .*Robot\); record with capture_env="
    ):
        build(record, trust=True)
    for command, shown in (("info", "environment  Robot"), ("trust", f"{__name__}:Robot")):
        words = [command, str(path), *(["--show"] if command == "trust" else [])]
        assert shown in CliRunner().invoke(app, words).output
    result = CliRunner().invoke(app, ["verify", "--rerun", str(path)])
    assert result.exit_code == 1


def test_a_registered_class_is_noted_by_its_name(tmp_path: Path) -> None:
    gym.register("tests/Class-v0", entry_point=Robot, kwargs={"port": 3})
    try:
        record_in(gym.make("tests/Class-v0"), tmp_path / "r.mcap")
        record = noted(tmp_path / "r.mcap")
        assert record.spec is not None and record.spec["entry_point"] == f"{__name__}:Robot"
        assert build(record).unwrapped.port == 3  # type: ignore[attr-defined]
        assert (
            "Robot (as registered here)"
            in CliRunner().invoke(app, ["trust", "--show", str(tmp_path / "r.mcap")]).output
        )
        gym.registry["tests/Class-v0"].entry_point = EzRobot
        trust.untrust(record.digest)
        with pytest.raises(
            UntrustedError,
            match="the entry point .*:Robot' of 'tests/Class-v0', registered here as .*EzRobot",
        ):
            build(record)
    finally:
        del gym.registry["tests/Class-v0"]


def test_nothing_is_noted_where_nothing_is_to_be(tmp_path: Path) -> None:
    record_in(gym.make("CartPole-v1"), tmp_path / "r.mcap", capture_env=None)
    with Recording(tmp_path / "r.mcap") as recording:
        assert recording.attachments.keys() == {"run.json"}
        assert not recording.labels
        with pytest.raises(RecordingError, match="carries no environment"):
            _ = recording.benchmark
    record_in(gym.make("CartPole-v1"), tmp_path / "a.mcap", capture_env="pickle", attachments={})
    with Recording(tmp_path / "a.mcap") as recording:
        assert "benchmark.json" not in recording.attachments and recording.labels


def test_capture_env_is_one_of_three(tmp_path: Path) -> None:
    with pytest.raises(
        RecordingError, match=r"capture_env: expected 'spec', 'pickle' or None .*, found 'all'"
    ):
        RecordEpisodes(Robot(), tmp_path / "r.mcap", capture_env="all")  # type: ignore[arg-type]
    heavy = Robot()
    heavy.noise = np.random.rand(3 << 20)
    with pytest.raises(RecordingError, match="capture_env='pickle': expected at most 16777216 bytes"):
        RecordEpisodes(heavy, tmp_path / "r.mcap", capture_env="pickle")
    heavy.noise = (x for x in ())  # type: ignore[assignment]
    with pytest.raises(
        RecordingError, match="'pickle': .*Robot cannot be pickled.* __setstate__, or use capture_env='spec'"
    ):
        RecordEpisodes(heavy, tmp_path / "r.mcap", capture_env="pickle")
    assert list(tmp_path.glob("*.mcap*")) == []
    RecordEpisodes(heavy, tmp_path / "r.mcap").close()


@pytest.mark.skipif(
    not (3, 11) <= sys.version_info < (3, 13), reason="attributes are always as quick to reach"
)
def test_noting_an_environment_leaves_it_quick(tmp_path: Path) -> None:
    """Attributes of objects that were asked for their `__dict__` take longer to reach."""
    env: Any = gym.make("CartPole-v1")
    with RecordEpisodes(env, tmp_path / "r.mcap"):
        for layer in (env, env.env, env.env.env, env.unwrapped):
            assert not any(type(one) is dict and "spec" in str(one.keys()) for one in gc.get_referents(layer))


@pytest.mark.parametrize("how", ["sync", "async"])
def test_the_id_of_sub_environments(how: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def asked(*args: Any) -> Any:
        raise AssertionError("a sub-environment in another process was asked")

    monkeypatch.setattr(AsyncVectorEnv, "call_async", asked)
    envs = gym.make_vec(ID, num_envs=2, vectorization_mode=how, port=7)
    before = Counter(Robot.happened)  # `AsyncVectorEnv` makes one to see its spaces
    with RecordVector(envs, tmp_path / "r.mcap") as recorder:
        assert Robot.happened == before
        recorder.reset(seed=1)
        recorder.step(recorder.action_space.sample())
    record = noted(tmp_path / "r.mcap")
    assert record.name == ID and record.spec is not None
    assert record.spec["kwargs"] == {"port": 7}
    assert build(record).spec == gym.make(ID, port=7).spec


def test_sub_environments_that_nobody_knows(tmp_path: Path) -> None:
    envs = AsyncVectorEnv([Robot] * 2)
    with pytest.raises(
        RecordingError,
        match="found none in AsyncVectorEnv; make it with vectorization_mode",
    ):
        RecordVector(envs, tmp_path / "r.mcap", capture_env="pickle")
    with RecordVector(envs, tmp_path / "r.mcap") as recorder:
        recorder.reset(seed=1)
        recorder.step(recorder.action_space.sample())
    record = noted(tmp_path / "r.mcap")
    assert record.name == record.classes[0] == "gymnasium.vector.async_vector_env:AsyncVectorEnv"
    with pytest.raises(TupliError, match=r"of vector environments, those of gymnasium\.make_vec"):
        build(record)
    wrapped = gym.make_vec(
        ID, num_envs=2, vectorization_mode="async", wrappers=[lambda env: gym.wrappers.TimeLimit(env, 3)]
    )
    assert (note(wrapped).name, note(wrapped).spec) == (ID, None)
    wrapped.close()


# --- real environments that a copy does not reproduce ---


def test_atari_keeps_its_id(tmp_path: Path) -> None:
    gym.register_envs(pytest.importorskip("ale_py"))
    env = gym.make("ALE/Pong-v5", frameskip=2)
    record_in(env, tmp_path / "r.mcap")
    record = noted(tmp_path / "r.mcap")
    assert (
        record.name == "ALE/Pong-v5" and record.spec is not None and record.spec["kwargs"]["frameskip"] == 2
    )
    build(record).close()
    assert "ALE/Pong-v5" in CliRunner().invoke(app, ["info", str(tmp_path / "r.mcap")]).output
    envs = gym.make_vec("ALE/Pong-v5", num_envs=2, vectorization_mode="vector_entry_point")
    assert (note(envs).name, note(envs).spec) == ("ALE/Pong-v5", None)
    envs.close()
    with FileStorage(tmp_path / "lab") as storage:
        benchmark = TupliEnvWrapper(gym.make("ALE/Pong-v5"), storage).store(name="pong")
        TupliEnvWrapper(gym.make("CartPole-v1"), storage).store(name="pole")
        (header,) = storage.list_benchmarks(F("environment") == "ALE/Pong-v5")
        assert (header.id, header.environment) == (benchmark, "ALE/Pong-v5")
        assert storage.load_benchmark(benchmark).environment == "ALE/Pong-v5"
        trust.untrust(unpack(storage.load_benchmark(benchmark).serialized).record.digest)
        TupliEnvWrapper.load(storage, benchmark).close()


def test_mujoco_keeps_its_id(tmp_path: Path) -> None:
    pytest.importorskip("mujoco")
    record_in(gym.make("InvertedPendulum-v5", reset_noise_scale=0.02), tmp_path / "r.mcap")
    record = noted(tmp_path / "r.mcap")
    assert record.name == "InvertedPendulum-v5" and record.spec is not None
    stored = unpack(
        TupliEnvWrapper(gym.make("InvertedPendulum-v5"), None).serialize_env(gym.make("Hopper-v5"))
    )
    assert stored.record.name == "Hopper-v5" and stored.record.spec is not None
    build(record).close()


# --- trust ---


def test_only_a_stored_pickle_is_signed_and_once(tmp_path: Path) -> None:
    env, path = Robot(), tmp_path / "r.mcap"
    first = RecordEpisodes(env, path, capture_env="pickle")
    (signature,) = signatures(tmp_path)
    assert signature.name == noted(path).digest
    before = signature.stat().st_ino
    RecordEpisodes(env, tmp_path / "same.mcap", capture_env="pickle").close()
    for seed in range(3):
        first.reset(seed=seed)
        first.step(0)
        first.close()
        first = RecordEpisodes(
            env, path, mode="a", capture_env="pickle"
        )  # in another state, which is not stored
    first.close()
    record_in(env, tmp_path / "spec.mcap")
    record_in(gym.make("FrozenLake-v1", desc=["SF.", "FFG"]), tmp_path / "telling.mcap")
    assert signatures(tmp_path) == [signature] and signature.stat().st_ino == before
    with Recording(path) as recording:
        recording.benchmark.make_env()
        trust.untrust(recording.benchmark.record.digest)
        with pytest.raises(UntrustedError, match="pickled Python code"):
            recording.benchmark.make_env()


def test_what_this_user_recorded_is_rebuilt_where_nobody_registers_it(tmp_path: Path) -> None:
    """A shell imports no package of environments."""
    record_in(gym.make(ID, port=7), tmp_path / "r.mcap")
    spec = gym.registry.pop(ID)
    try:
        with Recording(tmp_path / "r.mcap") as recording:
            assert recording.benchmark.make_env().unwrapped.port == 7
            trust.untrust(recording.benchmark.record.digest)
            with pytest.raises(
                UntrustedError, match=f"'{__name__}:Robot' of '{ID}', an id that is not registered"
            ):
                recording.benchmark.make_env()
    finally:
        gym.registry[ID] = spec
    # what needs trust where it is registered, too, is not signed
    record_in(gym.make(ID, port="../port"), tmp_path / "telling.mcap")
    assert signatures(tmp_path) == []


def test_a_wrapper_without_arguments_in_the_spec(tmp_path: Path) -> None:
    record_in(gym.Wrapper(gym.make(ID)), tmp_path / "r.mcap")
    with pytest.raises(TupliError, match=r"lacks the arguments of .*:Wrapper .*capture_env='pickle'"):
        build(noted(tmp_path / "r.mcap"))


# --- without a storage, in one call, on the command line ---


def test_without_a_storage_an_environment_can_be_serialized(tmp_path: Path) -> None:
    env = TupliEnvWrapper(gym.make("CartPole-v1"), None)
    with FileStorage(tmp_path / "lab") as storage:
        made = TupliEnvWrapper.deserialize_env(env.serialize_env(env.env), storage)
        assert made.spec == env.spec
        with pytest.raises(StorageError, match=r"no storage; wrap it with TupliEnvWrapper\(env, storage\)"):
            env.store(name="cart")
        env.storage = storage
        env.store(name="cart")
    with pytest.raises(StorageError, match="expected the directory of a storage, found 'lab.mcap'"):
        TupliEnvWrapper(gym.make("CartPole-v1"), "lab.mcap")


@pytest.mark.parametrize("num_envs", [1, 2])
def test_rollouts_capture_what_they_are_told(num_envs: int, tmp_path: Path) -> None:
    for capture_env in ("spec", "pickle", None):
        path = tmp_path / f"{capture_env}.mcap"
        record_rollouts(ID, path, steps=10, num_envs=num_envs, capture_env=capture_env)  # type: ignore[arg-type]
        with Recording(path) as recording:
            assert ("benchmark.json" in recording.attachments) == (capture_env is not None)
            assert ("env.cloudpickle" in recording.attachments) == (capture_env == "pickle")
        if capture_env is not None:
            assert noted(path).name == ID
    assert Robot.happened["made"] == 3 * num_envs


def test_the_command_captures_what_it_is_told(tmp_path: Path) -> None:
    for option, carried in (("spec", {"benchmark.json"}), ("none", set())):
        path = tmp_path / f"{option}.mcap"
        command = ["record", "CartPole-v1", "-o", str(path), "--steps", "9", "--capture-env", option]
        assert CliRunner().invoke(app, command).exit_code == 0
        with Recording(path) as recording:
            assert recording.attachments.keys() & {"benchmark.json", "env.cloudpickle"} == carried
