"""Infos and frames as fields of windows, transitions, loaders and whole columns."""

from __future__ import annotations

import datetime
import pickle
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pandas
import pytest
from environments import Scripted

import tupli_mcap
from tupli_mcap import (
    F,
    FilterError,
    RecordEpisodes,
    Recording,
    RecordingError,
    RLTuple,
    SpaceError,
    TupliDataset,
    TupliError,
)
from tupli_mcap.dataset import open_columns
from tupli_mcap.dataset.columns.tuples import StepTuple
from tupli_mcap.dataset.items import SamplingError


def info(step: int) -> dict[str, Any]:
    found: dict[str, Any] = {"step": step, "force": np.array([step, -step], np.float32), "name": f"at {step}"}
    return found | ({"rare": step / 2} if step % 3 == 0 else {})


@pytest.fixture
def dataset(tmp_path: Path) -> tupli_mcap.Dataset:
    env = Scripted(
        lambda n: np.array([n], np.float32), gym.spaces.Box(-1e3, 1e3, (1,), np.float32), info=info, length=5
    )
    with RecordEpisodes(env, tmp_path / "r.mcap", record_info=True) as recorded:
        for seed in range(3):
            recorded.reset(seed=seed)
            for _ in range(5):
                recorded.step(0)
    return tupli_mcap.open(tmp_path / "r.mcap")


def test_of_windows(dataset: tupli_mcap.Dataset) -> None:
    batch = dataset.windows(2, fields=["states", "infos"])[[0, 5]]
    assert batch.infos["step"].tolist() == [[1, 2], [2, 3]]
    assert batch.infos["step"].dtype == np.int64
    assert batch.infos["force"].shape == (2, 2, 2)
    assert batch.infos["force"].dtype == np.float32
    assert batch.infos["name"] == [["at 1", "at 2"], ["at 2", "at 3"]]
    np.testing.assert_array_equal(batch.infos["rare"], [[np.nan, np.nan], [np.nan, 1.5]])
    one = dataset.windows(2, history=1, pad="zero", fields="info.force")[0]
    assert set(one.infos) == {"force"}
    np.testing.assert_array_equal(one.infos["force"], [[0, 0], [1, -1], [2, -2]])
    assert one.states is None


def test_of_transitions(dataset: tupli_mcap.Dataset) -> None:
    items = dataset.sort("seed", descending=True).head(2).transitions(2, fields=["rewards", "info.step"])
    assert items[:].infos["step"].tolist() == [1, 2, 3, 4, 5] * 2
    assert items[3].infos["step"] == 4


def test_have_statistics(dataset: tupli_mcap.Dataset) -> None:
    infos = dataset.read(["infos"]).infos
    found = dataset.stats(["states", "info.force", "infos.rare"])
    assert set(found) == {"state", "info.force", "info.rare"}
    force = np.array([info["force"] for info in infos], np.float64)
    assert np.array_equal(found["info.force"].mean, force.mean(axis=0))
    assert found["info.force"].quantiles[0.5].shape == (2,)
    rare = [info["rare"] for info in infos if "rare" in info]
    assert (found["info.rare"].count, found["info.rare"].max) == (len(rare), max(rare))
    assert set(dataset.stats("infos")) == {"info.step", "info.force", "info.rare"}
    with pytest.raises(TupliError, match=r"expected a number as info.name .*, found others; see them with"):
        dataset.stats(["info.name"])
    with pytest.raises(SamplingError, match=r"has the key 'forec' \(did you mean 'info.force'\?\)"):
        dataset.stats(["info.forec"])


def test_a_part_of_states_has_statistics(tmp_path: Path) -> None:
    arm = gym.spaces.Dict({"q": gym.spaces.Box(-9, 9, (2,)), "v": gym.spaces.Box(-9, 9, (2,))})
    space = gym.spaces.Dict({"arm": arm, "t": gym.spaces.Box(-9, 9, ())})
    with tupli_mcap.EpisodeWriter(tmp_path / "r.mcap", space, gym.spaces.Discrete(2)) as writer:
        writer.begin()
        writer.step(space.sample(), 1, 1.0, True)
    dataset = tupli_mcap.open(tmp_path)
    assert set(dataset.stats(["state.arm", "rewards"])) == {"state.arm.q", "state.arm.v", "reward"}
    assert set(dataset.stats(["observations.arm.q"])) == {"state.arm.q"}
    with pytest.raises(TupliError, match=r"expected a part of states .*, found 'state.arm.w' \(did you mean"):
        dataset.stats(["state.arm.w"])
    with pytest.raises(TupliError, match="read 'infos', which has a dict for each step"):
        Recording(tmp_path / "r.mcap").read(["info.x"])


def test_a_budget_is_that_of_the_recorded_steps(dataset: tupli_mcap.Dataset) -> None:
    windows = dataset.windows(2, fields=["states", "infos"])
    windows.source.limit(1000, 1)
    recorded: Any = dataset.steps
    assert (recorded.cache_bytes, recorded.threads) == (1000, 1)
    assert windows[0].states.shape == (2, 1)


@pytest.mark.parametrize("workers", [0, 1])
def test_of_a_loader(dataset: tupli_mcap.Dataset, workers: int) -> None:
    torch = pytest.importorskip("torch", reason="PyTorch is not installed")
    fields = ["states", "info.step", "infos.force"]
    loader = dataset.loader(length=3, batch_size=4, seed=1, num_workers=workers, fields=fields)
    batches = list(loader)
    assert sum(len(batch["states"]) for batch in batches) == 9
    for batch in batches:
        # the info of a step tells how many steps were taken, and its state how many had been
        assert torch.equal(batch["infos"]["step"], batch["states"][..., 0].long() + 1)
        assert batch["infos"]["force"].shape[1:] == (3, 2)


def test_a_copy_in_another_process_has_them(dataset: tupli_mcap.Dataset) -> None:
    windows = dataset.windows(2, fields=["states", "infos"])
    copied = pickle.loads(pickle.dumps(windows))
    np.testing.assert_array_equal(copied[3].infos["step"], windows[3].infos["step"])
    np.testing.assert_array_equal(copied[3].states, windows[3].states)


def test_says_what_there_is(dataset: tupli_mcap.Dataset, tmp_path: Path) -> None:
    with pytest.raises(SamplingError, match="did you mean 'info.force'"):
        dataset.windows(2, fields=["infos.forse"])
    later = TupliDataset(tmp_path).with_tuple_filter(F("info.step") > 2)
    assert later.windows(3, fields=["info.step"])[0].infos["step"].tolist() == [3, 4, 5]
    later.save_columns(tmp_path / "columns")
    with pytest.raises(SamplingError, match=r"tupli_mcap\.open"):
        open_columns(tmp_path / "columns").windows(2, fields=["infos"])
    with pytest.raises(SamplingError, match="expected fields"):
        dataset.transitions(fields=["inform"])


@pytest.mark.parametrize("name", ["info", "infos"])
def test_a_filter_on_an_info_that_no_step_has(tmp_path: Path, dataset: tupli_mcap.Dataset, name: str) -> None:
    found = TupliDataset(tmp_path).with_tuple_filter(f"{name}.forse > 2 and step > 1")
    with pytest.warns(
        UserWarning, match=rf"no step has {name}.forse \(did you mean '{name}.force'\?\); {name} has force, "
    ) as said:
        assert len(found) == 0
    assert said[0].filename == __file__  # the line of the caller
    assert len(TupliDataset(tmp_path).with_tuple_filter("info.force > 1e9")) == 0  # without a warning


def test_of_columns(dataset: tupli_mcap.Dataset) -> None:
    columns = dataset.read(["states", "info.step", "infos.force"])
    assert set(columns.infos) == {"step", "force"}
    np.testing.assert_array_equal(columns.infos["step"], columns.states[:, 0] + 1)
    assert dataset.read(["infos"]).infos[0]["name"] == "at 1"
    with pytest.raises(SamplingError, match="did you mean 'info.force'"):
        dataset.read("info.forse")


@pytest.mark.parametrize("large", [2**53 + 1, -(2**53) - 1, np.int64(2**60 + 1), np.uint64(2**64 - 1), 2**63])
@pytest.mark.parametrize("other", [0.5, -1, None])
def test_large_integers_keep_their_digits(tmp_path: Path, large: Any, other: Any) -> None:
    env = Scripted(
        lambda n: n, gym.spaces.Discrete(9), info=lambda n: {"id": other if n % 2 else large}, length=4
    )
    with RecordEpisodes(env, tmp_path / "r.mcap", record_info=True) as recorded:
        recorded.reset(seed=0)
        for _ in range(4):
            recorded.step(0)
    dataset = tupli_mcap.open(tmp_path / "r.mcap")
    told = [int(large) if n % 2 == 0 else other for n in range(1, 5)]
    for column in (
        dataset.read(["info.id"]).infos["id"],
        dataset.windows(4, fields=["info.id"])[0].infos["id"],
        [None if pandas.isna(value) else value for value in dataset.to_pandas()["info.id"]],
    ):
        assert list(column) == told


def test_times_are_a_field(dataset: tupli_mcap.Dataset, tmp_path: Path) -> None:
    times = dataset.read("times").times
    np.testing.assert_array_equal(np.concatenate([episode.times for episode in dataset]), times)
    np.testing.assert_array_equal(dataset.transitions(2, fields=["times"])[:].times, times)
    both = TupliDataset(tmp_path)
    assert len(both.with_tuple_filter(f"time >= {times[4]} and info.step > 4")) == 3
    assert len(both.with_tuple_filter(f"times >= {times[4]} and infos.step > 4")) == 3
    assert len(both.with_tuple_filter("time > '1h ago' and times > '1h ago'")) == len(times)
    assert len(both.with_tuple_filter("time <= 'yesterday'")) == 0
    now = datetime.datetime.now(datetime.UTC)
    assert len(
        both.with_tuple_filter((F("time") > datetime.datetime(2020, 1, 1)) & (F("time") < now))
    ) == len(times)
    with pytest.raises(FilterError, match="'time' is a time: expected .* found 'yesterdy'"):
        both.with_tuple_filter("time > 'yesterdy'")


def test_an_item_has_its_columns_by_name(dataset: tupli_mcap.Dataset) -> None:
    window = dataset.windows(2)[1]
    assert window["states"] is window.states
    with pytest.raises(KeyError, match=r"expected one of mask, .*found 'obs' \(did you mean 'states'"):
        window["obs"]


class Counting(gym.Env[Any, int]):
    """Its picture shows how many steps were taken."""

    metadata = {"render_modes": ["rgb_array"]}
    render_mode = "rgb_array"
    observation_space, action_space = gym.spaces.Box(0, 99, (), np.float32), gym.spaces.Discrete(2)

    def __init__(self, size: int = 8) -> None:
        self.count, self.size = 0, size

    def reset(self, *, seed: int | None = None, options: Any = None) -> tuple[Any, dict[str, Any]]:
        self.count = 0 if seed is None else seed
        return np.array(self.count, np.float32), {}

    def step(self, action: int) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        self.count += 1
        return np.array(self.count, np.float32), 1.0, self.count % 10 == 5, False, {}

    def render(self) -> Any:
        return np.full((self.size, self.size, 3), self.count, np.uint8)


@pytest.fixture
def pictures(tmp_path: Path) -> tupli_mcap.Dataset:
    """Two files, of which the pictures show the state."""
    for name, seeds in (("a", (0, 10)), ("b", (20,))):
        with RecordEpisodes(Counting(), tmp_path / f"{name}.mcap", frames=True, frame_format="png") as env:
            for seed in seeds:
                env.reset(seed=seed)
                while not env.step(0)[2]:
                    pass
    return tupli_mcap.open(tmp_path)


def test_frames_are_a_field(pictures: tupli_mcap.Dataset) -> None:
    mixed = pictures.sort("seed", descending=True)
    columns = mixed.read(["frames", "observations"])
    assert (columns.frames.shape, columns.frames.dtype) == ((15, 8, 8, 3), np.uint8)
    np.testing.assert_array_equal(columns.frames[:, 0, 0, 0], columns.states)
    windows = mixed.windows(3, pad="repeat", fields=["frames", "states", "infos"])
    copied = pickle.loads(pickle.dumps(windows))
    for items in (windows, copied):
        batch = items[[4, 0, 7]]
        np.testing.assert_array_equal(batch.frames[..., 0, 0, 0], batch.states)
        assert items[5].frames.shape == (3, 8, 8, 3)
    step = mixed.transitions(fields=["frames", "states"])[3]
    assert step.frames[0, 0, 0] == step.states
    with Recording(pictures[0].recording.name) as recording:
        np.testing.assert_array_equal(
            recording.read("frames", episodes=[1]).frames[:, 0, 0, 0], range(10, 15)
        )
    assert pictures.head(0).read("frames").frames.shape == (0, 0, 0, 3)
    some = mixed.filter_steps("step in [1, 2, 4]")
    for found in (some.read(["frames", "states"]), some.transitions(fields=["frames", "states"])[:]):
        assert len(found.states) == 9
        np.testing.assert_array_equal(found.frames[:, 0, 0, 0], found.states)


def test_functions_of_steps_see_frames(pictures: tupli_mcap.Dataset, tmp_path: Path) -> None:
    def even(step: StepTuple) -> bool:
        return step.frame is not None and step.frame[0, 0, 0] == step.state and step.state % 2 == 0

    mixed = pictures.sort("seed", descending=True)
    expected = [20, 22, 24, 10, 12, 14, 0, 2, 4]
    for found in (mixed.filter_steps(even), mixed[[2, 1, 0]].filter_steps("state != 11").filter_steps(even)):
        states = found.read(["states"]).states.tolist()
        assert states == expected or states == expected[6:] + expected[3:6] + expected[:3]
    assert TupliDataset(tmp_path).with_tuple_filter(even).dataset.n_steps == 9

    with RecordEpisodes(Counting(), tmp_path / "some" / "a.mcap", frames=2, frame_format="png") as env:
        env.reset(seed=0)
        while not env.step(0)[2]:
            pass
    some = tupli_mcap.open(tmp_path / "some").filter_steps(lambda step: step.frame is not None)
    assert some.read(["frames"]).frames[:, 0, 0, 0].tolist() == [0, 2, 4]
    assert some.filter_steps("state = 4").to_pandas(frames=True)["frames"][0][0, 0].tolist() == [4, 4, 4]
    later = tupli_mcap.open([tmp_path / "a.mcap", tmp_path / "some"]).filter_steps("state = 10 or state = 2")
    assert later[::-1].read(["frames"]).frames[:, 0, 0, 0].tolist() == [2, 10, 2]
    assert later.filter_steps("state = 3").read(["frames"]).frames.shape == (0, 0, 0, 3)


def test_functions_of_steps_see_what_texts_name(pictures: tupli_mcap.Dataset) -> None:
    mixed = pictures.sort("seed", descending=True).filter_steps("step != 3")
    seen: list[tuple[Any, ...]] = []

    def see(step: StepTuple) -> bool:
        assert step.next_observation == step.next_state == step.state + 1
        assert type(step.next_state) is type(step.state)
        seen.append((step.next_state, step.time, step.step))
        return True

    assert mixed.filter_steps(see).n_steps == 12
    columns = mixed.read(["next_states", "times"])
    expected = [columns.next_states.tolist(), columns.times.tolist(), [0, 1, 2, 4] * 3]
    assert list(map(list, zip(*seen, strict=True))) == expected
    middle = int(columns.times[5])
    for text, test in {
        "next_state in [1, 15]": lambda step: step.next_state in (1, 15),
        f"time > {middle}": lambda step: step.time > middle,
        "step = 0 or next_observation = 12": lambda step: step.step == 0 or step.next_observation == 12,
    }.items():
        expected = mixed.filter_steps(text).read(["states"]).states.tolist()
        assert expected and mixed.filter_steps(test).read(["states"]).states.tolist() == expected


def test_wrong_names_in_a_function_of_steps_say_which_is_meant(dataset: tupli_mcap.Dataset) -> None:
    for wrong, meant in {"done": "terminal", "next_obs": "next_state", "times": "time"}.items():
        with pytest.raises(AttributeError, match=rf"no attribute '{wrong}' \(did you mean '{meant}'\?\)"):
            dataset.filter_steps(lambda step, wrong=wrong: getattr(step, wrong) > 0).read()  # type: ignore[misc]
    with pytest.raises(AttributeError, match=r"no attribute 'obs' \(did you mean 'state'\?\)"):
        _ = RLTuple(state=1, action=2, reward=3.0).obs  # type: ignore[attr-defined]
    with pytest.raises(
        AttributeError, match=r"no attribute 'next_state' \(episode.next_states has those of all"
    ):
        _ = dataset[0][0].next_state  # type: ignore[attr-defined]


def test_a_function_of_steps_sees_that_there_are_no_frames(dataset: tupli_mcap.Dataset) -> None:
    seen: list[Any] = []

    def same(step: StepTuple) -> bool:
        seen.append(step.frame)
        return step == RLTuple(**step.__dict__) and RLTuple(**step.__dict__) == step and step == step

    assert dataset.filter_steps(same).n_steps == 15
    assert seen == [None] * 15
    with pytest.raises(IndexError, match="the episode has no frames: record with frames=True"):
        dataset[0].frames[-1]
    with pytest.raises(FilterError, match=r"expressions compare no pictures.*step\.frame"):
        dataset.filter_steps("reward > 0 and frames[0] > 100")


@pytest.mark.parametrize("workers", [0, 1])
def test_frames_of_a_loader(pictures: tupli_mcap.Dataset, workers: int) -> None:
    torch = pytest.importorskip("torch", reason="PyTorch is not installed")
    for batch in pictures.loader(length=2, batch_size=4, num_workers=workers, fields=["frames", "states"]):
        assert torch.equal(batch["frames"][..., 0, 0, 0].float(), batch["states"])


def test_frames_of_a_tupli_dataset(pictures: tupli_mcap.Dataset, tmp_path: Path) -> None:
    later = TupliDataset(tmp_path).with_tuple_filter("step in [1, 2, 4]")
    expected = pictures.filter_steps("step in [1, 2, 4]").windows(2, fields=["frames"])[:].frames
    later.load()
    np.testing.assert_array_equal(later.windows(2, fields=["frames"])[:].frames, expected)
    later.save_columns(tmp_path / "columns")
    with pytest.raises(SamplingError, match=r"saved columns hold no frames.*tupli_mcap\.open"):
        open_columns(tmp_path / "columns").windows(2, fields=["frames"])


def test_frames_that_are_not_there(pictures: tupli_mcap.Dataset, tmp_path: Path) -> None:
    with RecordEpisodes(Counting(4), tmp_path / "c.mcap", frames=True, frame_format="png") as env:
        env.reset(seed=4)
        env.step(0)
    with pytest.raises(RecordingError, match="frames of one size"):
        tupli_mcap.open(tmp_path).windows(1, fields=["frames"])[[0, 15]]
    with pytest.raises(SpaceError, match="frames of one size"):
        tupli_mcap.open([tmp_path / "a.mcap", tmp_path / "c.mcap"]).read(["frames"])
    with RecordEpisodes(Counting(), tmp_path / "d.mcap") as env:
        env.reset()
        env.step(0)
    with pytest.raises(RecordingError, match="it has none: record with frames=True"):
        tupli_mcap.open(tmp_path / "d.mcap").read("frames")
    with pytest.raises(SamplingError, match=r"did you mean 'frames'"):
        pictures.windows(2, fields=["fames"])


@pytest.fixture
def touching(tmp_path: Path) -> tupli_mcap.Dataset:
    """Steps whose infos hold arrays, and dicts of them; the last one has none."""
    box = gym.spaces.Box(-1, 1, (1,))
    with tupli_mcap.EpisodeWriter(tmp_path / "r.mcap", box, box) as writer:
        writer.begin()
        for n in range(4):
            contact = {"left": np.array([n, 0.5]), "right": {"grip": n > 1}}
            said = {"contact": contact, "grid": np.full((1, 2), n, np.int32), "a.b": n, "texts": {"x": "y"}}
            said |= {"ids": np.array([2**60 + n, 0]), "on": np.array([n > 0, False])}
            ragged = {"ragged": np.zeros(n + 1), "list": [[n], [n, n]]}
            writer.step(box.sample(), box.sample(), 1.0, info={**said, **ragged} if n < 3 else {})
        writer.end(box.sample())
    return tupli_mcap.open(tmp_path / "r.mcap")


def test_tables_have_a_column_for_each_number_in_infos(touching: tupli_mcap.Dataset) -> None:
    table = touching.to_pandas()
    assert [name for name in table if name.startswith("info")] == [
        "info.contact.left[0]", "info.contact.left[1]", "info.contact.right.grip", "info.grid[0,0]",
        "info.grid[0,1]", 'info."a.b"', "info.texts", "info.ids[0]", "info.ids[1]", "info.on[0]", "info.on[1]",
        "info.ragged", "info.list",
    ]  # fmt: skip
    np.testing.assert_array_equal(table["info.contact.left[0]"], [0, 1, 2, np.nan])
    grips = table["info.contact.right.grip"]
    assert grips.dtype == "boolean" and grips.to_numpy(object, na_value=None).tolist() == [
        False,
        False,
        True,
        None,
    ]
    numbers = {"info.grid[0,1]": [0, 1, 2, None], "info.ids[0]": [2**60, 2**60 + 1, 2**60 + 2, None]}
    numbers["info.on[0]"] = [False, True, True, None]
    for name, dtype in zip(numbers, ("Int32", "Int64", "boolean"), strict=True):
        assert table[name].dtype == dtype
        assert table[name].to_numpy(object, na_value=None).tolist() == numbers[name]
        assert touching.to_arrow()[name].to_pylist() == numbers[name]
    assert touching.to_arrow()["info.grid[0,1]"].type == "int32"
    assert table["info.texts"][0] == {"x": "y"} and table["info.ragged"][1].shape == (2,)
    assert touching.to_arrow()["info.list"].to_pylist()[1] == [[1], [1, 1]]


def test_values_in_infos_are_fields(touching: tupli_mcap.Dataset, tmp_path: Path) -> None:
    fields = [
        "info.contact.left",
        "info.contact.left[0]",
        "infos.contact.right.grip",
        "info.a.b",
        "info.list",
    ]
    columns = touching.read(fields).infos
    np.testing.assert_array_equal(columns["contact.left"][:, 0], [0, 1, 2, np.nan])
    np.testing.assert_array_equal(columns["contact.left[0]"], columns["contact.left"][:, 0])
    np.testing.assert_array_equal(columns["contact.right.grip"], [0, 0, 1, np.nan])
    np.testing.assert_array_equal(columns["a.b"], [0, 1, 2, np.nan])
    assert columns["list"][2] == [[2], [2, 2]]
    assert touching.windows(2, fields=fields[:1])[1].infos["contact.left"].tolist() == [[1, 0.5], [2, 0.5]]
    steps = TupliDataset(tmp_path)
    assert len(steps.with_tuple_filter("info.contact.left[0] > 1 or info.contact.left.0 = 0")) == 2
    with pytest.raises(SamplingError, match=r"did you mean 'info.contact.left'\?"):
        touching.windows(2, fields=["info.contact.lefd"])
    with pytest.warns(
        UserWarning, match=r"\(did you mean 'info.contact.left'\?\); info.contact has left, right"
    ):
        assert len(steps.with_tuple_filter("info.contact.lefd[0] > 1")) == 0
    assert len(steps.with_tuple_filter("info.contact.left[7] > 1")) == 0
