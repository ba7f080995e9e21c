"""Parts of states and actions, such as "state.arm": read alone, they are what the whole has there."""

from __future__ import annotations

import pickle
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest

import tupli_mcap
from tupli_mcap import EpisodeWriter, SpaceError, TupliError
from tupli_mcap.dataset import open_columns
from tupli_mcap.dataset.columns import statistics
from tupli_mcap.dataset.items import RecordedSteps

ARM = gym.spaces.Dict({"q": gym.spaces.Box(-9, 9, (2,)), "v.x": gym.spaces.Box(-9, 9, (3,), np.float32)})
CAMERA = gym.spaces.Box(0, 255, (8, 6, 3), np.uint8)
NESTED = {"arm": ARM, "camera": CAMERA, "t": gym.spaces.Tuple([gym.spaces.Discrete(5), CAMERA])}
ACTION = gym.spaces.Dict({"grip": gym.spaces.Discrete(2), "move": gym.spaces.Box(-1, 1, (2,))})
STATES = {
    "of one size": gym.spaces.Dict(NESTED),
    "with a text": gym.spaces.Dict({**NESTED, "said": gym.spaces.Text(20)}),
}
PARTS = (
    ["state.arm"],
    ["state.arm.q", "state.camera"],
    ['observation.arm."v.x"', "states.t"],
    ["state.camera"],
)
Read = Callable[[Sequence[str]], Any]


def record(path: Path, space: gym.Space[Any], lengths: Sequence[int], seed: int) -> None:
    space.seed(seed)
    ACTION.seed(seed)
    with EpisodeWriter(path, space, ACTION) as writer:
        for length in lengths:
            writer.begin()
            for step in range(length):
                writer.step(space.sample(), ACTION.sample(), float(step), step == length - 1)
            writer.end(space.sample() if length % 2 else None)


@pytest.fixture(params=STATES, ids=STATES)
def runs(request: pytest.FixtureRequest, tmp_path: Path) -> Path:
    for seed in range(2):
        record(tmp_path / f"{seed}.mcap", STATES[request.param], [5, 4, 1], seed)
    return tmp_path


def cut(value: Any, parts: Sequence[Sequence[str]]) -> Any:
    """A nested value without what lies in none of the parts, by their keys."""
    if not isinstance(value, dict) or any(len(part) == 0 for part in parts):
        return value
    keys = [key for key in value if any(part[0] == key for part in parts)]
    return {key: cut(value[key], [part[1:] for part in parts if part[0] == key]) for key in keys}


def same(one: Any, other: Any) -> bool:
    if isinstance(one, dict):
        return list(one) == list(other) and all(same(one[key], other[key]) for key in one)
    if isinstance(one, tuple | list):
        return len(one) == len(other) and all(map(same, one, other))
    return bool(np.array_equal(one, other))


KEYS = {
    "state.arm": ["arm"],
    "state.arm.q": ["arm", "q"],
    "state.camera": ["camera"],
    'observation.arm."v.x"': ["arm", "v.x"],
    "states.t": ["t"],
}


@pytest.mark.parametrize("parts", PARTS, ids=str)
def test_parts_are_what_the_whole_has_there(runs: Path, parts: list[str], tmp_path: Path) -> None:
    dataset = tupli_mcap.open(runs)
    chosen = dataset.filter_steps("step > 0 or state.arm.q[0] > 0")
    rows = np.array([7, 0, 3, 3])
    readers: dict[str, Read] = {
        "recording": lambda fields: dataset[0].recording.read(fields),
        "dataset": dataset.read,
        "chosen": chosen.read,
        "windows": lambda fields: dataset.windows(3, pad="repeat", fields=fields)[rows],
        "chosen windows": lambda fields: chosen.windows(2, pad="zero", fields=fields)[rows],
        "transitions": lambda fields: dataset.transitions(fields=[*fields, "rewards"])[rows],
    }
    if "said" not in dataset[0].states:
        dataset.save_columns(tmp_path / "saved")
        saved = open_columns(tmp_path / "saved")
        readers["saved"] = lambda fields: saved.windows(3, pad="repeat", fields=fields)[rows]
    for name, read in readers.items():
        both = [*parts, *(f"next_state.{part.partition('.')[2]}" for part in parts)]
        whole, found = read(["states", "actions", "next_states"]), read([*both, "action.move"])
        keys = [KEYS[part] for part in parts]
        assert same(found.states, cut(whole.states, keys)), name
        assert same(found.actions, cut(whole.actions, [["move"]])), name
        assert same(found.next_states, cut(whole.next_states, keys)), name


def test_only_images_that_are_wanted_are_read(runs: Path) -> None:
    dataset = tupli_mcap.open(runs)
    windows = dataset.windows(2, fields=["state.arm", "actions"])
    again = pickle.loads(pickle.dumps(windows))
    assert same(again[:].states, windows[:].states)
    steps: Any = windows.source
    assert isinstance(steps, RecordedSteps)
    used = [bool(names) for names in steps._used]
    assert used == [True, False, False, False]  # steps, two images, final states


def test_statistics_read_no_image(tmp_path: Path) -> None:
    path = tmp_path / "r.mcap"
    space = gym.spaces.Dict({"arm": ARM, "camera": CAMERA})
    with EpisodeWriter(path, space, ACTION, compression="none") as writer:
        writer.begin()
        for step in range(3):
            state = {**space.sample(), "camera": np.full(CAMERA.shape, 171, np.uint8)}
            writer.step(state, ACTION.sample(), 1.0, step == 2)
    image = bytes([171]) * CAMERA.sample().size
    path.write_bytes(path.read_bytes().replace(image, b"?" + image[1:], 1))
    dataset = tupli_mcap.open(path)
    assert list(dataset.stats(["states"])) == ["state.arm.q", 'state.arm."v.x"']
    with pytest.raises(TupliError, match="damaged"):
        dataset.read(["states"])


@pytest.mark.parametrize("channels", [1, 3, 4])
def test_statistics_of_an_image_that_is_named(
    tmp_path: Path, channels: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    camera = gym.spaces.Box(0, 255, (6, 4, channels), np.uint8)
    record(
        tmp_path / "r.mcap", gym.spaces.Dict({"arm": ARM, "camera": camera, "t": NESTED["t"]}), [5, 4, 1], 0
    )
    monkeypatch.setattr(statistics, "_IMAGES", 3 * 6 * 4 * channels)  # in several blocks
    dataset = tupli_mcap.open(tmp_path)
    found = dataset.stats(["state.camera", "next_states.camera", "state.t[1]", "state.arm.q"])
    assert list(found) == ["state.camera", "next_state.camera", "state.t[1]", "state.arm.q"]
    whole = dataset.read(["states", "next_states"])
    for name, images in {
        "states.camera": whole.states["camera"],
        "next_state.camera": whole.next_states["camera"],
        "observations.t[1]": whole.states["t"][1],
    }.items():
        of, pixels = found[name], images.astype(float)
        assert (of.count == images[..., 0].size).all()
        for own, expected in {
            "mean": pixels.mean, "std": pixels.std, "min": pixels.min, "max": pixels.max,
        }.items():  # fmt: skip
            np.testing.assert_allclose(getattr(of, own), expected(axis=(0, 1, 2))[None, None])
        for q, values in of.quantiles.items():
            np.testing.assert_allclose(values, np.quantile(pixels, q, axis=(0, 1, 2))[None, None])
        scaled = (images - of.mean) / of.std
        assert scaled.shape == images.shape and abs(scaled.mean()) < 1e-9
    assert "state.camera" not in dataset.stats() and "state.camera" not in dataset.stats(["states"])


def test_statistics_of_states_that_are_images(tmp_path: Path) -> None:
    record(tmp_path / "r.mcap", CAMERA, [5, 1], 0)
    dataset = tupli_mcap.open(tmp_path)
    assert list(dataset.stats()) == ["action.grip", "action.move", "reward"]
    for name in ("state", "observations"):
        assert dataset.stats([name])["states"].mean.shape == (1, 1, 3)
    with pytest.raises(TupliError, match="expected steps to take statistics of, found none"):
        dataset.head(0).stats(["state"])


def test_what_a_loader_gives(runs: Path) -> None:
    (batch,) = tupli_mcap.open(runs).loader(length=2, batch_size=100, fields=["state.arm.q", "action.grip"])
    assert list(batch["states"]) == ["arm"]
    assert list(batch["states"]["arm"]) == ["q"]
    assert list(batch["actions"]) == ["grip"]


AROUND = {
    "state": [-1, 0],
    "state.arm": [-2, 0, 1],
    'observation.arm."v.x"': [0],
    "states.camera": [0],
    "next_state.t": [0],
    "next_state": [-2, 0, 1],
    "action.grip": range(3),
}


def test_values_of_parts_around_steps(runs: Path, tmp_path: Path) -> None:
    dataset = tupli_mcap.open(runs)
    datasets: dict[str, Any] = {
        "all": dataset,
        "chosen": dataset.filter_steps("step > 0 or state.arm.q[0] > 0"),
    }
    if "said" not in dataset[0].states:
        dataset.save_columns(tmp_path / "saved")
        datasets["saved"] = open_columns(tmp_path / "saved")
    for name, among in datasets.items():
        items = among.delta_windows(AROUND)
        # each of them from the whole, read by itself
        for key, inside in {
            "state": [], "state.arm": ["arm"], 'observation.arm."v.x"': ["arm", "v.x"],
            "states.camera": ["camera"], "next_state.t": ["t"], "next_state": [], "action.grip": ["grip"],
        }.items():  # fmt: skip
            whole_key = key.partition(".")[0]
            whole = among.delta_windows({whole_key: AROUND[key]})
            for at in (np.array([7, 0, 3, 3]), 4):
                expected = whole[at][whole_key]
                for part in inside:
                    expected = expected[part]
                assert same(items[at][key], expected), (name, key)
                assert same(items[at].masks[key], whole[at].masks[whole_key]), (name, key)
        again = pickle.loads(pickle.dumps(items))
        again.limit(1 << 20, 1)
        assert same(again[:].values, items[:].values), name


def test_an_image_is_read_at_its_own_distances_alone(tmp_path: Path) -> None:
    path = tmp_path / "r.mcap"
    camera = gym.spaces.Box(0, 255, (320, 320, 3), np.uint8)  # ten in a chunk
    space = gym.spaces.Dict({"arm": ARM, "camera": camera})
    with EpisodeWriter(path, space, ACTION, compression="none", chunk_size=1) as writer:
        writer.begin()
        for step in range(12):
            state = {"arm": ARM.sample(), "camera": np.full(camera.shape, 100 + step, np.uint8)}
            writer.step(state, ACTION.sample(), 1.0, step == 11)
    image = bytes([100]) * camera.sample().size
    path.write_bytes(path.read_bytes().replace(image, b"?" + image[1:], 1))
    dataset = tupli_mcap.open(path)
    around = dataset.delta_windows({"state.arm": [-11, 0], "state.camera": [0]})
    assert around[11]["state.camera"].max() == 111
    with pytest.raises(TupliError, match="damaged"):
        dataset.delta_windows({"state": [-11, 0], "state.camera": [0]})[11]


def test_parts_that_cannot_be_read_alone(runs: Path) -> None:
    dataset = tupli_mcap.open(runs)
    for read in (
        dataset.read,
        dataset[0].recording.read,
        lambda fields: dataset.windows(1, fields=fields)[0],
    ):
        with pytest.raises(SpaceError, match=r"found state.amr \(did you mean 'state.arm'"):
            read(["state.amr"])
        with pytest.raises(SpaceError, match=r"found state.arm.q\[0\]; read state.arm.q, and index it"):
            read(["state.arm.q[0]"])
        with pytest.raises(SpaceError, match=r"expected all of state.t, which is a Tuple"):
            read(["state.t[0]"])
        with pytest.raises(
            TupliError, match=r"the same parts of states and of next_states, found state.arm and all"
        ):
            read(["state.arm", "next_states"])
        assert same(read(["state", "state.arm"]).states, read(["state"]).states)


@pytest.mark.parametrize(
    ("key", "said"),
    [
        ("next_state.amr", r"found state.amr \(did you mean 'state.arm'"),
        ("state.arm.q[0]", r"found state.arm.q\[0\]; read state.arm.q, and index it"),
        ("state.t[0]", "expected all of state.t, which is a Tuple"),
        ('state.arm."v', r"""found state.arm."v \(did you mean 'state.arm."v.x"'"""),
        ("reward.x", "found 'reward.x'; read 'rewards'"),
        ("info.x", "expected deltas of state, .*, found 'info.x'"),
    ],
)
def test_keys_of_delta_windows_that_cannot_be_read(runs: Path, key: str, said: str) -> None:
    with pytest.raises(TupliError, match=said):
        tupli_mcap.open(runs).delta_windows({key: [0]})


def test_a_part_of_what_has_none(tmp_path: Path) -> None:
    with EpisodeWriter(tmp_path / "r.mcap", gym.spaces.Box(-1, 1, (3,)), gym.spaces.Discrete(2)) as writer:
        writer.begin()
        writer.step(np.zeros(3, np.float32), 1, 1.0, True)
    dataset = tupli_mcap.open(tmp_path)
    with pytest.raises(SpaceError, match=r"expected a part such as state, found state.arm"):
        dataset.read(["state.arm"])
    with pytest.raises(SpaceError, match=r"found state\[0\]; read state, and index it"):
        dataset.read(["state[0]"])
    with EpisodeWriter(tmp_path / "empty.mcap", gym.spaces.Dict(), gym.spaces.Discrete(2)) as writer:
        writer.begin()
        writer.step({}, 1, 1.0, True)
    with pytest.raises(SpaceError, match=r"expected no part, as the space is empty, found state.arm"):
        tupli_mcap.open(tmp_path / "empty.mcap").read(["state.arm"])


def test_recordings_need_agree_only_on_what_is_read(tmp_path: Path) -> None:
    for number, size in enumerate((8, 4)):
        camera = gym.spaces.Box(0, 255, (size, size, 3), np.uint8)
        record(tmp_path / f"{number}.mcap", gym.spaces.Dict({"arm": ARM, "camera": camera}), [3, 2], number)
    dataset = tupli_mcap.open(tmp_path)
    with pytest.raises(SpaceError, match="state.camera"):
        dataset.read(["states"])
    assert dataset.read(["state.arm"]).states["arm"]["q"].shape == (10, 2)
    assert dataset.windows(2, fields=["state.arm"])[:].states["arm"]["q"].shape == (6, 2, 2)
