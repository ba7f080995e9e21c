"""Reading: episodes, columns, slices, sources, appending, rewriting, and files that are no recordings."""

from __future__ import annotations

import copy
import io
import mmap
import os
import pickle
import time
import warnings
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from damaged import chunks, hit
from environments import Sampler, roll, same
from gymnasium import spaces
from mcap.records import Channel, Schema
from mcap.writer import Writer

from tupli_mcap import (
    EpisodeData,
    FormatError,
    RecordEpisodes,
    Recording,
    RecordingError,
    SpaceError,
    StepError,
    rewrite_recording,
    verify_recording,
    write_recording,
)
from tupli_mcap.mcap.container import Container

DICT = spaces.Dict(
    {"x": spaces.Box(-1, 1, (2, 2)), "t": spaces.Tuple((spaces.Discrete(3), spaces.MultiBinary(2)))}
)
TEXT = spaces.Dict({"note": spaces.Text(5), "x": spaces.Discrete(4)})
IMAGE = spaces.Box(0, 255, (5, 4, 3), np.uint8)
KINDS = {"box": spaces.Box(-1, 1, (3,), np.float64), "dict": DICT, "text": TEXT, "image": IMAGE}


class Mine(Recording):
    """A subclass of a user."""


def record(path: Path, kind: str = "box", steps: int = 60, **kwargs: Any) -> list[tuple[Any, ...]]:
    env = Sampler(KINDS[kind], spaces.Discrete(5, start=1))
    with RecordEpisodes(env, path, chunk_size=1200, **kwargs) as recorded:
        return roll(recorded, steps)


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return tmp_path / "r.mcap"


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("threads", [1, 3])
def test_columns_are_the_episodes_one_after_another(path: Path, kind: str, threads: int) -> None:
    taken = record(path, kind)
    recording = Recording(path)
    fields = ["states", "actions", "rewards", "terminals", "timeouts", "next_states"]
    columns = recording.read(fields=fields, threads=threads)
    assert columns.rewards.tolist() == [step[2] for step in taken]
    assert columns.episode_lengths.tolist() == [len(e) for e in recording.episodes]
    chosen = recording.read(episodes=[5, 2, 2], fields=fields, threads=threads)
    expected = [*recording.episodes[5], *recording.episodes[2], *recording.episodes[2]]
    assert chosen.rewards.tolist() == [step.reward for step in expected]
    nested = chosen.next_states["x"] if kind in ("dict", "text") else chosen.next_states
    singles = [recording.episodes[i].next_states for i in (5, 2, 2)]
    parts = [single["x"] if kind in ("dict", "text") else single for single in singles]
    assert np.array_equal(nested, np.concatenate(parts))


def test_only_the_fields_asked_for(path: Path) -> None:
    record(path)
    columns = Recording(path).read(fields=["rewards"])
    assert columns.states is None and columns.actions is None
    assert len(columns.rewards) == len(columns) == 60
    assert np.array_equal(Recording(path).read(fields=["reward"]).rewards, columns.rewards)
    with pytest.raises(RecordingError, match="expected fields from states, actions, .*, found 'velocity'"):
        Recording(path).read(fields=["velocity"])
    with pytest.raises(RecordingError, match="expected episodes from 0 to 8, found"):
        Recording(path).read(episodes=[9])


def test_images_may_be_left_out(path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    taken = record(path, "image")
    with Recording(path) as recording:
        images = recording._topics["/image/state"]
        read: list[int] = []
        chunk = recording._store._chunk
        monkeypatch.setattr(
            recording._store, "_chunk", lambda i, *a, **kw: read.append(i) or chunk(i, *a, **kw)
        )
        columns = recording.read(images=False)
        part = recording.read_steps(0, 1, 4, images=False)
        assert not set(read) & set(recording._store.chunks(images)) and read
        assert columns.states.shape == (0, *IMAGE.shape) == part.states.shape
        assert columns.actions.tolist() == [step[1] for step in taken]
        with pytest.raises(RecordingError, match="expected images=True for next_states"):
            recording.read(fields=["next_states"], images=False)


def test_actions_of_an_episode_read_none_of_its_pictures(path: Path) -> None:
    taken = record(path, "image")
    for chunk in chunks(path, "/image/state"):
        hit(path, chunk)
    first = Recording(path).episodes[0]
    assert first.actions.tolist() == [step[1] for step in taken[: len(first)]]
    assert first.rewards.sum() == first.return_ and first.terminals[-1]
    for read in (lambda: first.states, lambda: list(first)):
        with pytest.raises(FormatError, match="its CRC differs"):
            read()


def test_changed_columns_of_an_episode_with_pictures_are_its_steps(path: Path) -> None:
    record(path, "image")
    episode = Recording(path).episodes[0]
    episode.actions[0], episode.states[0] = 4, 7
    first = next(iter(episode))
    assert first.action == 4 and (first.state == 7).all()


@pytest.mark.parametrize("kind", KINDS)
def test_windows_of_an_episode(path: Path, kind: str) -> None:
    record(path, kind)
    episode = Recording(path).episodes[3]
    steps = list(episode)
    window = episode[2:5]
    assert window.rewards.tolist() == [step.reward for step in steps[2:5]]
    assert len(episode[5:2]) == 0
    assert episode[-2:].actions.tolist() == [step.action for step in steps[-2:]]
    with pytest.raises(RecordingError, match="expected consecutive steps, found a stride of 2"):
        episode[::2]


def test_episodes_are_a_sequence(path: Path) -> None:
    record(path)
    recording = Recording(path)
    episodes = recording.episodes
    assert [e.number for e in episodes[2:8:3]] == [2, 5]
    assert episodes[-1].number == len(episodes) - 1
    with pytest.raises(IndexError, match="expected an episode from 0 to 8, found 9"):
        episodes[9]
    assert repr(episodes[0]) == "<Episode 0: 7 steps, return 14, terminal>"
    assert "9 episodes, 60 steps" in repr(recording)


def test_opening_and_listing_touch_no_step_chunk(path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from tupli_mcap.recording.columns import chunk_store as chunks

    record(path)
    monkeypatch.setattr(chunks.ChunkStore, "_read", lambda *_: pytest.fail("a chunk was read"))
    recording = Recording(path)
    assert len([(e.return_, e.end, len(e), e.metadata) for e in recording.episodes]) == 9


def test_arrays_belong_to_the_caller(path: Path) -> None:
    record(path)
    recording = Recording(path)
    recording.read(episodes=[0]).states[:] = 99
    assert (recording.read(episodes=[0]).states != 99).all()


# ---- sources


def test_open_files(path: Path) -> None:
    record(path)
    expected = Recording(path).read().states
    with path.open("rb") as file:
        assert np.array_equal(Recording(file).read(threads=3).states, expected)
    assert np.array_equal(Recording(io.BytesIO(path.read_bytes())).read().states, expected)
    with pytest.raises(RecordingError, match="expected a path, a URL or a seekable binary file"):
        Recording(7)  # type: ignore[arg-type]


class InPieces(io.RawIOBase):
    """A raw file whose reads return fewer bytes than asked for, as those of sockets do."""

    def __init__(self, data: bytes) -> None:
        self._file = io.BytesIO(data)

    def seek(self, offset: int, whence: int = os.SEEK_SET) -> int:
        return self._file.seek(offset, whence)

    def readinto(self, buffer: Any) -> int:
        data = self._file.read(min(len(buffer), 100))
        buffer[: len(data)] = data
        return len(data)


def test_other_open_files(path: Path) -> None:
    record(path)
    expected = Recording(path).read().states
    with path.open("rb") as file, mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as mapped:
        for source in (mapped, InPieces(path.read_bytes())):
            assert np.array_equal(Recording(source).read().states, expected)  # type: ignore[arg-type]
    for text in (path.open(encoding="utf-8"), io.StringIO("text")):
        with text, pytest.raises(RecordingError, match='expected a binary file.*open it with "rb"'):
            Recording(text)  # type: ignore[arg-type]
    for closed in (path.open("rb"), io.BytesIO(path.read_bytes())):
        with closed:
            recording = Recording(closed)
        with pytest.raises(RecordingError, match="is closed; open it again"):
            recording.read()


def test_a_closed_recording_says_so(path: Path) -> None:
    record(path)
    with Recording(path) as recording:
        pass
    with pytest.raises(RecordingError, match="is closed; open it again"):
        recording.read()


# ---- files that are no recordings


def foreign(path: Path) -> None:
    with path.open("wb") as file:
        writer = Writer(file)
        writer.start("ros2")
        schema = writer.register_schema("a/msg/B", "ros2msg", b"uint8 x")
        channel = writer.register_channel("/b", "cdr", schema)
        writer.add_message(channel, 1, b"\0\1\0\0\5", 1)
        writer.finish()


def test_other_files_get_one_clear_error(path: Path) -> None:
    with pytest.raises(RecordingError, match="does not exist; give the path of a recording"):
        Recording(path)
    with pytest.raises(RecordingError, match="is a directory; give one file"):
        Recording(path.parent)
    path.write_bytes(b"")
    with pytest.raises(FormatError, match="is empty; expected an MCAP recording"):
        Recording(path)
    path.write_bytes(b"PK\3\4" + bytes(100))
    with pytest.raises(FormatError, match="expected an MCAP file, found b'PK"):
        Recording(path)
    foreign(path)
    with pytest.raises(FormatError, match="is an MCAP file, but no tupli_mcap recording"):
        Recording(path)
    path.write_bytes(path.read_bytes()[:60])
    with pytest.raises(FormatError, match="no tupli_mcap recording|cut off or damaged"):
        Recording(path)


def test_a_damaged_attachment_is_found(path: Path) -> None:
    with RecordEpisodes(
        gym.make("CartPole-v1"), path, attachments={"note": ("text/plain", b"as it was")}
    ) as env:
        env.reset()
        env.step(0)
    data = path.read_bytes()
    assert data.count(b"as it was") == 1
    path.write_bytes(data.replace(b"as it was", b"as it is!"))
    with Recording(path) as recording, pytest.raises(FormatError, match="'note' at offset .* is damaged"):
        recording.read_attachment("note")


def test_a_flipped_bit_is_found(path: Path) -> None:
    record(path)
    data = path.read_bytes()
    whole = Recording(path).read(fields=["states", "actions", "rewards", "next_states"])
    rng = np.random.default_rng(0)
    refused = 0
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)
        for _ in range(300):
            changed = bytearray(data)
            changed[rng.integers(len(data))] ^= 1 << rng.integers(8)
            path.write_bytes(changed)
            try:
                found = Recording(path).read(fields=["states", "actions", "rewards", "next_states"])
            except FormatError:
                refused += 1
                continue
            n = 0 if found.states is None else len(found.states)
            assert n == 0 or np.array_equal(found.states, whole.states[:n])
            assert n == 0 or np.array_equal(found.actions, whole.actions[:n])
    assert refused > 50


# ---- appending


@pytest.mark.parametrize("kind", KINDS)
def test_appending_rewrites_nothing(path: Path, kind: str) -> None:
    first = record(path, kind)
    with_index = path.read_bytes()
    kept = Recording(path)._contents.data_end
    second = record(path, kind, 40, mode="a")
    assert path.read_bytes()[:kept] == with_index[:kept]
    recording = Recording(path)
    steps = [step for episode in recording.episodes for step in episode]
    for step, (state, action, reward, *_) in zip(steps, first + second, strict=True):
        assert same(step.state, state)
        assert (step.action, step.reward) == (action, reward)
    assert [e.number for e in recording.episodes] == list(range(len(recording.index)))


def test_appending_to_something_else_is_refused(path: Path) -> None:
    record(path, benchmark_id="a" * 64)
    before = path.read_bytes()
    with pytest.raises(SpaceError, match="expected the recorded observation_space .* record to another file"):
        RecordEpisodes(Sampler(DICT, spaces.Discrete(5, start=1)), path, mode="a")
    with pytest.raises(RecordingError, match="holds episodes of benchmark 'aaaa"):
        RecordEpisodes(Sampler(KINDS["box"], spaces.Discrete(5, start=1)), path, mode="a", benchmark_id="b")
    assert len(Recording(path).index) == 9
    assert np.array_equal(Recording(path).read().states, Recording(io.BytesIO(before)).read().states)
    foreign(path)
    with pytest.raises(FormatError, match="no tupli_mcap recording"):
        RecordEpisodes(gym.make("CartPole-v1"), path, mode="a")


def test_appended_values_must_fit_the_recorded_dtypes(path: Path) -> None:
    record(path)
    with RecordEpisodes(Sampler(KINDS["box"], spaces.Discrete(5, start=1)), path, mode="a") as env:
        env.reset()
        with pytest.raises(
            StepError, match="action: expected values that int64 holds exactly, found float64 1.5"
        ):
            env.step(1.5)


# ---- rewriting


@pytest.mark.parametrize("kind", KINDS)
def test_rewriting_keeps_what_is_asked_for(path: Path, kind: str) -> None:
    record(path, kind, record_info=True)
    source = Recording(path)
    target = path.with_name("t.mcap")
    rewrite_recording(
        source, target, episodes=[1, 4, 5], attachments={"artifacts/a": ("text/plain", b"hello")}
    )
    rewritten = Recording(target)
    assert [e.number for e in rewritten.episodes] == [1, 4, 5]
    for episode in rewritten.episodes:
        old = source.episodes[episode.number]
        assert all(same(a, b) for a, b in zip(episode, old, strict=True))
        assert same(episode.final_state, old.final_state)
        assert (episode.seed, episode.end, episode.start_time) == (old.seed, old.end, old.start_time)
        assert episode.infos == old.infos
    assert rewritten.uuid == source.uuid
    assert rewritten.read_attachment("artifacts/a") == b"hello"
    with pytest.raises(RecordingError, match="has no attachment 'x'; it has "):
        rewritten.read_attachment("x")


def test_recordings_from_values(path: Path) -> None:
    states = [np.arange(2.0) + i for i in range(3)]
    episodes = [
        EpisodeData(
            states, [0, 1, 0], [1, 2.5, -1], [False] * 3, [False, False, True], final_state=states[0]
        ),
        EpisodeData(
            states[:2], [1, 1], [0, 0], [False, True], [False] * 2, metadata={"score": np.float64(3)}
        ),
    ]
    write_recording(
        path, episodes, observation_space=spaces.Box(0, 9, (2,), np.float64), action_space=spaces.Discrete(2)
    )
    first, second = Recording(path).episodes
    assert (first.end, second.end) == ("timeout", "terminal")
    assert same(first.final_state, states[0])
    assert second.final_state is None
    assert np.array_equal(second.next_states, [states[1], states[1]])  # not known: the last state again
    assert second.metadata == {"score": 3.0}
    with pytest.raises(StepError, match="expected as many states, actions"):
        write_recording(
            path,
            [EpisodeData([], [], [], [], [])],
            observation_space=KINDS["box"],
            action_space=spaces.Discrete(2),
            mode="w",
        )


def test_episodes_are_chosen_by_positions_or_a_mask(path: Path) -> None:
    record(path, "box")
    recording = Recording(path)
    n = len(recording)
    mask = np.arange(n) % 2 == 1
    expected = recording.read(episodes=np.flatnonzero(mask).tolist()).states
    for chosen in (mask, mask.tolist(), np.flatnonzero(mask).astype(np.uint8), range(1, n, 2)):
        assert np.array_equal(recording.read(episodes=chosen).states, expected)
    for wrong in ([1.5], 2, mask[:-1], ["1"], slice(1, 2), recording.episodes[:2], [[0, 1]]):
        with pytest.raises(RecordingError, match="expected a list of positions from 0 to"):
            recording.read(episodes=wrong)
    for not_fields in ([0, 1], mask, np.arange(2), 1):
        with pytest.raises(RecordingError, match="expected fields from states, actions"):
            recording.read(not_fields)
    assert np.array_equal(recording.read(["rewards"]).rewards, recording.dataset.read(["rewards"]).rewards)
    assert np.array_equal(recording.read(episodes=[]).states, expected[:0])
    assert np.array_equal(recording.read(fields="states").states, recording.read().states)


def test_starts_of_several_episodes(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    with RecordEpisodes(Sampler(gym.spaces.Discrete(3), gym.spaces.Discrete(3), 4), path) as env:
        for seed in range(5):
            env.reset(seed=seed)
            env.step(0)
    with Recording(path) as recording:
        assert [start.seed for start in recording.episode_starts([3, 0, 1])] == ["3", "0", "1"]
        assert recording.episode_starts([4]) == [recording.episode_start(4)]
        assert recording.episode_starts(np.array([True, False, False, True, False]))[1].episode == 3
        assert recording.episode_starts([]) == []
        with pytest.raises(RecordingError, match="expected episodes from 0 to 4"):
            recording.episode_starts([5])


@pytest.mark.parametrize(
    "space",
    [
        gym.spaces.Box(-1, 1, (2,)),
        gym.spaces.Dict({"frame": gym.spaces.Box(0, 255, (4, 4, 3), np.uint8), "n": gym.spaces.Discrete(5)}),
        gym.spaces.Tuple((gym.spaces.Text(8), gym.spaces.Box(-1, 1, (0,)), gym.spaces.Box(-1, 1, (1, 1)))),
    ],
    ids=["box", "image", "text"],
)
def test_final_states_and_times_as_columns(tmp_path: Path, space: gym.Space[Any]) -> None:
    path = tmp_path / "a.mcap"
    before = time.time_ns()
    with RecordEpisodes(Sampler(space, gym.spaces.Discrete(3), 4), path) as env:
        roll(env, 18)
    with Recording(path) as recording:
        finals = recording.final_states([3, 0, 1])
        columns = recording.read(fields=["times"])
        one = recording.read_steps(1, 1, 3, ["times"])
        assert same(
            recording.read_steps(1, 1, 3, ["observations"]).states, recording.read_steps(1, 1, 3).states
        )
        for field in ("next_states", "infos", "frames"):
            with pytest.raises(RecordingError, match=f"expected fields from states, .*, found '{field}'"):
                recording.read_steps(1, 1, 3, [field])
        leaves = recording.layout.state
        for leaf in leaves:
            for place, i in enumerate([3, 0, 1]):
                assert same(leaf.get(recording.final_state(i)), leaf.get(finals)[place])
        assert columns.times.dtype == np.int64 and len(columns.times) == 18
        assert (np.diff(columns.times) >= 0).all() and before < columns.times[0] <= time.time_ns()
        assert same(one.times, columns.times[5:7])
        assert (recording.index["start_time"][1:4] <= columns.times[[4, 8, 12]]).all()
        assert (columns.times[[3, 7, 11, 15]] <= recording.index["end_time"][:4]).all()
        with pytest.raises(RecordingError, match="expected episodes from 0 to 4"):
            recording.final_states([5])
        for leaf in leaves:
            assert len(leaf.get(recording.final_states([]))) == 0


def test_a_final_state_that_is_not_known_is_no_column(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    steps = EpisodeData([0, 1], [0, 1], [0.0, 0.0], [False, True], [False, False])
    write_recording(
        path, [steps], observation_space=gym.spaces.Discrete(3), action_space=gym.spaces.Discrete(3)
    )
    with Recording(path) as recording, pytest.raises(RecordingError, match="of episode 0 is not known"):
        recording.final_states([0])


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"infos": [{"a": 1}]}, "an info for each of 2 steps, or None, found 1"),
        ({"infos": [{"a": 1}] * 3}, "an info for each of 2 steps, or None, found 3"),
        ({"seed": 1.5}, "seed: expected an integer or None, found 1.5"),
        ({"seed": float("nan")}, "seed: expected an integer or None, found nan"),
    ],
)
def test_infos_and_the_seed_by_hand_fit(given: Any, message: str, tmp_path: Path) -> None:
    space = gym.spaces.Discrete(2)
    steps = EpisodeData([0] * 2, [0] * 2, [0.0] * 2, [False] * 2, [False] * 2, **given)
    with pytest.raises(StepError, match=message):
        write_recording(tmp_path / "a.mcap", [steps], observation_space=space, action_space=space)
    assert verify_recording(tmp_path / "a.mcap").problems == []


def test_a_seed_by_hand_may_be_a_bool(tmp_path: Path) -> None:
    space = gym.spaces.Discrete(2)
    steps = EpisodeData([0], [0], [0.0], [True], [False], seed=True)
    write_recording(tmp_path / "a.mcap", [steps], observation_space=space, action_space=space)
    assert verify_recording(tmp_path / "a.mcap").problems == []
    with Recording(tmp_path / "a.mcap") as recording:
        assert recording.seeds == [1]


def test_a_changed_info_is_changed_for_nobody_else(tmp_path: Path) -> None:
    space = gym.spaces.Discrete(2)
    infos = [{"force": np.arange(2), "said": {"a": 1}}, {}, {"x": 1}]
    steps = EpisodeData([0] * 3, [0] * 3, [0.0] * 3, [False] * 3, [False] * 3, infos=infos)
    write_recording(tmp_path / "a.mcap", [steps], observation_space=space, action_space=space)
    with Recording(tmp_path / "a.mcap") as recording:
        for first in (recording.infos(0), recording[0].infos, recording.read(["infos"]).infos):
            assert first is not None
            first[0]["force"][:] = 9
            first[0]["said"]["a"] = 9
            del first[2]["x"]
        for found in (recording.infos(-1), recording[0].infos):
            assert repr(found) == "[{'force': array([0, 1]), 'said': {'a': 1}}, None, {'x': 1}]"


def test_a_copy_of_a_subclass_is_of_the_subclass(path: Path) -> None:
    record(path)
    with Mine(path, cache_bytes=1 << 20) as recording:
        for copied in (copy.copy(recording), pickle.loads(pickle.dumps(recording))):
            assert type(copied) is Mine and copied.uuid == recording.uuid
            copied.close()


@pytest.mark.parametrize("ask", ["infos", "frames", "final_state", "resets_before"])
def test_an_episode_that_does_not_exist(ask: str, path: Path) -> None:
    record(path)
    with Recording(path) as recording:
        last = getattr(recording, ask)(len(recording) - 1)
        assert repr(getattr(recording, ask)(-1)) == repr(last)
        for i in (len(recording), -len(recording) - 1):
            with pytest.raises(
                IndexError, match=f"expected an episode from 0 to {len(recording) - 1}, found {i}"
            ):
                getattr(recording, ask)(i)


@pytest.mark.parametrize("flag", ["terminal", "timeout"])
def test_flags_by_hand_are_set_at_the_last_step_only(flag: str, tmp_path: Path) -> None:
    space = gym.spaces.Discrete(2)
    flags = {name: [False, name == flag, False] for name in ("terminal", "timeout")}
    steps = EpisodeData([0] * 3, [0] * 3, [0.0, 0.0, "x"], flags["terminal"], flags["timeout"])
    with pytest.raises(StepError, match=f"false before the last step, 2, found {flag} at step 1; make an ep"):
        write_recording(tmp_path / "a.mcap", [steps], observation_space=space, action_space=space)
    with Recording(tmp_path / "a.mcap") as recording:
        assert len(recording) == 0


def test_new_channels_get_ids_of_their_own() -> None:
    """Also behind those of a file whose ids have gaps."""
    container = Container(-1, "r.mcap", "zstd")
    for schema, channel in ((3, 7), (8, 2)):
        container.schemas[schema] = Schema(schema, b"", "ros2msg", f"s{schema}")
        container.channels[channel] = Channel(channel, f"/{channel}", "cdr", {}, schema)
    assert container.add_schema("new", "") == 9
    assert container.add_channel("/new", 9, {}) == 8
    assert len(container.channels) == 3
