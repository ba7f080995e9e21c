"""Recordings replayed on real environments: what agrees, what does not, and what is said of it."""

from __future__ import annotations

import copy
import json
import re
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import gymnasium as gym
import jsonschema
import numpy as np
import pytest
from command_line import run
from crafted import set_flags
from cryptography.hazmat.primitives import serialization as ser
from cryptography.hazmat.primitives.asymmetric import ed25519
from environments import Sampler
from gymnasium.envs.classic_control import CartPoleEnv
from sample_spaces import SPACES, space_id

from tupli_mcap import (
    EpisodeData,
    FileStorage,
    RecordEpisodes,
    Recording,
    RecordingError,
    StepError,
    TupliEnvWrapper,
    UntrustedError,
    rewrite_recording,
    trust,
    write_recording,
)
from tupli_mcap.environment import EnvironmentRecord, note
from tupli_mcap.recording.edit.attach import add_attachments
from tupli_mcap.recording.edit.repair.recover import recover_recording
from tupli_mcap.recording.sign.sign import sign_recording
from tupli_mcap.reexecute import Certificate, attempt, certify, render
from tupli_mcap.signing import SigningKey
from tupli_mcap.wrappers.vector import RecordEpisodes as RecordVectorEpisodes

SCHEMA = jsonschema.Draft202012Validator(
    json.loads(Path(__file__, "../../../schemas/replay-certificate.schema.json").resolve().read_text())
)


def roll(env: gym.Env[Any, Any], steps: int, seed: int | None = 1) -> None:
    """The usual loop: one seed at the start, none after it."""
    env.action_space.seed(0)
    env.reset(seed=seed)
    for _ in range(steps):
        _, _, terminal, timeout, _ = env.step(env.action_space.sample())
        if terminal or timeout:
            env.reset()


def record(
    path: Path, env: gym.Env[Any, Any], steps: int = 100, seed: int | None = 1, mode: Any = "x"
) -> Path:
    """With the EnvSpec of Gymnasium's own environments, and of others the pickle."""
    own = all(name.startswith("gymnasium.") for name in note(env).classes)
    with RecordEpisodes(env, path, mode=mode, capture_env="spec" if own else "pickle") as recorder:
        roll(recorder, steps, seed)
    return path


def forge(source: Path, target: Path, change: Callable[[int, EpisodeData], EpisodeData | None]) -> Path:
    """The same episodes by hand, changed; None leaves one out."""
    with Recording(source) as recording:
        attachments = {
            name: (info.media_type, recording.read_attachment(name))
            for name, info in recording.attachments.items()
        }
        episodes = []
        for i, episode in enumerate(recording.episodes):
            columns = {
                name: np.array(getattr(episode, name))
                for name in ("states", "actions", "rewards", "terminals", "timeouts")
            }
            given = EpisodeData(**columns, final_state=episode.final_state, seed=episode.seed)
            changed = change(i, given)
            if changed is not None:
                episodes.append(changed)
        spaces = {"observation_space": recording.observation_space, "action_space": recording.action_space}
    write_recording(target, episodes, **spaces, attachments=attachments)
    return target


def check_complete(certificate: Certificate) -> None:
    assert certificate.agrees and certificate.complete
    assert certificate.first is None and not certificate.skipped


@pytest.mark.parametrize("seed", [1, None])
@pytest.mark.parametrize(
    "name",
    [
        "CartPole-v1",
        "Pendulum-v1",
        "MountainCar-v0",
        "FrozenLake-v1",
        "Taxi-v4",
        "Blackjack-v1",
        "Acrobot-v1",
    ],
)
def test_an_environment_agrees_with_its_recording(tmp_path: Path, name: str, seed: int | None) -> None:
    path = record(tmp_path / "a.mcap", gym.make(name), 250, seed)
    certificate = certify(path)
    check_complete(certificate)
    assert certificate.environment == name
    assert certificate.agreed.steps == 250
    assert certificate.versions["gymnasium"] == certificate.recorded_versions["gymnasium"]


@pytest.mark.parametrize("seed", [3, None])
@pytest.mark.parametrize("mode", list(gym.vector.AutoresetMode))
def test_sub_environments_agree_one_by_one(
    tmp_path: Path, mode: gym.vector.AutoresetMode, seed: int | None
) -> None:
    made = gym.make_vec("FrozenLake-v1", 3, "sync", vector_kwargs={"autoreset_mode": mode})
    with RecordVectorEpisodes(made, tmp_path / "a.mcap") as env:
        env.action_space.seed(0)
        env.reset(seed=seed)
        for _ in range(100):
            _, _, terminals, timeouts, _ = env.step(env.action_space.sample())
            if mode == gym.vector.AutoresetMode.DISABLED and (terminals | timeouts).any():
                env.reset(options={"reset_mask": terminals | timeouts})
    certificate = certify(tmp_path / "a.mcap")
    check_complete(certificate)
    assert certificate.agreed.episodes > 20


def test_one_changed_reward_is_found_at_its_place(tmp_path: Path) -> None:
    path = record(tmp_path / "a.mcap", gym.make("CartPole-v1"))

    def change(i: int, episode: EpisodeData) -> EpisodeData:
        if i == 2:
            episode.rewards[5] = np.nextafter(1.0, 2.0)
        return episode

    certificate = certify(forge(path, tmp_path / "b.mcap", change))
    assert not certificate.agrees
    assert certificate.diverged.episodes == 1
    assert certificate.agreed.episodes == certificate.recorded.episodes - 1  # the others are still compared
    first = certificate.first
    assert first is not None
    assert (first.kind, first.episode, first.step, first.leaf) == ("value", 2, 5, "reward")
    assert (first.expected, first.found) == ("1.0000000000000002", "1.0")
    assert first.largest_difference == 2.0**-52 and first.largest_step == 5
    assert first.differing_steps == 1


def test_a_state_is_compared_bit_for_bit(tmp_path: Path) -> None:
    path = record(tmp_path / "a.mcap", gym.make("CartPole-v1"), 40)
    with Recording(path) as recording:
        length = len(recording.episodes[1])

    def change(i: int, episode: EpisodeData) -> EpisodeData:
        if i == 1:
            episode.states[3, 2] += 0.5
            episode.states[7, 2] = np.nan
            episode.final_state = -np.asarray(episode.final_state)
        return episode

    first = certify(forge(path, tmp_path / "b.mcap", change)).first
    assert first is not None
    assert (first.episode, first.step, first.path) == (1, 3, "state[2]")
    assert first.largest_difference is None  # of NaN there is none
    assert first.differing_steps == 3 and first.length == length
    assert float(first.expected) == pytest.approx(float(first.found) + 0.5)


def test_no_more_steps_differ_than_an_episode_has(tmp_path: Path) -> None:
    path = record(tmp_path / "a.mcap", gym.make("CartPole-v1"), 40)

    def change(i: int, episode: EpisodeData) -> EpisodeData:
        episode.states[:] += 1
        episode.final_state = np.asarray(episode.final_state) + 1
        return episode

    first = certify(forge(path, tmp_path / "b.mcap", change)).first
    assert first is not None
    assert first.differing_steps == first.length


def test_a_different_end_is_named(tmp_path: Path) -> None:
    path = record(tmp_path / "a.mcap", gym.make("CartPole-v1"), 60)
    first = certify(set_flags(path, 0, 4, terminal=True)).first
    assert first is not None
    assert (first.kind, first.step, first.leaf, first.expected, first.found) == (
        "end", 4, "terminal", "True", "False"
    )  # fmt: skip
    assert "were not compared" in first.hint


def test_an_unseeded_episode_after_a_missing_one_is_skipped(tmp_path: Path) -> None:

    path = record(tmp_path / "a.mcap", gym.make("CartPole-v1"), 120)
    with Recording(path) as recording:
        numbers = [int(n) for n in recording.index["episode"]]
        rewrite_recording(recording, tmp_path / "b.mcap", episodes=[n for n in numbers if n != 1])
    certificate = certify(tmp_path / "b.mcap")
    assert certificate.agrees and not certificate.complete
    assert certificate.agreed.episodes == 1
    (skipped,) = certificate.skipped
    assert (skipped.kind, skipped.first, skipped.episodes) == ("no_predecessor", 2, len(numbers) - 2)


def test_some_episodes_are_checked_with_what_they_go_on_from(tmp_path: Path) -> None:
    path = record(tmp_path / "a.mcap", gym.make("FrozenLake-v1"), 100)
    certificate = certify(path, episodes=[2, 5])
    assert certificate.agrees and not certificate.complete
    assert certificate.chosen == certificate.agreed
    assert certificate.chosen.episodes == 2
    with pytest.raises(RecordingError, match="has no episode 999; choose from 0 to"):
        certify(path, episodes=[999])


class HiddenRandomness(gym.Env[Any, Any]):
    """Draws from NumPy's global generator, which no seed of a reset reaches."""

    observation_space = gym.spaces.Box(-np.inf, np.inf, (2,), np.float64)
    action_space = gym.spaces.Discrete(2)

    def reset(self, *, seed: int | None = None, options: Any = None) -> tuple[Any, dict[str, Any]]:
        super().reset(seed=seed)
        return self.np_random.normal(size=2), {}

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        return np.random.normal(size=2), 0.0, False, False, {}


def test_hidden_randomness_is_named(tmp_path: Path) -> None:
    path = record(tmp_path / "a.mcap", HiddenRandomness(), 20)
    certificate = certify(path)
    SCHEMA.validate(json.loads(certificate.to_json()))
    first = certificate.first
    assert first is not None
    assert (first.episode, first.step, first.path) == (0, 1, "state[0]")
    assert first.differing_steps == 19
    assert "not deterministic" in first.hint and "np.random" in first.hint


def test_code_from_a_stranger_is_not_run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = record(tmp_path / "a.mcap", HiddenRandomness(), 20)
    monkeypatch.setenv("TUPLI_MCAP_CONFIG_DIR", str(tmp_path / "stranger"))
    with pytest.raises(UntrustedError, match="bytes of pickled Python code"):
        certify(path)
    assert certify(path, trust=True).chosen.episodes == 1
    assert certify(path, env=HiddenRandomness()).environment_digest == ""


@pytest.mark.parametrize("seed", [7, None])
def test_resets_without_a_step_are_repeated(tmp_path: Path, seed: int | None) -> None:
    with RecordEpisodes(gym.make("Blackjack-v1"), tmp_path / "a.mcap") as env:
        env.reset(seed=seed)
        env.reset()  # the seed's own episode has no step, its random stream goes on
        for _ in range(30):
            _, _, terminal, timeout, _ = env.step(1)
            if terminal or timeout:
                env.reset()
                env.reset()
    check_complete(certify(tmp_path / "a.mcap"))


class StopsOnce(gym.Wrapper[Any, Any, Any, Any]):
    """Raises in its first step, once the environment has drawn from its random stream."""

    stops = True

    def step(self, action: Any) -> Any:
        result = self.env.step(action)
        if self.stops:
            self.stops = False
            raise TimeoutError("no answer")
        return result


@pytest.mark.parametrize("envs", [0, 2])
def test_the_random_stream_after_a_first_step_that_failed_is_not_known(tmp_path: Path, envs: int) -> None:
    def make() -> gym.Env[Any, Any]:
        return StopsOnce(gym.make("Blackjack-v1"))

    many = gym.vector.SyncVectorEnv([make] * envs) if envs else None
    path = tmp_path / "a.mcap"
    with RecordEpisodes(make(), path) if many is None else RecordVectorEpisodes(many, path) as env:
        actions = np.ones(envs, np.int64) if envs else 1
        env.reset(seed=7)
        with pytest.raises(TimeoutError, match="no answer"):
            env.step(actions)
        if many is not None:
            many.envs[1].stops = False  # type: ignore[attr-defined]
        env.reset()
        env.step(actions)
    certificate = certify(path, env=gym.make("Blackjack-v1"))
    assert certificate.first is None and certificate.agreed.episodes == 0
    assert [skipped.kind for skipped in certificate.skipped] == ["unseeded"]


@pytest.mark.parametrize("mode", list(gym.vector.AutoresetMode))
def test_resets_of_a_vector_environment_in_mid_episode_are_repeated(
    tmp_path: Path, mode: gym.vector.AutoresetMode
) -> None:
    made = gym.make_vec("Blackjack-v1", 2, "sync", vector_kwargs={"autoreset_mode": mode})
    with RecordVectorEpisodes(made, tmp_path / "a.mcap") as env:
        env.action_space.seed(0)
        env.reset(seed=1)
        for _ in range(15):
            env.reset()
            env.step(env.action_space.sample())  # some end here: same-step has reset them already
    check_complete(certify(tmp_path / "a.mcap"))


def test_sessions_are_told_apart(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    record(path, gym.make("Blackjack-v1"), 20, seed=1)
    record(path, gym.make("Blackjack-v1"), 20, seed=None, mode="a")  # which draws its own seed
    record(path, gym.make("Blackjack-v1"), 20, seed=5, mode="a")
    check_complete(certify(path))
    used = gym.make("Blackjack-v1")
    used.reset(seed=99)
    record(path, used, 20, seed=None, mode="a")
    certificate = certify(path)
    assert certificate.agrees and not certificate.complete
    (skipped,) = certificate.skipped
    assert skipped.kind == "unseeded"
    assert certificate.agreed.steps >= 60


def test_an_unseeded_episode_after_a_refused_step_stands_alone(tmp_path: Path) -> None:
    with RecordEpisodes(gym.make("Pendulum-v1"), tmp_path / "a.mcap") as env:
        env.reset(seed=1)
        env.step(np.array([0.5], np.float32))
        with pytest.raises(StepError, match="action: expected values that float32 holds exactly"):
            env.step(np.array([0.1], np.float64))
        env.reset()
        env.step(np.array([0.5], np.float32))
    with Recording(tmp_path / "a.mcap") as recording:
        assert [reset.continued for reset in recording.resets_before(1)] == [True]
    check_complete(certify(tmp_path / "a.mcap"))  # Pendulum draws in resets only


def test_rewriting_keeps_what_replaying_needs(tmp_path: Path) -> None:
    with RecordEpisodes(gym.make("Blackjack-v1"), tmp_path / "a.mcap") as env:
        env.reset(seed=3)
        roll(env, 20, seed=None)
    with Recording(tmp_path / "a.mcap") as recording:
        assert [reset.seed for reset in recording.resets_before(0)] == ["3"]
        rewrite_recording(recording, tmp_path / "b.mcap")
    check_complete(certify(tmp_path / "b.mcap"))


# --- the certificate ---


def test_a_certificate_tells_which_episodes_it_is_of(tmp_path: Path) -> None:
    path = record(tmp_path / "a.mcap", gym.make("CartPole-v1"), 50)
    before = certify(path)
    SCHEMA.validate(json.loads(before.to_json()))
    with Recording(path) as recording:
        rewrite_recording(recording, tmp_path / "b.mcap")
    assert certify(tmp_path / "b.mcap").content_sha256 == before.content_sha256
    record(path, gym.make("CartPole-v1"), 50, seed=2, mode="a")
    after = certify(path)
    assert after.recording == before.recording
    assert after.content_sha256 != before.content_sha256


@pytest.mark.parametrize(
    "text", [b"{}", b"\xff", b'{"format": "tupli_mcap.replay_certificate", "version": 2}']
)
def test_a_certificate_in_a_file_is_an_attachment_like_any_other(tmp_path: Path, text: bytes) -> None:
    path = record(tmp_path / "a.mcap", gym.make("CartPole-v1"), 20)
    add_attachments(path, {"replay-certificate.json": ("application/json", text)})
    for command in (["info"], ["verify", "--rerun"], ["episodes"]):
        code, out, err = run(*command, path)
        assert (code, err) == (0, ""), command
        assert "\ncertificate" not in out
    assert "replay-certificate.json" in run("info", path)[1]
    check_complete(certify(path))


def test_nothing_is_attached_to_an_unfinished_recording(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    env = RecordEpisodes(gym.make("CartPole-v1"), path)
    roll(env, 20)
    certificate = certify(path)  # a live recording can be replayed as far as it is
    assert certificate.agrees
    with pytest.raises(RecordingError, match="is being recorded by another writer"):
        add_attachments(path, {"a.json": ("application/json", b"{}")})
    env.close()


def test_a_certificate_names_the_benchmark(tmp_path: Path) -> None:
    storage = FileStorage(tmp_path / "lab")
    env = TupliEnvWrapper(gym.make("CartPole-v1"), storage)
    env.reset(seed=5)
    env.store(name="cartpole")
    roll(env, 60, seed=None)
    env.close()
    path = env.recording_path
    assert path is not None
    certificate = certify(path)
    check_complete(certificate)
    assert certificate.benchmark_id == env.id


def test_a_repaired_recording_keeps_what_replaying_needs(tmp_path: Path) -> None:
    with RecordEpisodes(gym.make("Blackjack-v1"), tmp_path / "a.mcap") as env:
        env.reset(seed=3)
        roll(env, 20, seed=None)
    recover_recording(tmp_path / "a.mcap", tmp_path / "b.mcap")
    check_complete(certify(tmp_path / "b.mcap"))


# --- options of resets ---

GIVEN: list[Any] = []


class Levels(CartPoleEnv):
    """Notes the options that it is given; others would open the file that one of them names."""

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> Any:
        GIVEN.append(options)
        return super().reset(seed=seed)


LEVELS = {"id": "tests/Levels-v0", "entry_point": f"{__name__}:Levels"}


@pytest.fixture
def levels() -> Iterator[dict[str, tuple[str, bytes]]]:
    """The attachments of an environment that is registered here."""
    gym.register(**LEVELS)  # type: ignore[arg-type]
    GIVEN.clear()
    yield {"benchmark.json": ("application/json", EnvironmentRecord("Levels", spec=LEVELS).to_json())}
    del gym.registry[LEVELS["id"]]


def record_levels(path: Path, attachments: Any, *options: Any) -> Path:
    """An episode of three steps for each of the options, all with a seed but the last."""
    with RecordEpisodes(gym.make("tests/Levels-v0"), path, attachments=attachments) as env:
        for i, given in enumerate(options):
            env.reset(seed=None if i and i == len(options) - 1 else i, options=given)
            for _ in range(3):
                env.step(0)
    GIVEN.clear()
    return path


@pytest.mark.parametrize(
    "value",
    [
        *("../level.txt", "module:Level-v0", b"/etc/passwd", ["a", {"b": ("~",)}], {"a.b": 1}),
        *(np.array(["x", "a/b"]), {1: 1 << 21}, np.int64(1 << 40), [np.array([3, -(1 << 30)])]),
    ],
    ids=repr,
)
def test_options_that_are_more_than_data_need_trust(tmp_path: Path, levels: Any, value: Any) -> None:
    harmless = {"level": "8x8", "low": -0.05, "size": 64, "mask": np.array([1, 0], np.int8)}
    path = record_levels(tmp_path / "a.mcap", levels, harmless, {"level": value}, None)
    for found in (certify(path), certify(path, env=gym.make("tests/Levels-v0"))):
        assert found.agrees and not found.complete
        assert found.agreed.episodes == 1
        (skipped,) = found.skipped
        assert (skipped.kind, skipped.first, skipped.episodes) == ("untrusted", 1, 2)
        SCHEMA.validate(json.loads(found.to_json()))
    assert GIVEN and all(given is None or given["level"] == "8x8" for given in GIVEN)
    check_complete(certify(path, trust=True))
    assert any(given and str(given["level"]) == str(value) for given in GIVEN)


def test_rendering_gives_no_such_options_either(tmp_path: Path, levels: Any) -> None:
    path = record_levels(tmp_path / "a.mcap", levels, None, {"level": "../x"}, None)
    report = render(path, tmp_path / "new.mcap", episodes=[0, 1])
    assert [skipped.kind for skipped in report.skipped] == ["untrusted"]
    assert [(episode.episode, episode.whole) for episode in report.episodes] == [(0, True)]
    assert {"level": "../x"} not in GIVEN
    assert render(path, tmp_path / "more.mcap", episodes=[0, 1], trust=True).ok


def test_options_are_trusted_with_their_file(tmp_path: Path, levels: Any) -> None:
    path = record_levels(tmp_path / "a.mcap", levels, {"level": "../x"}, None)
    other = record_levels(tmp_path / "b.mcap", levels, {"level": "../y"}, None)
    code, out, _ = run("verify", "--rerun", path)
    assert code == 1
    assert "2 episodes could not be checked, the first is 0: reset with options that need trust" in out
    shown = run("trust", path, "--show")[1]
    assert "options      of a reset hold '../x' and may name a file or code\n" in shown
    assert re.search("^trusted +no$", shown, re.MULTILINE)
    assert re.search("^trusted +yes$", run("trust", path)[1], re.MULTILINE)
    assert run("verify", "--rerun", path)[0] == 0
    assert run("verify", "--rerun", other)[0] == 1  # the same environment, from somebody else
    assert {"level": "../y"} not in GIVEN
    assert run("untrust", path)[0] == 0
    assert run("verify", "--rerun", path)[0] == 1
    assert json.loads(run("trust", "--list", "--json")[1])["result"]["digests"] == []


def test_options_are_trusted_where_a_trusted_key_signed_them(tmp_path: Path, levels: Any) -> None:
    path = record_levels(tmp_path / "a.mcap", levels, {"level": "../x"}, None)
    key = ed25519.Ed25519PrivateKey.generate()
    (tmp_path / "key").write_bytes(
        key.private_bytes(ser.Encoding.PEM, ser.PrivateFormat.PKCS8, ser.NoEncryption())
    )
    signed = sign_recording(path, SigningKey(tmp_path / "key"))
    assert not certify(path).agrees
    trust.trust_key(signed.public_key, "alice")
    check_complete(certify(path))


# --- environments of every kind ---


class Drifting(gym.Wrapper[Any, Any, Any, Any]):
    """Carries state from one episode to the next, whatever the seed."""

    def __init__(self, env: gym.Env[Any, Any]) -> None:
        super().__init__(env)
        self.taken = 0

    def step(self, action: Any) -> tuple[Any, Any, bool, bool, dict[str, Any]]:
        self.taken += 1
        state, reward, terminal, timeout, info = self.env.step(action)
        return state, float(reward) + self.taken, terminal, timeout, info


def test_a_pickled_environment_goes_on_from_its_captured_state(tmp_path: Path) -> None:
    inner = Drifting(gym.make("FrozenLake-v1"))
    roll(inner, 17, seed=4)
    with RecordEpisodes(inner, tmp_path / "a.mcap", capture_env="pickle") as env:
        for seed in (None, 5, 5, None, 6):
            env.reset(seed=seed)
            done = False
            while not done:
                _, _, terminal, timeout, _ = env.step(env.action_space.sample())
                done = terminal or timeout
    certificate = certify(tmp_path / "a.mcap")
    check_complete(certificate)
    assert certificate.versions["python"] == certificate.recorded_versions["python"]
    assert certify(tmp_path / "a.mcap", episodes=[4]).agrees  # which needs the wrapper's state from before


def test_running_statistics_are_repeated(tmp_path: Path) -> None:
    inner = gym.wrappers.NormalizeReward(gym.wrappers.NormalizeObservation(gym.make("Pendulum-v1")))
    check_complete(certify(record(tmp_path / "a.mcap", inner, 450)))


def test_episodes_that_an_autoreset_wrapper_starts(tmp_path: Path) -> None:
    inner = gym.wrappers.Autoreset(gym.make("FrozenLake-v1"))
    with RecordEpisodes(inner, tmp_path / "a.mcap") as env:
        env.reset(seed=1)
        for _ in range(100):
            env.step(2)
    certificate = certify(tmp_path / "a.mcap")
    check_complete(certificate)
    assert certificate.agreed.episodes > 5


@pytest.mark.filterwarnings("ignore:.*You are calling 'step")
def test_episodes_without_a_reset_and_with_options(tmp_path: Path) -> None:
    with RecordEpisodes(gym.make("CartPole-v1"), tmp_path / "a.mcap") as env:
        env.reset(seed=1, options={"low": -0.2, "high": 0.2})
        for _ in range(40):  # goes on after its end
            env.step(0)
        env.reset(options={"low": 0.0, "high": 0.01})
        env.step(1)
    certificate = certify(tmp_path / "a.mcap")
    check_complete(certificate)
    assert certificate.agreed.episodes > 5


@pytest.mark.sampled(5)
@pytest.mark.parametrize("space", SPACES, ids=space_id)
def test_every_space(tmp_path: Path, space: gym.Space[Any]) -> None:
    env = Sampler(
        space, copy.deepcopy(space), length=4
    )  # an action space of its own, with a generator of its own
    check_complete(certify(record(tmp_path / "a.mcap", env, 14, seed=2)))


class Breaking(gym.Env[Any, Any]):
    """Raises at a step that the recording has, if it is told to."""

    observation_space = gym.spaces.Dict(
        {"pos": gym.spaces.Box(-9, 9, (2,), np.float64), "n": gym.spaces.Discrete(9)}
    )
    action_space = gym.spaces.Discrete(2)
    breaks_at: int | None = None
    breaks_with: BaseException = RuntimeError("no more\nfuel")
    places = 9

    def reset(self, *, seed: int | None = None, options: Any = None) -> tuple[Any, dict[str, Any]]:
        super().reset(seed=seed)
        self.steps = 0
        return self._state(), {}

    def _state(self) -> Any:
        return {"pos": self.np_random.normal(size=2)[: self.places], "n": self.steps % 9}

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        if self.steps == self.breaks_at:
            raise self.breaks_with
        self.steps += 1
        return self._state(), 0.0, False, False, {}


def test_an_error_of_the_environment_is_a_divergence(tmp_path: Path) -> None:
    path = record(tmp_path / "a.mcap", Breaking(), 10)
    check_complete(certify(path))
    broken = Breaking()
    broken.breaks_at = 6
    first = certify(path, env=broken).first
    assert first is not None
    assert (first.kind, first.step, first.found) == ("error", 6, "RuntimeError: no more fuel")


def test_an_environment_that_exits_does_not_agree(tmp_path: Path) -> None:
    path = record(tmp_path / "a.mcap", Breaking(), 10)
    leaving = Breaking()
    leaving.breaks_at, leaving.breaks_with = 6, SystemExit(0)
    first = certify(path, env=leaving).first
    assert first is not None
    assert (first.kind, first.step, first.found) == ("error", 6, "SystemExit: 0")


def test_another_shape_is_a_divergence_at_its_key(tmp_path: Path) -> None:
    path = record(tmp_path / "a.mcap", Breaking(), 10)
    other = Breaking()
    other.places = 1
    first = certify(path, env=other).first
    assert first is not None
    assert (first.step, first.leaf, first.path) == (0, "state_pos", "state.pos")
    assert "expected shape (2,), found shape (1,)" in first.found
    assert first.largest_difference is None


def test_an_environment_with_other_spaces_is_refused(tmp_path: Path) -> None:
    path = record(tmp_path / "a.mcap", gym.make("CartPole-v1"), 10)
    with pytest.raises(RecordingError, match="expected an environment with the observation_space"):
        certify(path, env=gym.make("Pendulum-v1"))


def test_other_spaces_of_many_dimensions_are_told_in_short(tmp_path: Path) -> None:
    def timed(limit: int) -> gym.Env[Any, Any]:
        return gym.wrappers.TimeAwareObservation(gym.make("Taxi-v4", max_episode_steps=limit))

    path = record(tmp_path / "a.mcap", timed(200), 10)
    told = re.escape("Box(0, 1..200, (501,), int64), found Box(0, 1..13, (501,), int64)")
    with pytest.raises(RecordingError, match=f"the observation_space {told}$"):
        certify(path, env=timed(13))


def test_a_recording_without_an_environment(tmp_path: Path) -> None:
    with RecordEpisodes(gym.make("CartPole-v1"), tmp_path / "a.mcap", attachments={}) as env:
        roll(env, 20)
    with pytest.raises(RecordingError, match="carries no environment"):
        certify(tmp_path / "a.mcap")
    check_complete(certify(tmp_path / "a.mcap", env=gym.make("CartPole-v1")))


def test_a_recording_without_episodes(tmp_path: Path) -> None:
    env = gym.make("CartPole-v1")
    spaces = {"observation_space": env.observation_space, "action_space": env.action_space}
    write_recording(tmp_path / "a.mcap", [], **spaces)
    certificate = certify(tmp_path / "a.mcap", env=env)
    assert not certificate.agrees and not certificate.complete
    assert certificate.recorded.episodes == 0


class Choosy(gym.Env[Any, Any]):
    """Takes Python's integers only."""

    observation_space = gym.spaces.Discrete(100)
    action_space = gym.spaces.Discrete(2)

    def reset(self, *, seed: int | None = None, options: Any = None) -> tuple[Any, dict[str, Any]]:
        super().reset(seed=seed)
        self.total = 0
        return self.total, {}

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        if type(action) is not int:
            raise TypeError(f"expected an int, found {action!r}")
        self.total += action
        return self.total, 0.0, False, False, {}


def test_actions_may_have_been_pythons_numbers(tmp_path: Path) -> None:
    with RecordEpisodes(Choosy(), tmp_path / "a.mcap", capture_env="pickle") as env:
        for seed in (1, None, 2):
            env.reset(seed=seed)
            for action in (0, 1, 1):
                env.step(action)
    check_complete(certify(tmp_path / "a.mcap"))


def test_several_episodes_may_differ(tmp_path: Path) -> None:
    path = record(tmp_path / "a.mcap", gym.make("CartPole-v1"), 300)

    def change(i: int, episode: EpisodeData) -> EpisodeData:
        if i in (2, 5, 8):
            episode.rewards[1] = 2.0
        return episode

    certificate = certify(forge(path, tmp_path / "b.mcap", change))
    assert [divergence.episode for divergence in certificate.divergences] == [2, 5, 8]
    assert certificate.agreed.episodes == certificate.recorded.episodes - 3
    assert str(certificate.first) == "episode 2 diverges at step 1: reward is 2.0 recorded, 1.0 in the rerun"


# --- the command line ---


def test_verify_replay(tmp_path: Path) -> None:
    path = record(tmp_path / "a.mcap", gym.make("CartPole-v1"), 100)
    before = path.read_bytes()
    code, out, err = run("verify", "--rerun", path)
    with Recording(path) as recording:
        episodes = len(recording)
    assert (code, err) == (0, "")
    assert f"{path}: all {episodes} episodes (100 steps) agree bit for bit\n  run again in" in out
    assert path.read_bytes() == before
    code, out, err = run("verify", "--rerun", "--json", path)
    assert (code, err) == (0, "")
    (told,) = json.loads(out)["result"]["reruns"]
    assert (told.pop("path"), told.pop("agrees")) == (str(path), True)
    assert told.pop("error") is None
    told = told.pop("certificate")
    SCHEMA.validate(told)
    certificate = json.loads(certify(path).to_json())
    assert told == {**certificate, "created_ns": told["created_ns"]}
    assert path.read_bytes() == before


def test_verify_replay_of_what_differs_or_cannot_be_replayed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = record(tmp_path / "a.mcap", gym.make("CartPole-v1"), 100)

    def change(i: int, episode: EpisodeData) -> EpisodeData:
        if i == 1:
            episode.rewards[0] = 7.0
        return episode

    changed = forge(path, tmp_path / "b.mcap", change)
    code, out, err = run("verify", "--rerun", changed)
    assert (code, err) == (1, "")
    assert f"{changed}: episode 1 diverges at step 0: reward is 7.0 recorded, 1.0 in the rerun" in out
    assert "of reward by at most 6, at step 0" in out
    assert run("verify", "--rerun", "--episodes", "0,2-3", changed)[0] == 0
    pickled = record(tmp_path / "c.mcap", Drifting(gym.make("CartPole-v1")), 30)
    monkeypatch.setenv("TUPLI_MCAP_CONFIG_DIR", str(tmp_path / "stranger"))
    code, out, err = run("verify", "--rerun", pickled)
    assert code == 1
    assert "pickled Python code" in err and err.count("\n") == 1
    assert run("verify", "--rerun", "--trust", pickled)[0] == 0


@pytest.mark.parametrize(
    "args",
    [["--trust"], ["--episodes", "1"], ["--rerun", "--episodes", "1-x"], ["--rerun", "--filter", "a = 1"]],
)
def test_options_that_make_no_sense(tmp_path: Path, args: list[str]) -> None:
    code, out, err = run("verify", *args, tmp_path / "a.mcap")
    assert (code, out) == (2, "")
    assert err.count("\n") == 1


@pytest.mark.parametrize("block", [1, 500, 5000])
def test_long_episodes_are_read_in_parts(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, block: int) -> None:
    monkeypatch.setattr(attempt, "_BLOCK", block)
    path = record(tmp_path / "a.mcap", gym.make("Pendulum-v1"), 250)
    check_complete(certify(path))

    def change(i: int, episode: EpisodeData) -> EpisodeData:
        if i == 0:
            episode.states[150, 1] = 0.5
        return episode

    first = certify(forge(path, tmp_path / "b.mcap", change)).first
    assert first is not None
    assert (first.step, first.path, first.expected) == (150, "state[1]", "0.5")


def test_kept_resets_are_nothing_that_verify_minds(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    for seed in (1, None):  # the second session goes on from an unknown random state
        inner = gym.make("Blackjack-v1")
        inner.reset(seed=9)
        with RecordEpisodes(inner, path, mode="a" if path.exists() else "x") as env:
            env.reset(seed=seed)
            roll(env, 10, seed=None)
    code, out, err = run("verify", path)
    assert (code, err) == (0, "")
    assert out.startswith(f"{path}: ok")


# --- an environment of a module that others do not have ---


def test_the_code_of_an_own_environment(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "own_pole.py").write_text(
        "from gymnasium.envs.classic_control import CartPoleEnv\nclass OwnPole(CartPoleEnv): pass\n"
    )
    monkeypatch.chdir(tmp_path)
    with monkeypatch.context() as here:
        here.syspath_prepend(tmp_path)
        gym.register("tests/OwnPole-v0", entry_point="own_pole:OwnPole")
        for name, capture in (("spec", "spec"), ("pickle", "pickle")):
            with RecordEpisodes(gym.make("tests/OwnPole-v0"), f"{name}.mcap", capture_env=capture) as env:
                roll(env, 20)
        monkeypatch.setattr(
            sys.modules["__main__"], "OwnPole", sys.modules["own_pole"].OwnPole, raising=False
        )
        gym.register("tests/MainPole-v0", entry_point="__main__:OwnPole")
        for name, env in (
            ("main", gym.make("tests/MainPole-v0")),
            ("class", sys.modules["own_pole"].OwnPole()),
        ):
            with RecordEpisodes(env, f"{name}.mcap") as env:
                roll(env, 20)
            assert (
                "others cannot run it again: "
                in run("bundle", f"{name}.mcap", "-o", f"{name}-bundle.mcap")[1]
            )
    del sys.modules["own_pole"]
    del gym.registry["tests/MainPole-v0"]
    del gym.registry["tests/OwnPole-v0"]
    needs = "to run it again, others need own_pole, whose code is not in the file"
    assert needs in run("bundle", "spec.mcap", "-o", "spec-bundle.mcap")[1]
    assert "others need" not in run("bundle", "pickle.mcap", "-o", "pickle-bundle.mcap")[1]
    code, out, err = run("verify", "--rerun", "--trust", "spec-bundle.mcap", "pickle-bundle.mcap")
    assert (code, out.splitlines()[-2:]) == (1, ["2 of 2 undamaged", "1 of 2 agree when run again"])
    assert re.match("error: spec-bundle.mcap: the environment .* cannot be rebuilt here .*'own_pole'", err)
    assert err.endswith("Install that module, or name its directory in PYTHONPATH\n")
