"""Reports: the numbers behind them against NumPy on the whole data, and pictures of every kind of environment."""

from __future__ import annotations

import itertools
import json
import os
import pickle
import re
import subprocess
import sys
import warnings
from collections.abc import Callable, Sequence
from dataclasses import replace
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import web_server
from browsing import CHROMIUM
from command_line import run
from environments import Sampler, Scripted, roll
from gymnasium import spaces
from matplotlib.colors import to_hex
from matplotlib.text import Text
from PIL import Image
from playwright.sync_api import sync_playwright
from typer.testing import CliRunner

import tupli_mcap
from tupli_mcap import (
    EpisodeData,
    EpisodeWriter,
    F,
    FileStorage,
    FilterError,
    RecordEpisodes,
    Recording,
    RecordingError,
    TupliEnvWrapper,
    merge_recordings,
    vector,
    write_recording,
)
from tupli_mcap.cli import app
from tupli_mcap.cli.info import PLAIN, sparkline
from tupli_mcap.errors import install_line
from tupli_mcap.plots import Measured, Report, report
from tupli_mcap.plots.draw_values import LEVELS, most_varying, quantiles
from tupli_mcap.plots.groups import groups_of
from tupli_mcap.plots.measure import measure
from tupli_mcap.plots.statistics import bands, bin_edges, drawable_numbers, mean_interval, running_mean
from tupli_mcap.plots.style import BLUE, Page
from tupli_mcap.recording import edit_runs
from tupli_mcap.recording.describe.description import by_scale
from tupli_mcap.recording.describe.series import sketch
from tupli_mcap.schema.times import local_text

TOOL = Path(sys.executable).with_name("tupli-mcap")
UNIT = spaces.Box(-1, 1, (3,), np.float32)


def record(path: Path, env: gym.Env[Any, Any], steps: int, seed: int = 1, **options: Any) -> Path:
    with RecordEpisodes(env, path, **options) as recorded:
        roll(recorded, steps, seed)
    return path


def scripted(
    path: Path, observe: Callable[[int], Any], space: gym.Space[Any], steps: int = 40, **options: Any
) -> Path:
    return record(path, Scripted(observe, space, **options), steps)


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> dict[str, bytes]:
    """By name, a recording of many steps, and one of few panels, which is quickly drawn."""
    parent = tmp_path_factory.mktemp("recorded")
    space = spaces.Box(-99, 99, (1,), np.float32)
    record(parent / "cartpole.mcap", gym.make("CartPole-v1"), 400)
    scripted(parent / "tiny.mcap", lambda n: np.float32([n]), space, 55, length=10)
    return {path.name: path.read_bytes() for path in parent.iterdir()}


@pytest.fixture
def cartpole(recorded: dict[str, bytes], tmp_path: Path) -> Path:
    (tmp_path / "cartpole.mcap").write_bytes(recorded["cartpole.mcap"])
    return tmp_path / "cartpole.mcap"


@pytest.fixture
def tiny(recorded: dict[str, bytes], tmp_path: Path) -> Path:
    (tmp_path / "tiny.mcap").write_bytes(recorded["tiny.mcap"])
    return tmp_path / "tiny.mcap"


def measured(path: Path) -> Measured:
    with Recording(path) as recording:
        return measure(recording, np.arange(len(recording)))[0]


def texts(made: Report) -> list[str]:
    """Every text in the picture."""
    from matplotlib.text import Text

    return [found.get_text() for found in made.figure.findobj(Text)]


# --- numbers ---


@pytest.mark.parametrize("block_bytes", [1000, 8 << 20])  # many blocks and parts of episodes, or one
def test_values_are_those_of_the_whole_data(
    cartpole: Path, monkeypatch: pytest.MonkeyPatch, block_bytes: int
) -> None:
    monkeypatch.setattr("tupli_mcap.recording.blocks.BLOCK_BYTES", block_bytes)
    found = measured(cartpole)
    with Recording(cartpole) as recording:
        columns = recording.read()
    states = columns.states.astype(np.float64)
    (state,), (action,), (reward,) = found.states, found.actions, found.rewards
    np.testing.assert_allclose(state.mean, states.mean(axis=0), rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(state.std, states.std(axis=0), rtol=1e-9)
    np.testing.assert_array_equal(state.least, states.min(axis=0))
    np.testing.assert_array_equal(state.most, states.max(axis=0))
    np.testing.assert_array_equal(state.values.T, states)
    np.testing.assert_array_equal(action.counts[0], np.bincount(columns.actions, minlength=2))
    np.testing.assert_array_equal(quantiles([state], 2), np.percentile(states[:, 2], LEVELS))
    assert (reward.mean[0], reward.std[0], reward.values.shape) == (1.0, 0.0, (1, 400))
    assert found.read_steps == found.steps == 400
    assert found.notes() == []
    assert state.names == ("Cart Position", "Cart Velocity", "Pole Angle", "Pole Angular Velocity")


def test_nan_and_infinities_are_counted_and_left_out(tmp_path: Path) -> None:
    odd = {3: np.nan, 7: np.inf, 11: -np.inf}
    path = scripted(
        tmp_path / "r.mcap", lambda n: np.array([odd.get(n, n), 2 * n, np.nan]), spaces.Box(-99, 99, (3,), np.float64),
        length=20, reward=lambda n: odd.get(n, 1.0),
    )  # fmt: skip
    found = measured(path)
    (state,) = found.states
    with Recording(path) as recording:
        column = recording.read().states[:, 0]
    kept = column[np.isfinite(column)]
    assert (state.nan.tolist(), state.infinite.tolist()) == ([2, 0, 40], [4, 0, 0])
    assert (state.mean[0], state.std[0], state.least[0], state.most[0]) == pytest.approx(
        (kept.mean(), kept.std(), kept.min(), kept.max())
    )
    assert np.isnan([state.mean[2], state.std[2], state.least[2], state.most[2]]).all()
    assert "state: 42 NaN, 4 infinite values are left out." in found.notes()
    assert report(path).png()


def test_the_largest_numbers_are_drawn_or_said_not_to_be(tmp_path: Path) -> None:
    for k, size in enumerate((3e38, 1.7e308)):
        path = scripted(
            tmp_path / f"{k}.mcap", lambda n, s=size: np.array([n % 7, (-1) ** n * s, s]),
            spaces.Box(-np.inf, np.inf, (3,), np.float64), length=20, reward=lambda n, s=size: (-1) ** n * s,
        )  # fmt: skip
        made = report(path)
        assert made.png()
        assert any("values beyond 1e+150 are not drawn" in note for note in made.notes) == (k == 1)


def test_of_long_recordings_some_episodes_are_read(cartpole: Path) -> None:
    with Recording(cartpole) as recording:
        rows, states = recording.index, recording.read().states
        found, again = (measure(recording, np.arange(len(recording)), 8000)[0] for _ in range(2))
        (first,) = measure(recording, np.array([2]), 7 * 77)  # the beginning of an episode is read at least
    assert 0 < found.read_steps < 200
    kept = found.states[0].values.T
    assert kept.shape == (found.read_steps, 4)
    assert {row.tobytes() for row in kept} <= {row.tobytes() for row in states}
    assert found.actions[0].counts[0].sum() == found.read_steps
    np.testing.assert_array_equal(kept, again.states[0].values.T)
    assert found.notes() == [
        f"Values are those of {found.read_episodes} randomly chosen episodes ({found.read_steps} steps)."
    ]
    assert (first.read_episodes, first.read_steps) == (1, 7) and rows["length"][2] > 7


def test_several_recordings_share_what_is_read(cartpole: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(
        sys.modules["tupli_mcap.plots.report"], "READ_BYTES", 60_000
    )  # of 400 steps of 77 bytes
    assert report(cartpole).notes == []
    made = report([cartpole] * 4)
    assert [one.read_steps < 400 for one in made.measured] == [True] * 4
    assert len({one.name for one in made.measured}) == 1 and len(made.notes) == 1


def test_images_are_not_read_for_histograms(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = record(
        tmp_path / "r.mcap", Sampler(spaces.Box(0, 255, (20, 30, 3), np.uint8), spaces.Discrete(2)), 60
    )
    with Recording(path) as recording:
        images = set(recording._store.chunks(recording._topics["/image/state"]))
        read: list[int] = []
        chunk = recording._store._chunk
        monkeypatch.setattr(
            recording._store, "_chunk", lambda i, *a, **kw: read.append(i) or chunk(i, *a, **kw)
        )
        measure(recording, np.arange(len(recording)))
        assert read and images and not images & set(read)


def test_running_means_and_bands() -> None:
    values = np.array([1.0, 3.0, np.nan, 5.0, np.inf, 7.0])
    np.testing.assert_array_equal(running_mean(values, 2), [1, 2, 3, 5, 5, 7])
    np.testing.assert_array_equal(running_mean(np.array([np.nan, 2.0]), 1), [np.nan, 2])
    at, mean, low, tenth, _, high = bands(np.arange(1000.0), 10)
    np.testing.assert_allclose(mean, np.arange(10) * 100 + 49.5)
    np.testing.assert_allclose(at, mean)
    np.testing.assert_allclose(
        tenth, [np.quantile(np.arange(k * 100, k * 100 + 100), 0.1) for k in range(10)]
    )
    assert (low.tolist()[3], high.tolist()[3]) == (300, 399)
    assert np.isnan(bands(np.array([np.nan, 1, np.nan, np.inf]), 2)[1:]).any(axis=0).tolist() == [False, True]


@pytest.mark.parametrize(
    "values",
    [
        [], [np.nan, np.inf], [3.5], [0.0, 0.0], [1e149, -1e149], [1e-310, 2e-310], [1.0, 1.0 + 2**-52], [5, 6, 9],
        [-1e18, 1e18], [0.1] * 500 + [1e9], list(range(1000)), [1e308, 1.7e308], [-1.7e308, 1.7e308], [2.0**60] * 3,
    ],
)  # fmt: skip
def test_bins_hold_the_values_or_say_how_many_they_do_not(values: list[float]) -> None:
    array = drawable_numbers(np.array(values, np.float64))
    edges, beyond = bin_edges(array, 30)
    finite = array[np.isfinite(array)]
    assert np.isfinite(edges).all()
    assert (np.diff(edges) > 0).all()
    assert len(edges) <= 32
    assert np.histogram(finite, edges)[0].sum() + beyond == len(finite)


def test_a_far_value_does_not_squeeze_the_others_into_one_bin() -> None:
    values = np.append(np.linspace(0, 1, 5000), 1e9)
    edges, beyond = bin_edges(values, 40)
    assert beyond == 1
    assert (np.histogram(values, edges)[0] > 0).sum() > 10
    assert bin_edges(np.array([2, 3, 3, 5]), 40)[0].tolist() == [1.5, 2.5, 3.5, 4.5, 5.5]  # whole numbers
    assert [len(bin_edges(np.linspace(0.1, 0.9, n), 40)[0]) - 1 for n in (2, 20, 10_000)] == [8, 10, 40]


def test_one_value_is_a_bar_in_the_middle() -> None:
    for values, width in (([20.0] * 3, 1), ([0.3], 0.03), ([1e9 + 0.3], 1e8 + 0.03), ([], 1)):
        edges, beyond = bin_edges(np.array(values), 40)
        np.testing.assert_allclose(np.diff(edges), width)
        assert len(edges) == 4 and beyond == 0
        assert np.histogram(values, edges)[0].tolist() == [0, len(values), 0]


def test_the_two_dimensions_that_vary_most(tmp_path: Path) -> None:
    path = scripted(
        tmp_path / "r.mcap",
        lambda n: np.array([n % 2, 9.0, 5 * n, 30 * np.sin(n)]),
        spaces.Box(-99, 99, (4,), np.float64),
    )
    states = [[leaf] for leaf in measured(path).states]
    assert most_varying(states) == [3, 2, 0]  # the constant one is none


def test_numbers_on_an_axis_stand_apart(tmp_path: Path) -> None:
    path = scripted(
        tmp_path / "r.mcap",
        lambda n: np.full(2, -0.1 * (n % 3)),
        spaces.Box(-1, 1, (2,), np.float64),
        length=3,
    )
    made = report(path)
    made.png()  # places the labels
    for axes in made.figure.axes:
        shown = [label for label in axes.get_xticklabels() if label.get_text() and label.get_visible()]
        low, high = sorted(axes.get_xlim())
        boxes = [at.get_window_extent() for at in shown if low <= at.get_position()[0] <= high]
        boxes.sort(key=lambda box: box.x0)
        for left, right in itertools.pairwise(boxes):
            assert left.x1 + 5 < right.x0, (axes.get_title(), [at.get_text() for at in shown])


def test_lines_of_one_axis_have_about_one_size() -> None:
    assert by_scale([1.0, 1000, 2, 900, 0, 0], 8, 6) == [[0, 2, 4, 5], [1, 3]]
    assert [len(group) for group in by_scale([1.0] * 8, 8, 6)] == [6, 2]


def test_an_episode_step_by_step(cartpole: Path) -> None:
    made = report(cartpole, episode="worst")
    ((_, trace),) = made.traces
    with Recording(cartpole) as recording:
        episode = min(recording.episodes, key=lambda e: e.return_)
        np.testing.assert_array_equal(trace.values["state"], episode.states)
        np.testing.assert_array_equal(trace.values["action"][:, 0], episode.actions)
        np.testing.assert_array_equal(trace.totals, np.cumsum(episode.rewards))
        assert (trace.episode, trace.length, trace.end) == (episode.number, len(episode), episode.end)
    assert any(f"Episode {episode.number}: " in text for text in texts(made))


def test_a_long_episode_keeps_its_extremes(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("tupli_mcap.plots.measure.MAX_POINTS", 20)
    monkeypatch.setattr("tupli_mcap.recording.blocks.BLOCK_BYTES", 2000)
    rng = np.random.default_rng(0)
    values = rng.normal(size=400)
    values[123] = 77
    path = scripted(
        tmp_path / "r.mcap",
        lambda n: values[n : n + 1],
        spaces.Box(-99, 99, (1,), np.float64),
        317,
        length=999,
    )
    made = report(path)
    ((_, trace),) = made.traces
    states = values[:317]
    assert trace.thinned == 32
    assert "step; smallest and largest of every 32 steps" in texts(made)
    assert len(trace.at) == len(trace.totals) == len(trace.values["state"]) == 20
    parts = [states[k : k + 32] for k in range(0, 317, 32)]
    np.testing.assert_array_equal(trace.values["state"][::2, 0], [part.min() for part in parts])
    np.testing.assert_array_equal(trace.values["state"][1::2, 0], [part.max() for part in parts])
    assert trace.totals[-1] == 317.0


def test_pictures_of_an_episode(tmp_path: Path) -> None:
    def frame(n: int) -> Any:
        return np.full((4, 5, 3), 5 * n, np.uint8)

    path = scripted(tmp_path / "r.mcap", frame, spaces.Box(0, 255, (4, 5, 3), np.uint8), 10, length=10)
    ((_, trace),) = report(path).traces
    (pictures,) = trace.pictures.values()
    shown = {title: int(picture[0, 0, 0]) for title, picture in pictures}
    assert shown == {
        "step 0": 0, "step 1": 5, "step 3": 15, "step 5": 25, "step 7": 35, "step 9": 45,
        "mean of 10": 22,  # of 0, 5, ..., 45
    }  # fmt: skip
    assert {picture.shape for _, picture in pictures} == {(4, 5, 3)}


@pytest.mark.parametrize("shape", [(16, 20), (16, 20, 1), (3, 16, 20)])
def test_depths_are_pictures(tmp_path: Path, shape: tuple[int, ...]) -> None:
    def depth(n: int) -> Any:
        return np.full(shape, np.nan if n == 3 else n / 2, np.float32)

    path = scripted(tmp_path / "r.mcap", depth, spaces.Box(0, np.inf, shape), 10, length=10)
    made = report(path)
    ((_, trace),) = made.traces
    assert not trace.values.keys() & {"state"}
    (pictures,) = trace.pictures.values()
    assert {picture.shape[:2] for _, picture in pictures} == {(16, 20)}
    shades = [int(picture.flat[0]) for _, picture in pictures]
    assert shades[:3] == [0, 28, 0] and shades[5] == 255  # of 0, 0.5, NaN, ..., 4.5
    made.png()


@pytest.mark.filterwarnings("error")
def test_the_mean_of_depths_leaves_gaps_out(tmp_path: Path) -> None:
    def depth(n: int) -> Any:
        values = np.full((16, 20), n, np.float32)
        values[0] = np.nan  # never known
        values[1] = n if n < 2 else np.inf
        values[2] = n if n > 6 else np.nan
        return values

    path = scripted(tmp_path / "r.mcap", depth, spaces.Box(0, np.inf, (16, 20)), 10, length=10)
    ((_, trace),) = report(path).traces
    (pictures,) = trace.pictures.values()
    title, mean = pictures[-1]
    assert title == "mean of 10"
    shade = 255 / 9  # of 0 to 9
    assert [int(row[0]) for row in mean[:4]] == [0, int(0.5 * shade), int(8 * shade), int(4.5 * shade)]


def test_recorded_frames_are_shown_beside_images_of_states(tmp_path: Path) -> None:
    class Filmed(Scripted):
        metadata = {"render_modes": ["rgb_array"]}
        render_mode = "rgb_array"

        def render(self) -> Any:
            return np.full((8, 9, 3), 20, np.uint8)

    for i, space in enumerate((spaces.Box(0, 255, (4, 5, 3), np.uint8), spaces.Box(0, 255, (2,), np.uint8))):
        env = Filmed(lambda n, space=space: space.low, space, length=10)
        path = record(tmp_path / f"{i}.mcap", env, 10, frames=True, frame_format="png")
        ((_, trace),) = report(path).traces
        frames, *images = trace.pictures.values()
        assert [title for title, _ in frames] == [f"step {n}" for n in (0, 2, 4, 6, 8, 10)]
        assert all(picture.shape == (8, 9, 3) and (picture == 20).all() for _, picture in frames)
        assert len(images) == 1 - i


@pytest.mark.sampled(2)
@pytest.mark.parametrize("axis", [0, -1])
@pytest.mark.parametrize("shape", [(6, 5), (6, 3), (6, 5, 3)])
def test_the_newest_frame_of_a_stack_is_shown(tmp_path: Path, shape: tuple[int, ...], axis: int) -> None:
    def frame(n: int) -> Any:
        return np.full(shape, 5 * n, np.uint8)

    screen = Scripted(frame, spaces.Box(0, 255, shape, np.uint8), length=10)
    stack = gym.wrappers.FrameStackObservation(screen, 4)
    space = spaces.Box(0, 255, (*shape, 4) if axis else (4, *shape), np.uint8)
    moved = gym.wrappers.TransformObservation(stack, lambda frames: np.moveaxis(frames, 0, axis), space)
    ((_, trace),) = report(record(tmp_path / "r.mcap", moved, 10)).traces
    (pictures,) = trace.pictures.values()
    assert [(one.shape, int(one.flat[0])) for _, one in pictures[:-1]] == [
        (shape, n) for n in (0, 5, 15, 25, 35, 45)
    ]


# --- pictures of every kind of environment ---

NESTED = spaces.Dict(
    {
        "arm": spaces.Dict({"x": spaces.Box(-1, 1, (3,)), "on": spaces.Discrete(2)}),
        "pair": spaces.Tuple((spaces.MultiBinary(5), spaces.MultiDiscrete([3, 4]))),
        "big": spaces.Box(-np.inf, np.inf, (40,), np.float64),
        "note": spaces.Text(8),
        "list": spaces.Sequence(spaces.Box(-1, 1, (2,))),
        "none": spaces.Box(-1, 1, (0, 3)),
        "half": spaces.Box(-1, 1, (), np.float16),
        "eye": spaces.Box(0, 255, (16, 24, 1), np.uint8),
        "stack": spaces.Box(0, 255, (4, 20, 20), np.uint8),
    }
)
KINDS: dict[str, tuple[gym.Space[Any], gym.Space[Any]]] = {
    "nested": (NESTED, spaces.Dict({"a": spaces.Discrete(3, start=-1), "b": spaces.Box(-2, 2, (2,))})),
    "discrete": (spaces.Discrete(16), spaces.MultiBinary(3)),
    "many values": (
        spaces.Tuple((spaces.Discrete(3000), spaces.Discrete(10**9))),
        spaces.Tuple((spaces.MultiDiscrete([2] * 30), spaces.MultiDiscrete([2, 10**6]))),
    ),
    "wide": (spaces.Box(-1, 1, (400,)), spaces.Box(-1, 1, (20,))),
    "pixels": (spaces.Box(0, 255, (48, 64, 3), np.uint8), spaces.Box(0, 1, (2, 2), np.bool_)),
    "grey": (spaces.Box(0, 255, (30, 20), np.uint8), spaces.Box(-5, 5, (), np.int32)),
    "depth": (spaces.Box(0, 5, (16, 16)), spaces.Box(0, 1, (20, 20), np.bool_)),
    "nothing": (spaces.Dict({}), spaces.Box(0, 1, (0,))),
    "text": (spaces.Text(6), spaces.Graph(spaces.Discrete(3), None)),
}


def check_formats(made: Report, directory: Path, *, page: bool = True) -> None:
    """A picture that is not blank, and a page with the same picture as SVG."""
    made.save(directory / "report.png")
    with Image.open(directory / "report.png") as image:
        pixels = np.asarray(image.convert("L"))
        assert image.width == 1100
    assert 0.002 < (pixels < 128).mean() < 0.6
    rows = np.flatnonzero((pixels < 200).any(axis=1))
    assert np.diff(rows).max() < 120  # no gap of more than an inch
    if page:
        assert made.save(directory / "report.html").read_text().count("<svg") == 1


@pytest.mark.sampled(1, keep=["nested"])
@pytest.mark.parametrize("kind", KINDS)
def test_every_kind_of_space_is_drawn_without_a_warning(tmp_path: Path, kind: str) -> None:
    observation, action = KINDS[kind]
    path = record(tmp_path / "r.mcap", Sampler(observation, action), 40)
    check_formats(report(path), tmp_path, page=kind in ("nested", "discrete", "pixels"))


@pytest.mark.sampled(1)
@pytest.mark.parametrize("env_id", ["Pendulum-v1", "Blackjack-v1"])
def test_real_environments_are_drawn(tmp_path: Path, env_id: str) -> None:
    check_formats(report(record(tmp_path / "r.mcap", gym.make(env_id), 300)), tmp_path, page=False)


def test_what_is_not_shown_is_noted(tmp_path: Path) -> None:
    path = record(tmp_path / "r.mcap", Sampler(NESTED, spaces.Discrete(2)), 40)
    made = report(path)
    assert "state.note is of variable size (Text) and not shown." in made.notes
    assert "state.list is of variable size (Sequence) and not shown." in made.notes
    assert "state.none has no elements (shape (0, 3))." in made.notes
    assert set(made.notes) <= {text.replace("\n", " ") for text in texts(made)}


def test_what_is_not_shown_of_several_recordings_is_noted_once(tmp_path: Path) -> None:
    infos = {"a": {"word": "x"}, "b": {"word": "x"}, "c": {"word": "x", "other": "y"}}
    for name, info in infos.items():
        env = Scripted(lambda n: UNIT.low, UNIT, info=lambda n, info=info: info, length=4)
        record(tmp_path / f"{name}.mcap", env, 8, record_info=True)
    start = "Infos that are no numbers, or many, are not shown: info."
    assert report([tmp_path / "a.mcap", tmp_path / "b.mcap"]).notes == [f"{start}word."]
    assert report([tmp_path / "a.mcap", tmp_path / "c.mcap"]).notes == [
        f"a: {start}word.", f"c: {start}other, info.word.",
    ]  # fmt: skip


def test_each_row_of_pictures_has_the_name_of_its_camera(tmp_path: Path) -> None:
    made = report(record(tmp_path / "r.mcap", Sampler(NESTED, spaces.Discrete(2)), 40))
    found = texts(made)
    assert found.count("state.eye\nstep 0") == found.count("state.stack\nstep 0") == 1


def test_names_and_labels_are_in_the_picture(tmp_path: Path) -> None:
    env = Sampler(UNIT, spaces.Discrete(3))
    labels = {"state": ["height", "speed $^2$", "drag"], "action": ["left", "stay", "right"]}
    path = tmp_path / "r.mcap"
    with RecordEpisodes(env, path, labels=labels) as recorded:
        recorded.reset(seed=1)
        for _ in range(5):
            recorded.step(2)
    found = texts(report(path))
    assert {"height", "speed $^2$", "drag", "left", "stay", "right"} <= set(found)
    assert found.count(" never") == 2


def test_short_unfinished_and_empty_recordings(tmp_path: Path) -> None:
    one_step = record(tmp_path / "one.mcap", gym.make("CartPole-v1"), 1)
    check_formats(report(one_step), tmp_path, page=False)
    writing = RecordEpisodes(gym.make("CartPole-v1"), tmp_path / "live.mcap")
    writing.reset(seed=1)
    writing.step(0)
    made = report(tmp_path / "live.mcap")
    assert dict(made.facts)["recording"] == "live (recording)"
    writing.close()
    write_recording(tmp_path / "empty.mcap", [], observation_space=UNIT, action_space=spaces.Discrete(2))
    with pytest.raises(RecordingError, match=f"^there is no episode to draw in {tmp_path}/empty.mcap$"):
        report(tmp_path / "empty.mcap")
    both = report([tmp_path / "empty.mcap", one_step])
    assert both.notes == ["empty: There is no episode."]
    assert both.png() and both.html()


def test_vector_recordings(tmp_path: Path) -> None:
    path = tmp_path / "r.mcap"
    with vector.RecordEpisodes(
        gym.make_vec("CartPole-v1", num_envs=3, vectorization_mode="sync"), path
    ) as envs:
        envs.reset(seed=1)
        envs.action_space.seed(1)
        for _ in range(60):
            envs.step(envs.action_space.sample())
    found = measured(path)
    with Recording(path) as recording:
        columns = recording.read()
    np.testing.assert_array_equal(np.sort(found.states[0].values.T, axis=0), np.sort(columns.states, axis=0))
    made = report(path)
    assert "3 sub-environments" in dict(made.facts)["environment"]
    assert made.png()


def test_many_episodes_become_bands(tmp_path: Path) -> None:
    episodes = [
        EpisodeData([UNIT.low] * n, [0] * n, [float(i)] * n, [j == n - 1 for j in range(n)], [False] * n)
        for i in range(3100)
        for n in (1 + i % 3,)
    ]
    write_recording(tmp_path / "r.mcap", episodes, observation_space=UNIT, action_space=spaces.Discrete(2))
    made = report(tmp_path / "r.mcap")
    assert {"smallest to largest", "middle 80%", "mean of 12 episodes"} <= set(texts(made))
    check_formats(made, tmp_path, page=False)


@pytest.mark.parametrize(
    ("returns", "told", "note"),
    [
        ([2.0, np.nan, 4.0], "3 ± 1, from 2 to 4", ["return: NaN in 1 episode, left out."]),
        ([np.nan, np.nan], "NaN in every episode", ["return: NaN in every episode."]),
        ([2.0], "2", []),
        ([np.inf], None, []),
    ],
)
def test_returns_that_are_nan_are_counted(
    tmp_path: Path, returns: list[float], told: str | None, note: list[str]
) -> None:
    episodes = [EpisodeData([UNIT.low], [0], [total], [True], [False]) for total in returns]
    write_recording(tmp_path / "r.mcap", episodes, observation_space=UNIT, action_space=spaces.Discrete(2))
    made = report(tmp_path / "r.mcap")
    assert dict(made.facts).get("return") == told
    assert [text for text in made.notes if text.startswith("return: ")] == note
    assert made.figure


@pytest.mark.parametrize("episodes", [1, 2, 7])
def test_few_episodes_are_counted_in_whole_numbers(tmp_path: Path, episodes: int) -> None:
    found = [EpisodeData([UNIT.low], [0], [float(i)], [True], [False]) for i in range(episodes)]
    write_recording(tmp_path / "r.mcap", found, observation_space=UNIT, action_space=spaces.Discrete(2))
    counted = [axes for axes in report(tmp_path / "r.mcap").figure.axes if axes.get_ylabel() == "episodes"]
    assert len(counted) == 1  # of returns; the head says the lengths, which are all the same
    for axes in counted:
        assert len(axes.get_yticks()) >= 2
        assert all(float(tick).is_integer() for tick in axes.get_yticks())


def test_seeds_beyond_64_bits_are_named(tmp_path: Path) -> None:
    with RecordEpisodes(gym.make("CartPole-v1"), tmp_path / "r.mcap") as env:
        for seed in (None, None, 2**100, 7):  # the environment draws the first one, of 128 bits
            env.reset(seed=seed)
            env.step(0)
    with Recording(tmp_path / "r.mcap") as recording:
        drawn, none, *_ = (episode.seed for episode in recording.episodes)
        assert drawn is not None and none is None
        made = recording.plot(episode=0)
        alone = recording.plot(episode=1, episode_filter=F("episode") < 2)
        others = recording.plot(episode_filter=F("seed") == 7)
        seedless = recording.plot(episode_filter=F("episode") == 1)
    assert made.measured[0].seeds == sorted([drawn, 2**100, 7])
    assert dict(made.facts)["seeds"] == f"3 from 7 to {max(drawn, 2**100):.4g}"
    assert f", seed {drawn:.4g}" in "".join(texts(made))
    assert dict(alone.facts)["seeds"] == str(drawn)
    start = min(alone.measured[0].rows["start_time"].tolist())
    assert dict(alone.facts)["recorded"].startswith(f"{local_text(start)}, "), "as in tables"
    assert dict(others.facts)["seeds"] == "7"
    assert dict(seedless.facts)["seeds"] == "none known"


def test_a_wrong_option_is_told_with_the_method(tiny: Path) -> None:
    with (
        Recording(tiny) as recording,
        pytest.raises(TypeError, match=r"^EpisodeViews.plot\(\) got .* 'path'"),
    ):
        recording.plot(path="report.png")  # type: ignore[call-arg]
    with pytest.raises(TypeError, match=r"^EpisodeViews.plot\(\) got .* 'path'"):
        tupli_mcap.open(tiny).plot(path="report.png")  # type: ignore[call-arg]


def test_a_recording_that_is_open(tiny: Path) -> None:
    with Recording(tiny) as recording:
        made = recording.plot(episode=3, episode_filter=F("n_tuples") > 9)
        assert recording.episodes[3].states is not None  # still open
        assert len(made.measured[0].rows) == int((recording.index["length"] > 9).sum()) == 5
    assert [trace.episode for _, trace in made.traces] == [3]
    assert made._repr_png_().startswith(b"\x89PNG")
    assert made._repr_html_().startswith('<div class="tupli-report">')


# --- several recordings ---


def test_recordings_are_compared(tmp_path: Path) -> None:
    for name, seed in (("slow", 1), ("quick", 2)):
        record(tmp_path / f"{name}.mcap", gym.make("CartPole-v1"), 200, seed)
    made = report(tmp_path)
    assert [one.name for one in made.measured] == ["quick", "slow"]
    assert made.title == "CartPole-v1: 2 recordings"
    best = max((one.rows["return"].max(), one.name) for one in made.measured)[1]
    assert [one.name for one, _ in made.traces] == [best]
    check_formats(made, tmp_path, page=False)
    assert not [text for text in texts(made) if "lines are" in text]  # of so few episodes each is on them
    numbered = report(tmp_path, episode="3,best").traces
    assert {one.name for one, _ in numbered} == {"quick", "slow"}
    assert [one.episode for _, one in numbered[:2]] == [3, 3]
    with pytest.raises(RecordingError, match="the set of 2 recordings has no episode 999; choose from 0 to"):
        report(tmp_path, episode=999)
    with pytest.raises(RecordingError, match="expected at most 4 episodes to show in full, found 6"):
        report(tmp_path, episode="0-2")


def test_counts_of_compared_recordings(tmp_path: Path) -> None:
    for name, lengths in (("one", [1]), ("two", [1, 2])):
        found = [
            EpisodeData([UNIT.low] * n, [0] * n, [1.0] * n, [False] * n, [False] * (n - 1) + [True])
            for n in lengths
        ]
        write_recording(tmp_path / name, found, observation_space=UNIT, action_space=spaces.Discrete(2))
    told = dict(report([tmp_path / "one", tmp_path / "two"]).facts)
    assert told["one"] == "1 episode, 1 step, return 1"
    assert told["two"].startswith("2 episodes, 3 steps, return 1.5")


def test_recordings_of_different_spaces_are_compared_by_their_returns(tmp_path: Path) -> None:
    record(tmp_path / "a.mcap", gym.make("CartPole-v1"), 100)
    record(tmp_path / "b.mcap", gym.make("Pendulum-v1"), 300)
    made = report([tmp_path / "a.mcap", tmp_path / "b.mcap"])
    assert made.notes[0].startswith("The recordings have different spaces")
    assert made.png()


def test_what_lines_of_compared_recordings_are_is_said(tmp_path: Path) -> None:
    space = spaces.Box(-99, 99, (1,), np.float32)
    for name, episodes in (("short", 20), ("middle", 55), ("long", 3500)):
        scripted(tmp_path / f"{name}.mcap", lambda n: np.float32([n]), space, episodes, length=1)
    paths = {name: tmp_path / f"{name}.mcap" for name in ("short", "middle", "long")}

    def told(*names: str) -> set[str]:
        made = report([paths[name] for name in names], x="episodes")
        return {text for text in texts(made) if text.startswith("episode;")}

    assert told("short", "middle") == {"episode; lines are means of 2 to 5 episodes"}
    assert told("short", "long") == {"episode; lines are means of 2 to 100 episodes"}
    assert told("long", "long") == {"episode; lines are means of 100 episodes"}


def test_so_many_recordings_that_not_all_are_named(tmp_path: Path) -> None:
    many = tmp_path / "many"
    many.mkdir()
    for i in range(14):
        record(many / f"{i:02}.mcap", gym.make("CartPole-v1"), 20, i)
    assert "and 2 more" in texts(report(many))


def test_a_storage_without_what_it_has_deleted(tmp_path: Path) -> None:
    storage = FileStorage(tmp_path / "lab")
    env = TupliEnvWrapper(gym.make("CartPole-v1"), storage=storage)
    env.store(name="cartpole", description="")
    roll(env, 120)
    env.close()
    headers = storage.list_episodes()
    storage.delete_episode(headers[0].id)
    (one,) = report(tmp_path / "lab").measured
    assert len(one.rows) == len(headers) - 1
    storage.close()


# --- numbers of episodes, and runs ---


def scored(path: Path, lengths: Sequence[int], *, seed: int = 0, **options: Any) -> Path:
    """Episodes of such lengths, a reward of 1 a step; infos say a distance and, at the end of odd ones, success."""
    ended = iter(lengths)
    length = 0

    class Env(Scripted):
        def reset(self, **given: Any) -> Any:
            nonlocal length
            self._length = length = next(ended)
            return super().reset(**given)

    env = Env(
        lambda n: np.float32([n]),
        spaces.Box(-99, 99, (1,), np.float32),
        info=lambda n: {
            "is_success": n % 2 == 1,
            "distance": n + seed,
            "word": "far",
            "left": n % 2 == 0,
            "k": 3,
            "took": np.timedelta64(n, "s"),
        },
    )
    with RecordEpisodes(env, path, record_info=True, **options) as recorder:
        for _ in lengths:
            recorder.reset(seed=seed)
            while not any(recorder.step(0)[2:4]):
                pass
    return path


def panel(made: Report, title: str) -> Any:
    (axes,) = [axes for axes in made.figure.axes if axes.get_title(loc="left") == title]
    return axes


@pytest.mark.parametrize(
    ("x", "label", "expected"),
    [("episodes", "episode", [1, 2, 3]), (None, "episode", [1, 2, 3]), ("steps", "steps", [9, 10, 16])],
)
def test_what_is_on_the_x_axis(tmp_path: Path, x: Any, label: str, expected: list[int]) -> None:
    path = scored(tmp_path / "r.mcap", [7, 2, 1, 6])
    axes = panel(report(path, x=x, episode_filter=F("episode") > 0), "return")
    assert axes.get_xlabel() == label
    at, returns = axes.collections[0].get_offsets().T
    assert (at.tolist(), returns.tolist()) == (expected, [2, 1, 6])  # steps of the first one count


def test_time_on_the_x_axis(tmp_path: Path) -> None:
    path = scored(tmp_path / "r.mcap", [7, 2, 1, 6])
    axes = panel(report(path, x="time"), "return")
    with Recording(path) as recording:
        ended = (recording.index["end_time"] - recording.index["start_time"][0]) / 1e9
    np.testing.assert_allclose(axes.collections[0].get_offsets()[:, 0], ended)
    assert axes.get_xlabel() == "time (s)"
    with pytest.raises(RecordingError, match="expected steps, episodes, time as x, found 'days'"):
        report(path, x="days")  # type: ignore[arg-type]


def test_success_and_numbers_of_infos_and_metadata(tmp_path: Path) -> None:
    path = scored(tmp_path / "r.mcap", [1, 2, 3, 4])
    with Recording(path) as recording:
        for position, score in ((0, 9.5), (2, 4)):
            recording.episodes[position].annotate(score=score, kind="x", constant=1)
    made = report(path)
    (one,) = made.measured
    np.testing.assert_array_equal(one.numbers["success"], [1, 0, 1, 0])
    np.testing.assert_array_equal(one.numbers["metadata.score"], [9.5, np.nan, 4, np.nan])
    np.testing.assert_array_equal(one.numbers["info.distance"], [1, 1.5, 2, 2.5])
    assert dict(made.facts)["success"] == "50%"
    edit_runs(path, name="ppo", metadata={"lr": 0.1, "algo": "p$o"}, split="eval")
    facts = dict(report(path).facts)
    assert (facts["run"], facts["settings"]) == ("ppo (eval)", "lr=0.1, algo=p$o")
    np.testing.assert_array_equal(panel(made, "success rate").lines[0].get_ydata(), [1, 0, 1, 0])
    assert panel(made, "info.distance, mean of each episode") and panel(
        made, "info.left, mean of each episode"
    )
    assert panel(made, "metadata.score") and panel(made, "info.distance")  # of episodes; step by step
    assert not {"metadata.constant", "info.k, mean of each episode"} & set(texts(made))  # all the same
    assert made.notes == ["Infos that are no numbers, or many, are not shown: info.took, info.word."]


def test_of_many_infos_some_are_read(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = scored(tmp_path / "r.mcap", [20] * 20)
    monkeypatch.setattr("tupli_mcap.plots.measure.INFO_STEPS", 100)
    made = report(path)
    found = made.measured[0].numbers["info.distance"]
    assert "Infos are those of 80 of 400 steps." in made.notes
    assert np.isfinite(found).all() and len(set(found.tolist())) > 1
    assert "info.distance" not in texts(made)  # of one episode, as not all of its infos are read


def test_huge_numbers_of_infos_are_left_out(tmp_path: Path) -> None:
    huge = [10**400, -1e300, float("nan"), 5]
    env = Scripted(lambda n: UNIT.low, UNIT, info=lambda n: {"k": huge[n % 4]}, length=4)
    path = record(tmp_path / "r.mcap", env, 8, record_info=True)
    np.testing.assert_array_equal(measured(path).numbers["info.k"], [5, 5])


def test_returns_that_overflow_are_drawn_without_warning(tmp_path: Path) -> None:
    env = Scripted(lambda n: UNIT.low, UNIT, reward=lambda n: 1e308 if n < 4 else -1e308, length=8)
    assert panel(report(record(tmp_path / "r.mcap", env, 16)), "return")


def test_infos_whose_keys_are_no_texts(tmp_path: Path) -> None:
    env = Scripted(lambda n: UNIT.low, UNIT, info=lambda n: {0: n, "x": 1}, length=4)  # type: ignore[dict-item]
    made = report(record(tmp_path / "r.mcap", env, 8, record_info=True))
    np.testing.assert_array_equal(made.measured[0].numbers["info.0"], [2.5, 2.5])
    assert panel(made, "info.0")


def test_infos_without_numbers_are_named(tmp_path: Path) -> None:
    env = Scripted(
        lambda n: UNIT.low,
        UNIT,
        info=lambda n: {"contact": np.ones(17), "force": 1.0, "note": "x", "is_success": False},
        length=4,
    )
    made = report(record(tmp_path / "r.mcap", env, 8, record_info=True))
    assert [note for note in made.notes if note.startswith("Infos")] == [
        "Infos that are no numbers, or many, are not shown: info.contact, info.note."
    ]
    assert "info.force" in texts(made)


def test_numbers_in_infos_are_drawn_one_by_one(tmp_path: Path) -> None:
    env = Scripted(
        lambda n: UNIT.low,
        UNIT,
        info=lambda n: {"contact": {"left": np.array([n, -n]), "on": n % 2 == 0}, "force": 2.0 * n},
        length=4,
    )
    path = record(tmp_path / "r.mcap", env, 8, record_info=True)
    made = report(path)
    assert not made.notes
    numbers = {name: values for name, values in made.measured[0].numbers.items() if name.startswith("info.")}
    assert {name: values.tolist() for name, values in numbers.items()} == {
        "info.force": [5, 5],
        "info.contact.left[0]": [2.5, 2.5],
        "info.contact.left[1]": [-2.5, -2.5],
        "info.contact.on": [0.5, 0.5],
    }
    assert next(iter(numbers)) == "info.force"  # what is one number comes first
    assert panel(made, "info.contact.left[1]").lines[0].get_ydata().tolist() == [-1, -2, -3, -4]
    with Recording(path) as recording:
        assert {name for name in recording.dataset.to_pandas() if name.startswith("info.")} == set(numbers)


def test_infos_of_float32_are_drawn_without_warning(tmp_path: Path) -> None:
    env = Scripted(lambda n: UNIT.low, UNIT, info=lambda n: {"k": np.float32(n)}, length=4)
    path = record(tmp_path / "r.mcap", env, 8, record_info=True)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert len(measured(path).numbers["info.k"]) == 2


def test_runs_have_their_names_where_these_differ(tmp_path: Path) -> None:
    for file, name in (("a", "slow"), ("b", "fast"), ("c", "fast")):
        scored(tmp_path / f"{file}.mcap", [2, 3], name=name)
    paths = [tmp_path / f"{file}.mcap" for file in "abc"]
    assert [group.name for group in report(paths[:2]).groups] == ["slow", "fast"]
    assert [group.name for group in report(paths).groups] == ["slow", "b", "c"]
    assert [one.name for one in report(paths[0]).measured] == ["a"]


def test_runs_that_differ_by_their_seeds_are_one_line(tmp_path: Path) -> None:
    for algo in ("ppo", "sac"):
        for seed in range(3):
            lengths = [2 + seed, 4 + seed, 6] * 10
            scored(
                tmp_path / f"{algo}{seed}.mcap",
                lengths,
                seed=seed,
                name=f"{algo}-seed{seed}",
                metadata={"lr": 1},
            )
    made = report(tmp_path)
    assert [(group.name, len(group.runs)) for group in made.groups] == [("ppo", 3), ("sac", 3)]
    assert [label for label, _ in made.facts] == ["ppo", "sac"]
    assert made.facts[0][1].startswith("3 runs, 90 episodes, 420 steps, return 4.667 ± ")
    assert any(note.startswith("Shades are 95% intervals of the mean over runs") for note in made.notes)
    legend = panel(made, "return").get_legend()
    assert [text.get_text() for text in legend.get_texts()] == ["ppo", "sac"]
    colours = [line.get_color().lower() for line in legend.get_lines()]
    assert colours == re.findall(
        r'<th><i style="background:(#\w+)"></i>(?:ppo|sac)</th>', made._repr_html_().lower()
    )
    assert made.groups[0].states[0].values.shape == (1, 420)
    axes = panel(made, "return")
    assert axes.get_xlabel() == "steps; lines are means of 3 episodes"
    mean = axes.lines[3]  # after those of three runs
    assert mean.get_xdata()[-1] == 120  # the steps of the shortest
    assert mean.get_ydata()[-1] == pytest.approx(np.mean([4, 14 / 3, 16 / 3]))
    check_formats(made, tmp_path, page=False)


@pytest.mark.skipif(CHROMIUM is None, reason="Chromium is not installed: tools/setup-viewer web")
def test_a_dark_notebook_paints_no_rows_of_a_report(tmp_path: Path) -> None:
    scored(tmp_path / "a.mcap", [2, 3, 4])
    notebook = """<style>.cell:not(.text) td, .cell:not(.text) th {text-align: right} .cell {color: #eee}
        .cell tbody tr:nth-child(odd) {background: #111} .cell table {color: #eee}</style><div class="cell">"""
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=CHROMIUM, args=["--no-sandbox"])
        page = browser.new_page()
        page.set_content(f"{notebook}{report(tmp_path / 'a.mcap')._repr_html_()}</div>")
        style = """cell => {const of = getComputedStyle(cell), row = getComputedStyle(cell.parentElement);
            return [of.color, of.textAlign, row.backgroundColor]}"""
        shown = page.locator("td").first.evaluate(style)
        browser.close()
    assert shown == ["rgb(34, 34, 34)", "left", "rgba(0, 0, 0, 0)"]


def test_lines_leave_out_what_the_end_of_a_recording_cut_off(tmp_path: Path) -> None:
    for name in "ab":
        env = gym.vector.SyncVectorEnv([lambda: gym.make("CartPole-v1", max_episode_steps=5)] * 3)
        with vector.RecordEpisodes(env, tmp_path / f"{name}.mcap", name=name) as envs:
            envs.reset(seed=1)
            for step in range(62):  # ten times five steps and a reset, then two steps
                envs.step(np.full(3, step % 2))
    for made in (report(tmp_path / "a.mcap"), report(tmp_path)):
        assert made.measured[0].rows["length"].tolist() == [5] * 30 + [2] * 3
        line = panel(made, "return").lines[0].get_ydata()
        assert set(line[np.isfinite(line)].tolist()) == {5}


def test_histograms_of_a_group_have_its_colour(tmp_path: Path) -> None:
    for seed in range(3):
        scored(tmp_path / f"{seed}.mcap", [2 + seed, 4, 6], seed=seed, name=f"dqn-seed{seed}")
    made = report(tmp_path)
    assert len(made.groups) == 1
    for title in ("return", "length (steps)"):
        (axes,) = [axes for axes in made.figure.axes if axes.get_xlabel() == title]
        assert {to_hex(patch.get_facecolor()).upper() for patch in axes.patches} == {BLUE}
        assert panel(made, title).lines[-1].get_color() == BLUE


@pytest.mark.sampled(4)
@pytest.mark.parametrize(
    ("first", "second", "groups"),
    [
        ({"name": "ppo", "metadata": {"seed": 1}}, {"name": "ppo", "metadata": {"seed": 2}}, ["ppo"]),
        (
            {"name": "Cart-v1__ppo__1__1700000000", "metadata": {"seed": 1}},
            {"name": "Cart-v1__ppo__2__1700000999", "metadata": {"seed": 2}},
            ["Cart-v1__ppo"],
        ),
        ({"name": "ppo-seed1"}, {"name": "ppo-seed2", "split": "eval"}, ["ppo-seed1", "ppo-seed2"]),
        (
            {"name": "ppo-seed1", "metadata": {"lr": 0.1, "env": {"seed": 1}, "eval_seeds": [1, 2]}},
            {"name": "ppo-seed2", "metadata": {"env": {"seed": 2}, "eval_seeds": [3], "lr": 0.1}},
            ["ppo"],
        ),
        (
            {"name": "ppo-seed1", "metadata": {"env": {"wind": 0}}},
            {"name": "ppo-seed2", "metadata": {"env": {"wind": 3}}},
            ["ppo-seed1", "ppo-seed2"],
        ),
        (
            {"name": "ppo", "metadata": {"env_seed": 1}},
            {"name": "ppo", "metadata": {"env_seed": 2}},
            ["ppo"],
        ),
        ({"name": "ppo"}, {"name": "ppo"}, ["a", "b"]),
        ({}, {}, ["a", "b"]),
    ],
)
def test_which_runs_are_of_one_group(
    tmp_path: Path, first: dict[str, Any], second: dict[str, Any], groups: list[str]
) -> None:
    scored(tmp_path / "a.mcap", [2, 3], **first)
    scored(tmp_path / "b.mcap", [2, 3], **second)
    assert [group.name for group in report(tmp_path).groups] == groups


def test_groups_of_the_same_name_are_told_apart(tmp_path: Path) -> None:
    for seed in (1, 2):
        for split in ("train", "eval"):
            about = {"split": split, "metadata": {"phase": split}}
            scored(tmp_path / split / f"{split}{seed}.mcap", [2, 3], name=f"ppo-seed{seed}", **about)
        for folder in ("x", "y"):
            scored(tmp_path / folder / f"sac-seed{seed}.mcap", [2, 3])
        for lr in (0.1, 0.001):
            metadata = {"lr": lr, "gamma": 0.9, "seed": seed}
            scored(tmp_path / f"td3-{lr}-{seed}.mcap", [2, 3], name="td3", metadata=metadata)
    names = [group.name for group in report(tmp_path).groups]
    assert sorted(names) == [
        "ppo (eval)", "ppo (train)", "sac (x)", "sac (y)", "td3 (lr=0.001)", "td3 (lr=0.1)",
    ]  # fmt: skip


def test_runs_that_alone_have_their_name_are_called_by_it(tmp_path: Path) -> None:
    for seed in (1, 2):
        for start in ("x", "y")[:seed]:  # seed 2 was started twice
            path = tmp_path / start / f"ppo-seed{seed}_2026-11-27.mcap"
            scored(path, [2, 3], name=f"ppo-seed{seed}", metadata={"lr": 0.1})
    scored(tmp_path / "ppo-seed3_2026-11-27.mcap", [2, 3, 9], name="ppo-seed3", metadata={"lr": 0.5})
    made = report(tmp_path)
    assert {group.name for group in made.groups} == {"ppo", "ppo-seed3"}
    assert [one.name for one, _ in made.traces] == ["ppo-seed3"]
    assert {one.name for one in made.measured} == {
        "ppo-seed1", "x/ppo-seed2_2026-11-27", "y/ppo-seed2_2026-11-27", "ppo-seed3",
    }  # fmt: skip


def test_the_runs_of_a_file_are_plotted_as_those_of_several(tmp_path: Path) -> None:
    both, files = tmp_path / "both.mcap", [tmp_path / f"{seed}.mcap" for seed in range(2)]
    for seed, file in enumerate(files):
        for path in (both, file):
            with RecordEpisodes(gym.make("CartPole-v1"), path, name=f"ppo-seed{seed}", mode="a") as env:
                env.action_space.seed(seed)
                roll(env, 60, seed=seed)
    merged = tmp_path / "merged.mcap"
    merge_recordings(files, merged)
    wanted = report(files)
    for path in (both, merged):
        made = report(path)
        assert made.title == "CartPole-v1: 2 runs"
        assert [group.name for group in made.groups] == ["ppo"]
        for mine, other in zip(made.groups[0].runs, wanted.groups[0].runs, strict=True):
            assert mine.places("steps").tolist() == other.places("steps").tolist()
            assert mine.places("episodes").tolist() == other.places("episodes").tolist()
            assert mine.numbers("return").tolist() == other.numbers("return").tolist()
    last = report(both).measured[1].rows[-1]
    ((of, shown),) = report(both, episode=int(last["episode"])).traces
    assert (of.name, shown.episode, shown.length) == ("ppo-seed1", last["episode"], last["length"])


def test_a_run_with_a_long_name_is_grouped_at_once(tmp_path: Path) -> None:
    one = measured(scored(tmp_path / "r.mcap", [2, 3], metadata={"seed": 1}))
    one.run = replace(
        one.run, name="-" * 1_000_000
    )  # as only a file can have it: recorders refuse such names
    assert [len(group.runs) for group in groups_of([one])] == [1]


def test_the_files_of_a_run_are_one_line_and_what_was_made_of_them_is_another(tmp_path: Path) -> None:
    scored(tmp_path / "a-seed1.mcap", [2, 3, 4])
    tupli_mcap.open(tmp_path / "a-seed1.mcap").filter("steps > 2").save(tmp_path / "good.mcap")
    made = report([tmp_path / "a-seed1.mcap", tmp_path / "good.mcap"])
    assert [(group.name, len(group.rows)) for group in made.groups] == [("a-seed1", 3), ("good", 2)]
    twice = report([tmp_path / "a-seed1.mcap"] * 2)
    assert [len(group.rows) for group in twice.groups] == [3, 3]


def test_the_files_that_a_run_was_split_into_are_one_line(tmp_path: Path) -> None:
    scored(tmp_path / "a.mcap", [2, 3, 4], name="ppo")
    parts = tupli_mcap.split_recording(tmp_path / "a.mcap", tmp_path / "parts" / "p.mcap", episodes=2)
    made = report([part.path for part in parts])
    assert [(group.name, len(group.rows)) for group in made.groups] == [("ppo", 3)]


@pytest.mark.sampled(0, keep=["9"])
@pytest.mark.parametrize("count", [1, 2, 3, 4, 6, 9])
def test_the_legend_is_beside_the_title(count: int, tmp_path: Path) -> None:
    from matplotlib.backends.backend_agg import FigureCanvasAgg

    for i in range(count):
        scored(tmp_path / f"{'ABCDEFGHI'[i]}-method-with-a-long-name.mcap", [20, 30, 40])
    made = report(tmp_path)
    canvas = FigureCanvasAgg(made.figure)
    canvas.draw()
    legends = [axes for axes in made.figure.axes if axes.get_legend() and axes.get_title(loc="left")]
    checked = [axes for axes in legends if axes.get_title(loc="left") in ("return", "length (steps)")]
    assert len(checked) == 2
    for axes in checked:
        title = axes._left_title.get_window_extent()
        assert axes.get_legend().get_window_extent(canvas.get_renderer()).x0 > title.x1


@pytest.mark.parametrize(
    ("name", "count", "told"),
    [("ppo-{}-of-a-long-name", 2, True), ("ppo-{}-of-a-long-name", 4, False), ("a-long-name-{}", 6, False)],
)
def test_a_legend_tells_its_lines_apart(name: str, count: int, told: bool, tmp_path: Path) -> None:
    for letter in "ABCDEF"[:count]:
        scored(tmp_path / f"{name.format(letter)}.mcap", [20, 30, 40])
    found = panel(report(tmp_path), "return").get_legend()
    assert [text.get_text() for text in found.get_texts()] if told else found is None


def test_an_episode_in_two_files_of_a_directory_counts_once(tmp_path: Path) -> None:
    scored(tmp_path / "a.mcap", [2, 3, 4])
    tupli_mcap.open(tmp_path / "a.mcap").filter("steps > 2").save(tmp_path / "b.mcap")
    again = "b.mcap holds 2 episodes of .*a.mcap again; they are left out"
    for source in (tmp_path, [tmp_path]):
        with pytest.warns(UserWarning, match=again):
            assert [len(group.rows) for group in report(source).groups] == [3]
    with pytest.warns(UserWarning, match=again), pytest.raises(RecordingError, match="no episode matches"):
        report(tmp_path, episode_filter=F("steps") > 9)


def test_the_interval_of_a_mean() -> None:
    values = np.random.default_rng(3).normal(7, 2, (400, 2))
    mean, low, high = mean_interval(values)
    np.testing.assert_array_equal(mean, values.mean(axis=0))
    width = 1.96 * values.std(axis=0) / np.sqrt(400)  # the central limit theorem
    np.testing.assert_allclose([low, high], [mean - width, mean + width], atol=0.03)
    assert [line.tolist() for line in mean_interval(np.array([[3.0]]))] == [[3], [3], [3]]


def test_episodes_of_one_step_take_lines_not_panels(tmp_path: Path) -> None:
    made = report(scored(tmp_path / "r.mcap", [1] * 50))
    assert {"state[0] 0", "action 0", "reward 1"} <= set(texts(made))
    assert "running return" not in texts(made) and "length (steps)" not in texts(made)


def test_a_dataset_is_plotted(tmp_path: Path) -> None:
    for name, seed in (("a", 1), ("b", 2)):
        scored(tmp_path / f"{name}.mcap", [2, 5, 3, 6], seed=seed)
    chosen = tupli_mcap.open(tmp_path).filter("steps > 2").sort("return")
    made = chosen.plot(x="episodes", episode_filter=F("steps") < 6)
    assert [(one.name, one.rows["length"].tolist()) for one in made.measured] == [
        ("a", [5, 3]),
        ("b", [5, 3]),
    ]


# --- files ---


def test_a_picture_is_drawn_once_and_only_if_asked_for(tiny: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    drawn: list[Page] = []
    draw = Page.draw
    monkeypatch.setattr(Page, "draw", lambda page: drawn.append(page) or draw(page))
    made = report(tiny)
    assert dict(made.facts) and not drawn
    made.html()
    assert len(drawn) == 1
    assert made.figure is made.figure
    made.figure.axes[0].set_visible(False)
    assert made.svg() != report(tiny).svg()  # what a user has changed
    assert len(drawn) == 3


def test_the_same_recording_gives_the_same_bytes(tiny: Path) -> None:
    first, second = report(tiny), report(tiny)
    drawn = first.svg()
    assert drawn == second.svg() == first.svg() and drawn.startswith(b"<?xml")
    assert first.html() == second.html()
    pages = first.pdf(), second.pdf()
    assert pages[0] == pages[1] and pages[0].startswith(b"%PDF-")


HOSTILE = "</svg><script>alert(1)</script><img src=x onerror=alert(2)>\"'&$\\frac{--><!--\u202e"


class _Tags(HTMLParser):
    """Every element with its attributes."""

    def __init__(self) -> None:
        super().__init__()
        self.found: list[tuple[str, dict[str, str | None]]] = []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.found.append((tag, dict(attrs)))


def test_nothing_from_a_file_becomes_html(tmp_path: Path) -> None:
    class Env(Sampler):
        pass

    Env.__name__ = Env.__qualname__ = HOSTILE
    path = tmp_path / "<script>alert(3)<" / "r.mcap"  # a "/" would be a directory
    path.parent.mkdir()
    path = path.with_name("<img src=x onerror=alert(4)>.mcap")
    space = spaces.Dict({HOSTILE: UNIT, "x": spaces.Discrete(2)})
    with RecordEpisodes(
        Env(space, spaces.Discrete(2)), path, labels={"action": ["<b onload=x>", "$x$"]}
    ) as env:
        roll(env, 20)
    made = report(path)
    assert HOSTILE[:20] in made.title
    page = made.html().decode()
    for document in (page, page[page.index('<div class="tupli-report">') :]):
        tags = _Tags()
        tags.feed(document)
        names = {tag for tag, _ in tags.found}
        assert not names & {"script", "img", "b", "iframe", "object", "foreignobject", "a", "link"}
        for tag, attributes in tags.found:
            assert not [key for key in attributes if key.startswith("on")], (tag, attributes)
            for key in ("href", "xlink:href", "src"):
                assert (attributes.get(key) or "#").startswith(("#", "data:image/png;"))
        assert "alert(1)" in document  # shown, as text
    assert 'http-equiv="Content-Security-Policy" content="default-src \'none\'' in page
    assert made._repr_html_() in page


def test_a_file_is_written_whole_or_not_at_all(tiny: Path, tmp_path: Path) -> None:
    made = report(tiny)
    goal = tmp_path / "report.png"
    goal.write_bytes(b"old")
    with pytest.raises(
        RecordingError, match=r"report.png exists; choose another name, or pass overwrite=True"
    ):
        made.save(goal)
    assert goal.read_bytes() == b"old"
    assert made.save(goal, overwrite=True) == goal
    with pytest.raises(
        RecordingError, match=r"expected a file that ends in .png, .svg, .pdf, .html, found 'report.gif'"
    ):
        made.save(tmp_path / "report.gif")
    with pytest.raises(RecordingError, match="there is no directory .*; make it first"):
        made.save(tmp_path / "nowhere" / "report.png")
    with pytest.raises(RecordingError, match="is a directory; choose another name"):
        (tmp_path / "d.svg").mkdir()
        made.save(tmp_path / "d.svg", overwrite=True)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["d.svg", "report.png", "tiny.mcap"]


def test_the_users_matplotlib_stays_as_it_is(tiny: Path) -> None:
    import matplotlib as mpl

    with mpl.rc_context({"font.size": 33, "axes.facecolor": "red", "savefig.dpi": 20}):
        before = dict(mpl.rcParams)
        inside = report(tiny).png()
        assert dict(mpl.rcParams) == before
    assert inside == report(tiny).png()
    code = "import sys; from tupli_mcap.plots import report; report(sys.argv[1]).png(); print(*sys.modules)"
    done = subprocess.run(
        [sys.executable, "-c", code, tiny], capture_output=True, text=True, check=True, timeout=60
    )
    modules = done.stdout.split()
    assert "matplotlib.figure" in modules and "matplotlib.pyplot" not in modules


# --- the command ---


def test_the_command(tiny: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    code, out, err = run("plot", tiny)
    assert (code, err) == (0, "")
    assert out.startswith("tiny.png: ") and ", 55 steps, " in out
    code, out, _ = run(
        "plot",
        tiny,
        "-o",
        "two.pdf",
        "--episode",
        "3,worst",
        "--filter",
        "n_tuples > 9",
        "--x",
        "time",
        "--json",
    )
    told = json.loads(out)["result"]
    assert code == 0 and told["path"] == "two.pdf" and told["notes"] == []
    with Recording(tiny) as recording:
        assert told["episodes"] == int((recording.index["length"] > 9).sum())
    assert run("plot", tiny)[::2] == (
        1, "error: tiny.png exists; choose another name, or pass --force\n",
    )  # fmt: skip
    assert run("plot", tiny, "--force")[0] == 0
    with web_server.serving() as web:
        web.files["/lab.v2.mcap"] = tiny.read_bytes()
        assert run("plot", f"{web.url('/lab.v2.mcap')}?sig=SECRET.x")[1].startswith("lab.v2.png: ")


@pytest.mark.parametrize(
    ("args", "code", "message"),
    [
        (["missing.mcap"], 1, "missing.mcap does not exist"),
        (["text.mcap"], 1, "text.mcap"),
        (
            ["cartpole.mcap", "-o", "x.jpeg"],
            1,
            "expected a file that ends in .png, .svg, .pdf, .html, found 'x.jpeg'",
        ),
        (["cartpole.mcap", "-o", "no/x.png"], 1, "there is no directory 'no'; make it first"),
        (["cartpole.mcap", "--episode", "999"], 1, "cartpole.mcap has no episode 999; choose from 0 to"),
        (["cartpole.mcap", "--episode", "finest"], 2, "expected numbers of episodes such as '3,7-9'"),
        (["cartpole.mcap", "--episode", "all"], 1, "expected at most 4 episodes to show in full, found"),
        (
            ["cartpole.mcap", "--filter", "n_tuples > 99999"],
            1,
            "no episode matches n_tuples > 99999; use another filter",
        ),
        (["cartpole.mcap", "--filter", "n_tuples >"], 2, "error: "),
        (["cartpole.mcap", "--x", "days"], 2, "for '--x': 'days' is not one of 'steps', 'episodes', 'time'"),
        (["cartpole.mcap", "--filter", "color = 3"], 2, "color"),
        ([], 2, "Missing argument"),
    ],
)
def test_bad_input_is_one_line(
    cartpole: Path, monkeypatch: pytest.MonkeyPatch, args: list[str], code: int, message: str
) -> None:
    monkeypatch.chdir(cartpole.parent)
    Path("text.mcap").write_text("no recording")
    found, out, err = run("plot", *args)
    assert (found, out, err.count("\n")) == (code, "", 1), err
    assert message in err
    assert not list(Path().glob("*.png"))


def test_without_matplotlib_the_extra_is_named(cartpole: Path, tmp_path: Path) -> None:
    (tmp_path / "hidden").mkdir()
    (tmp_path / "hidden" / "matplotlib.py").write_text("raise ImportError('hidden')\n")
    path = os.pathsep.join(filter(None, (str(tmp_path / "hidden"), os.environ.get("PYTHONPATH", ""))))

    def tool(*args: object) -> subprocess.CompletedProcess[str]:
        return subprocess.run(
            [TOOL, *map(str, args)], capture_output=True, text=True, check=False,
            env={**os.environ, "PYTHONPATH": path}, cwd=tmp_path, timeout=60,
        )  # fmt: skip

    done = tool("plot", cartpole)
    assert (done.returncode, done.stdout) == (1, "")
    assert done.stderr == f"error: reports need matplotlib: {install_line('plot')}\n"
    assert "Cart Position" in tool("info", cartpole).stdout  # needs none of it


def test_a_word_that_is_none_is_refused(cartpole: Path) -> None:
    with pytest.raises(FilterError, match="expected numbers of episodes"):
        report(cartpole, episode="finest")


# --- lines of blocks in info ---


def test_blocks_follow_the_numbers() -> None:
    assert sparkline([0, 1, 2, 3, 4, 5, 6, 7]) == "▁▂▃▄▅▆▇█"
    assert sparkline([5, 5]) == "▅▅"
    assert sparkline([0, 1, float("nan"), 100], zero_based=True) == " ▁ █"
    assert sparkline([-1e308, 1e308]) == "▁█"
    assert sparkline([0, 7], blocks=PLAIN) == ".@"
    assert sparkline([float("nan")]) == ""


def test_a_depth_image_does_not_hide_the_joints(tmp_path: Path) -> None:
    states = {"depth": np.ones((9, 6, 8), np.uint16), "joints": np.ones((9, 2))}
    tupli_mcap.write_rollout(tmp_path / "r.mcap", states, np.zeros((9, 2)), np.zeros(9))
    with Recording(tmp_path / "r.mcap") as recording:
        names = [series.name for series in sketch(recording, 10).distributions]
    assert names[1:4] == ["state.joints[0]", "state.joints[1]", "state.depth[0,0]"]


def test_a_sketch_is_of_the_whole_data(cartpole: Path) -> None:
    with Recording(cartpole) as recording:
        found = sketch(recording, 10)
        states, rows = recording.read().states.astype(np.float64), recording.index
    returns, lengths = found.courses
    parts = np.array_split(rows["length"], 10)
    np.testing.assert_allclose(sorted(lengths.values), sorted(part.mean() for part in parts), rtol=0.2)
    assert (lengths.least, lengths.most) == (min(lengths.values), max(lengths.values))
    assert lengths.each == -(-len(rows) // 10)
    assert returns.values == lengths.values  # a reward of 1 a step
    by_name = {series.name: series for series in found.distributions}
    assert list(by_name)[:2] == ["reward", "Cart Position"] and list(by_name)[-1] == "action"
    for i, name in enumerate(("Cart Position", "Cart Velocity")):
        np.testing.assert_array_equal(by_name[name].values, np.histogram(states[:, i], 10)[0])
    assert (found.sampled, found.hidden, found.error) == (400, 0, "")


def test_bars_of_whole_numbers_hold_as_many_of_them(tmp_path: Path) -> None:
    space = spaces.Box(0, 100, (1,), np.int64)
    path = scripted(tmp_path / "r.mcap", lambda n: np.array([n % 50]), space, 500, length=500)
    with Recording(path) as recording:
        (state,) = [found for found in sketch(recording, 40).distributions if found.name == "state[0]"]
    assert state.values == (20.0,) * 25


def test_choices_outside_of_the_space_are_counted_where_they_are(tmp_path: Path) -> None:
    path = scripted(
        tmp_path / "r.mcap", lambda n: np.int64(5 if n % 4 == 0 else n % 4), spaces.Discrete(4), 20, length=20
    )
    with Recording(path) as recording:
        (state,) = [found for found in sketch(recording, 40).distributions if found.name == "state"]
    assert (state.values, state.least, state.most) == ((0, 5, 5, 5, 0, 5), 0, 5)


def test_info_says_what_is_not_finite(tmp_path: Path) -> None:
    odd = {3: np.nan, 7: np.inf, 11: -np.inf}
    path = scripted(
        tmp_path / "r.mcap", lambda n: np.array([odd.get(n, n), 2 * n, np.nan]), spaces.Box(-99, 99, (3,), np.float64),
        20, length=20,
    )  # fmt: skip
    with Recording(path) as recording:
        assert [series.odd for series in sketch(recording, 10).distributions] == [0, 3, 0, 20, 0]
    out = run("info", path)[1]
    assert "\nnot finite, left out: 3 of state[0], 20 of state[2]\n" in out
    (line,) = [line for line in out.splitlines() if line.startswith("state[2]")]
    assert line == "state[2]"  # neither a smallest value nor a largest one


def test_of_a_long_recording_a_sketch_reads_a_few_chunks(
    cartpole: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = record(cartpole.with_name("long.mcap"), gym.make("CartPole-v1"), 3000, chunk_size=2048)
    monkeypatch.setattr(
        "tupli_mcap.recording.describe.series.READ_BYTES", 16 * 77 * 10
    )  # ten steps at each of 16 places
    with Recording(path) as recording:
        loaded: set[int] = set()
        chunk = recording._store._chunk
        monkeypatch.setattr(
            recording._store, "_chunk", lambda i, *a, **kw: loaded.add(i) or chunk(i, *a, **kw)
        )
        found = sketch(recording, 10)
        assert found.sampled == 160
        chunks = recording._store.chunks(recording._topics["/step"])
        assert 0 < len(loaded) < len(chunks)
    assert f"{found.sampled} steps sampled" in run("info", path)[1]


@pytest.mark.parametrize("kind", KINDS)
def test_info_of_every_kind(tmp_path: Path, kind: str) -> None:
    path = record(tmp_path / "r.mcap", Sampler(*KINDS[kind]), 20)
    for width in ("40", "200"):
        result = CliRunner().invoke(app, ["info", str(path)], env={"COLUMNS": width})
        assert result.exit_code == 0 and result.stderr == ""
        lines = result.stdout.splitlines()
        assert any(line.startswith("return ") for line in lines)
        start = next(i for i, line in enumerate(lines) if line.startswith("EPISODES"))
        assert max(map(len, lines[start:])) <= int(width)


def test_info_where_blocks_cannot_be_printed(cartpole: Path) -> None:
    done = subprocess.run(
        [TOOL, "info", str(cartpole)], capture_output=True, check=True, timeout=60,
        env={**os.environ, "PYTHONIOENCODING": "ascii"},
    )  # fmt: skip
    (line,) = [line for line in done.stdout.decode("ascii").splitlines() if line.startswith("Pole Angle ")]
    assert set(line) & set(PLAIN)


def test_info_of_a_damaged_chunk_and_of_none(cartpole: Path, tmp_path: Path) -> None:
    with Recording(cartpole) as recording:
        table = recording._contents.table
        chunk = table[table["channel"] == recording._topics["/step"]][0]
    data = bytearray(cartpole.read_bytes())
    data[int(chunk["offset"]) + int(chunk["length"]) // 2] ^= 255
    cartpole.write_bytes(data)
    code, out, err = run("info", cartpole)
    assert (code, err) == (0, "") and "return " in out
    assert "distributions cannot be shown: " in out
    assert "sketch" not in run("info", cartpole, "--json")[1]
    write_recording(tmp_path / "empty.mcap", [], observation_space=UNIT, action_space=spaces.Discrete(2))
    assert "FIRST TO LAST" not in run("info", tmp_path / "empty.mcap")[1]


def test_recordings_without_a_matching_episode_are_left_out(tmp_path: Path) -> None:
    for name, seed in (("a", 1), ("b", 2)):
        record(tmp_path / f"{name}.mcap", gym.make("CartPole-v1"), 60, seed=seed, name=name)
    made = report([tmp_path / "a.mcap", tmp_path / "b.mcap"], episode_filter=F("run.name") == "b")
    assert [group.name for group in made.groups] == ["b"] and len(made.measured) == 1


def test_a_value_outside_of_the_space_has_no_name(tmp_path: Path) -> None:
    path, zero = tmp_path / "r.mcap", np.zeros(1, np.float32)
    labels = {"actions": ["left", "stay", "right"]}
    with tupli_mcap.EpisodeWriter(path, spaces.Box(-1, 1, (1,)), spaces.Discrete(3), labels=labels) as writer:
        for action in (-1, 1, 7):
            writer.begin()
            writer.step(zero, action, reward=1.0, terminal=True)
            writer.end(zero)
    texts = [text.get_text() for text in report(path, episode="0,1,2").figure.findobj(Text)]
    assert {"action -1", "action 1 (stay)", "action 7"} <= set(texts)


def test_a_report_can_be_pickled(tmp_path: Path) -> None:
    found = report([record(tmp_path / f"{seed}.mcap", gym.make("CartPole-v1"), 60, seed) for seed in (1, 2)])
    before = pickle.loads(pickle.dumps(found))
    assert found.png() == before.png() == pickle.loads(pickle.dumps(found)).png()


@pytest.mark.parametrize(
    ("count", "name", "drawn"),
    [
        (32, "{0}-{1}", [f"{algorithm}-{i}" for i in range(16) for algorithm in ("a", "b")]),
        (34, "{0}-{1}", ["a-*", "b-*"]),
        (34, "{0}-{1}-seed3", ["a-*", "b-*"]),
        (35, "{0}-{1}", ["a-*", "b-*", "sac2"]),
        (34, "{2}", ["all runs"]),
    ],
)
def test_many_runs_are_drawn_as_few(tmp_path: Path, count: int, name: str, drawn: list[str]) -> None:
    for i in range(count):
        word = chr(ord("a") + i // 26) + chr(ord("a") + i % 26)
        run_name = "sac2" if i == 34 else name.format("ab"[i % 2], i // 2, word)
        with EpisodeWriter(tmp_path / f"{i:03}.mcap", UNIT, spaces.Discrete(2), name=run_name) as writer:
            writer.begin()
            writer.step(np.zeros(3, np.float32), 0, i, terminated=True)
    found = report(tmp_path)
    assert [group.name for group in found.groups] == drawn
    assert sum(len(group.rows) for group in found.groups) == count
    assert any(note.startswith("Of more than 32 runs") for note in found.notes) == (count > 32)
    assert found.png()
