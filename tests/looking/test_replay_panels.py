"""What becomes of every kind of leaf in a replay, and of what is too much, not a number or strangely named."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from gymnasium import spaces

from tupli_mcap import RecordEpisodes, Recording, viewer
from tupli_mcap.recording import EpisodeData, write_recording

pytest.importorskip("rerun")
from rrd import Rrd, joined_rows, states_of

Box = spaces.Box


class Sampled(gym.Env[Any, Any]):
    """States from a function of the step, or samples of the space; an episode has 10 steps."""

    def __init__(
        self,
        space: gym.Space[Any],
        state: Callable[[int], Any] | None = None,
        action: gym.Space[Any] | None = None,
        info: Callable[[int], dict[str, Any]] | None = None,
    ) -> None:
        self.observation_space = space
        self.action_space = action or spaces.Discrete(3)
        self._state = state or (lambda _: space.sample())
        self._info = info or (lambda _: {})
        self._step = 0

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, Any]:
        self._step = 0
        return self._state(0), {}

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        self._step += 1
        return self._state(self._step), 1.0, self._step == 10, False, self._info(self._step)


def replayed(tmp_path: Path, env: gym.Env[Any, Any], steps: int = 20, **options: Any) -> Rrd:
    path = tmp_path / "sampled.mcap"
    env.observation_space.seed(1)
    with RecordEpisodes(env, path, **options) as recorder:
        recorder.action_space.seed(1)
        recorder.reset(seed=1)
        for _ in range(steps):
            *_, terminated, _, _ = recorder.step(recorder.action_space.sample())
            if terminated:
                recorder.reset()
    return Rrd(viewer.save(path, tmp_path / "sampled.rrd", overwrite=True))


def card(found: Rrd) -> str:
    return str(found.rows("/card", "TextDocument:text")[0][0])


@pytest.mark.parametrize(
    ("returns", "told"),
    [
        ([2.0, np.nan, 4.0], "mean 3, from 2 to 4; NaN in 1 episode, left out"),
        ([np.nan, np.nan], "NaN in every episode"),
        ([2.0, 4.0], "mean 3, from 2 to 4"),
    ],
)
def test_the_card_leaves_returns_that_are_nan_out(tmp_path: Path, returns: list[float], told: str) -> None:
    space = spaces.Discrete(2)
    episodes = [EpisodeData([0], [0], [total], [True], [False]) for total in returns]
    write_recording(tmp_path / "r.mcap", episodes, observation_space=space, action_space=space)
    assert f"| return | {told} |" in card(Rrd(viewer.save(tmp_path / "r.mcap", tmp_path / "r.rrd")))


@pytest.mark.parametrize("large", [1e308, 1e20])
def test_large_returns_stay_in_their_episodes(large: float, tmp_path: Path) -> None:
    space = spaces.Discrete(2)
    n = 3
    episodes = [
        EpisodeData([0] * n, [0] * n, rewards, [False, False, True], [False] * n)
        for rewards in ([large] * n, [1.0] * n)
    ]
    write_recording(tmp_path / "r.mcap", episodes, observation_space=space, action_space=space)
    found = Rrd(viewer.save(tmp_path / "r.mcap", tmp_path / "r.rrd"))
    returns = found.scalars("/return")[:, 0]
    sums = [large, 2 * large, 3 * large, 1, 2, 3]
    assert returns[np.isfinite(returns)].tolist() == [total for total in sums if np.isfinite(total)]


def test_dimensions_of_other_scales_are_other_entities(tmp_path: Path) -> None:
    scales = np.array([1.0, 500.0, 2.0, 0.001, 0.0])
    found = replayed(tmp_path, Sampled(Box(-np.inf, np.inf, (5,), np.float64), lambda t: scales * (t + 1)))
    groups = {entity: found.scalars(entity) for entity in found.entities() if entity.startswith("/state")}
    assert set(groups) == {"/state/dims_0_2", "/state/dims_1", "/state/dims_3_4"}
    steps = np.tile(np.arange(1.0, 12), 2)
    assert np.array_equal(groups["/state/dims_1"][:, 0], 500 * steps)
    assert np.array_equal(groups["/state/dims_0_2"], np.outer(steps, [1.0, 2.0]))


def test_images_leave_enough_steps_to_tell_scales_by(tmp_path: Path) -> None:
    image, number = np.zeros((200, 200, 3), np.uint8), Box(-np.inf, np.inf, (2,), np.float64)
    space = spaces.Dict({"camera": Box(0, 255, image.shape, np.uint8), "x": number})
    state = Sampled(space, lambda t: {"camera": image, "x": np.array([1.0, 0.0 if t == 4 else 500.0])})
    found = replayed(tmp_path, state)
    assert {"/state/x/dims_0", "/state/x/dims_1"} <= set(found.entities())


def test_more_than_twelve_dimensions_are_a_heat_map_an_episode(tmp_path: Path) -> None:
    found = replayed(
        tmp_path, Sampled(Box(-1, 1, (13,), np.float64), lambda t: np.sin(t / 9 + np.arange(13)))
    )
    maps = found.rows("/state/heat_map", "Tensor:data")
    assert found.rows("/state/heat_map", "step") == [0, 11]
    assert [item[0]["shape"] for item in maps] == [[13, 11], [13, 11]]
    values = np.array(maps[0][0]["buffer"]).reshape(13, 11)
    assert values.min() == 0.0 and values.max() == 1.0
    lines = {entity for entity in found.entities() if entity.startswith("/state/dims")}
    assert sum(found.scalars(entity).shape[1] for entity in lines) == 13
    assert all(found.scalars(entity).shape[1] <= 6 for entity in lines)


def test_ten_thousand_dimensions_are_pooled(tmp_path: Path) -> None:
    wide = np.arange(10_000, dtype=np.float32)
    found = replayed(tmp_path, Sampled(Box(-np.inf, np.inf, (10_000,)), lambda t: wide * t))
    assert {entity for entity in found.entities() if entity.startswith("/state")} == {"/state/heat_map"}
    assert found.rows("/state/heat_map", "Tensor:data")[0][0]["shape"] == [512, 11]
    assert "10,000 dimensions are in the heat map only" in card(found)


def test_images_and_grids(tmp_path: Path) -> None:
    space = spaces.Dict({"eye": Box(0, 255, (4, 6, 3), np.uint8), "map": Box(0, 1, (5, 4), np.float32)})
    found = replayed(tmp_path, Sampled(space))
    with Recording(tmp_path / "sampled.mcap") as recording:
        seen = {
            key: np.concatenate(
                [[*episode.states[key], episode.final_state[key]] for episode in recording.episodes]
            )
            for key in ("eye", "map")
        }
    pictures = np.array(found.rows("/state/eye", "Image:buffer"), np.uint8)
    assert np.array_equal(pictures.reshape(22, 4, 6, 3), seen["eye"])
    assert found.rows("/state/eye", "step") == found.rows("/state/map", "step") == list(range(22))
    (form,) = found.rows("/state/eye", "Image:format")
    assert (form[0]["width"], form[0]["height"]) == (6, 4)
    grids = np.array([item[0]["buffer"] for item in found.rows("/state/map", "Tensor:data")], np.float32)
    assert np.array_equal(grids.reshape(22, 5, 4), seen["map"])


STACKS = [
    ((20, 16), 4, False, True),
    ((20, 16), 4, True, True),
    ((20, 16), 6, False, True),
    ((20, 16, 3), 5, True, True),
    ((20, 16), 4, False, False),
    ((20, 16, 3), 2, False, False),
]


@pytest.mark.parametrize(("shape", "count", "last", "said"), STACKS)
def test_frames_of_a_stack_stand_upright_beside_each_other(
    tmp_path: Path, shape: tuple[int, ...], count: int, last: bool, said: bool
) -> None:
    env: Any = Sampled(Box(0, 255, shape if said else (count, *shape), np.uint8))
    if said:
        env = gym.wrappers.FrameStackObservation(env, count)
    if last:
        space = Box(0, 255, (*shape, count), np.uint8)
        env = gym.wrappers.TransformObservation(env, lambda frames: np.moveaxis(frames, 0, -1), space)
    found = replayed(tmp_path, env)
    with Recording(tmp_path / "sampled.mcap") as recording:
        assert bool(recording.layout.stacks) == said  # type: ignore[union-attr]
        seen = np.concatenate([states_of(episode) for episode in recording.episodes])
    frames = np.moveaxis(seen, -1, 1) if last else seen
    frames = frames.reshape(*frames.shape[:4], -1)
    across = {2: 2, 4: 2, 5: 3, 6: 3}[count]
    down = -(-count // across)
    (form,) = found.rows("/state", "Image:format")
    assert (form[0]["width"], form[0]["height"]) == (16 * across, 20 * down)
    pictures = np.array(found.rows("/state", "Image:buffer"), np.uint8)
    pictures = pictures.reshape(len(seen), 20 * down, 16 * across, frames.shape[-1])
    for i in range(across * down):
        y, x = 20 * (i // across), 16 * (i % across)
        tile = pictures[:, y : y + 20, x : x + 16]
        newest_first = frames[:, ::-1]
        assert np.array_equal(tile, newest_first[:, i] if i < count else np.zeros_like(tile))


@pytest.mark.parametrize(("shape", "side"), [((84, 84), 84), ((84, 84, 4), 168)])
def test_atari_is_grey_where_nothing_says_what_the_values_are(
    tmp_path: Path, shape: tuple[int, ...], side: int
) -> None:
    found = replayed(tmp_path, Sampled(Box(0, 255, shape, np.uint8)))
    (form,) = found.rows("/state", "Image:format")
    assert (form[0]["width"], form[0]["height"]) == (side, side)
    assert len(found.rows("/state", "Image:buffer")[0][0]) == side * side  # a byte a pixel


@pytest.mark.parametrize(
    ("shape", "side"), [((4, 20, 16), (40, 32)), ((20, 16, 3), (20, 16)), ((20, 16, 4), (20, 16))]
)
@pytest.mark.parametrize(("low", "high"), [(0, 1), (-1, 1), (0, 255), (-np.inf, np.inf)])
def test_pictures_of_floats_are_shown_between_their_bounds(
    tmp_path: Path, shape: tuple[int, ...], side: tuple[int, int], low: float, high: float
) -> None:
    found = replayed(tmp_path, Sampled(Box(low, high, shape, np.float32)))
    (form,) = found.rows("/state", "Image:format")
    assert (form[0]["height"], form[0]["width"]) == side
    pictures = np.array(found.rows("/state", "Image:buffer"), np.uint8)
    with Recording(tmp_path / "sampled.mcap") as recording:
        seen = np.concatenate([states_of(episode) for episode in recording.episodes])
    if np.isinf(low):  # between the values that there are
        assert pictures.min() < 20 and pictures.max() > 235
        return
    shades = np.rint((seen - low) / (high - low) * 255)
    if shape[0] == 4:  # the newest frame stands first
        shown, shades = pictures.reshape(-1, *side)[:, :20, :16], shades[:, -1]
    else:
        shown = pictures.reshape(-1, *shape)
    np.testing.assert_allclose(shown, shades, atol=1)


@pytest.mark.parametrize("shape", [(20, 16), (20, 16, 7), (4, 8, 8)])
def test_fields_of_floats_are_grids(tmp_path: Path, shape: tuple[int, ...]) -> None:
    found = replayed(tmp_path, Sampled(Box(0, 1, shape, np.float32)))
    assert found.rows("/state", "Tensor:data")[0][0]["shape"] == list(shape)


def test_camera_frames_are_sent_as_they_are(tmp_path: Path) -> None:
    pytest.importorskip("PIL")
    env = gym.make("CartPole-v1", render_mode="rgb_array", max_episode_steps=8)
    path = tmp_path / "filmed.mcap"
    with RecordEpisodes(env, path, frames=3) as recorder:
        for seed in range(2):
            recorder.reset(seed=seed)
            for step in range(8):
                recorder.step(step % 2)
    found = Rrd(viewer.save(path, tmp_path / "filmed.rrd"))
    assert found.rows("/camera/render", "step") == [0, 3, 6, 8, 9, 12, 15, 17]
    with Recording(path) as recording:
        encoded = [recording.frames(at).encoded(i) for at in range(2) for i in range(4)]
    assert [bytes(row[0]) for row in found.rows("/camera/render", "EncodedImage:blob")] == [
        frame.data for frame in encoded
    ]
    assert found.rows("/camera/render", "EncodedImage:media_type") == [[f"image/{encoded[0].form}"]] * 8
    apart = Rrd(viewer.save(path, tmp_path / "apart.rrd", form="apart"))
    assert [apart.rows("/camera/render", "step", i) for i in range(2)] == [[0, 3, 6, 8]] * 2


def test_texts_and_values_of_variable_size(tmp_path: Path) -> None:
    space = spaces.Dict(
        {"says": spaces.Text(8), "list": spaces.Sequence(spaces.Discrete(4)), "none": Box(0, 1, (0, 3))}
    )
    found = replayed(tmp_path, Sampled(space))
    with Recording(tmp_path / "sampled.mcap") as recording:
        episodes = recording.episodes
        said = [text for one in episodes for text in (*one.states["says"], one.final_state["says"])]
    assert found.rows("/state/says", "step") == [*range(22)] * 2  # the text, and the log of it
    assert [row[0] for row in found.rows("/state/says", "TextLog:text")] == said
    assert [row[0] for row in found.rows("/state/says", "TextDocument:text")] == said
    assert len(found.rows("/state/list", "TextDocument:text")) == 22
    assert "none has no values" in card(found)


def test_names_that_are_no_entity_paths(tmp_path: Path) -> None:
    names = ["a/b", "ü ñ", "", "..", "x" * 300, "\N{ESCAPE}[2J", "[0]", "/"]
    space = spaces.Dict([(name, Box(0, 1, (2,))) for name in names])
    found = replayed(tmp_path, Sampled(space))
    entities = [entity for entity in found.entities() if entity.startswith("/state")]
    assert len(entities) == len(names)
    assert all(found.scalars(entity).shape == (22, 2) for entity in entities)
    assert "\N{ESCAPE}" not in "".join(entities)


def test_keys_that_utf_8_lacks(tmp_path: Path) -> None:
    parts = [("\ud800", Box(0, 1, ())), ("\udfff", spaces.Discrete(2)), ("\ud900", spaces.Text(3))]
    space = spaces.Dict(parts)
    found = replayed(tmp_path, Sampled(space))  # the SDK warns of a name that it cannot take
    assert len([entity for entity in found.entities() if entity.startswith("/state")]) == 3


def test_keys_that_would_be_one_entity_stay_apart(tmp_path: Path) -> None:
    long = "x" * 100
    space = spaces.Dict([(long + "a", Box(0, 1, (2,))), (long + "b", Box(0, 1, (2,)))])
    found = replayed(tmp_path, Sampled(space))
    assert len([entity for entity in found.entities() if entity.startswith("/state")]) == 2


def test_what_is_not_finite_stays_in_its_step(tmp_path: Path) -> None:
    odd = [np.nan, np.inf, -np.inf, 1.0]
    path = tmp_path / "odd.mcap"
    episode = EpisodeData(
        states=np.array([[value] for value in odd]),
        actions=np.zeros(4, np.int64),
        rewards=np.array([1.0, np.nan, 1.0, 1.0]),
        terminals=np.array([False, False, False, True]),
        timeouts=np.zeros(4, np.bool_),
    )
    space = Box(-np.inf, np.inf, (1,), np.float64)
    write_recording(path, [episode, episode], observation_space=space, action_space=spaces.Discrete(2))
    found = Rrd(viewer.save(path, tmp_path / "odd.rrd"))
    assert np.array_equal(found.scalars("/state")[:, 0], odd * 2, equal_nan=True)
    nan = np.nan
    assert np.array_equal(found.scalars("/return")[:, 0], [1, nan, nan, nan] * 2, equal_nan=True)
    # a marker at no height would not be seen
    assert found.scalars("/end/terminal").tolist() == [[0], [0]]
    assert found.rows("/end/terminal", "step") == [3, 8]


def test_a_single_step_is_a_point_since_it_makes_no_line(tmp_path: Path) -> None:
    space = Box(-1, 1, (1,))
    single = replayed(tmp_path, Sampled(space, info=lambda _: {"speed": 1.0}), steps=1, record_info=True)
    for entity in ("/state", "/reward", "/return", "/info/speed"):
        assert single.rows(entity, "SeriesPoints:markers") and "SeriesLines:names" not in single.columns(
            entity
        )
    (tmp_path / "two").mkdir()
    assert "SeriesPoints:markers" not in replayed(tmp_path / "two", Sampled(space), steps=2).columns("/state")


def test_lines_break_between_episodes(tmp_path: Path) -> None:
    env = Sampled(Box(0, 1, (2,)), info=lambda step: {"speed": step} if step > 3 else {})
    found = replayed(tmp_path, env, record_info=True)
    second, first_speed = 11, 14  # rows, the second episode's
    for entity, row in {
        "/state": second,
        "/reward": second,
        "/return": second,
        "/info/speed": first_speed,
    }.items():
        (at,) = found.breaks(entity)
        assert found.rows(entity, "step")[at] == row


def test_actions_are_lanes_or_steps(tmp_path: Path) -> None:
    action = spaces.Dict({"gear": spaces.Discrete(3, start=-1), "wheel": Box(-1, 1, (2,))})
    found = replayed(
        tmp_path,
        Sampled(Box(0, 1, (1,)), action=action),
        labels={"action['gear']": ["back", "neutral", "forth"]},
    )
    with Recording(tmp_path / "sampled.mcap") as recording:
        actions = recording.read(fields=["actions"]).actions
    gears = [("back", "neutral", "forth")[gear + 1] for gear in actions["gear"]]
    steps, finals = joined_rows(np.array([10, 10]))
    held = np.array(found.held("/action/gear", 22))
    assert held[steps].tolist() == gears and held[finals].tolist() == ["", ""]
    assert found.rows("/action/wheel", "step") == steps
    assert np.array_equal(found.scalars("/action/wheel"), actions["wheel"])
    assert found.rows("/action/wheel", "SeriesLines:interpolation_mode") == [[2]]  # held until the next


def test_infos_are_series_and_logs(tmp_path: Path) -> None:
    def info(step: int) -> dict[str, Any]:
        told = {"said": f"step {step}", "speed": step / 2, "won": step == 10, "array": np.zeros(17)}
        told["contact"] = {"left": np.array([step, -step])}
        told |= {"took": np.timedelta64(step, "s"), "phase": np.complex64(1j)}
        return told if step % 2 == 0 else {"speed": step / 2}

    found = replayed(tmp_path, Sampled(Box(0, 1, (1,)), info=info), record_info=True)
    speeds = np.tile(np.arange(1, 11) / 2, 2)
    assert np.array_equal(found.scalars("/info/speed")[:, 0], speeds)
    assert found.rows("/info/won", "step") == [1, 3, 5, 7, 9, 12, 14, 16, 18, 20]
    assert found.rows("/info/said", "TextLog:text")[:2] == [["step 2"], ["step 4"]]
    assert all(f"info '{key}'" in card(found) for key in ("array", "took", "phase"))
    assert "info 'contact" not in card(found)
    sides = found.scalars(r"/info/contact.left\[1\]")[:, 0]
    assert sides[~np.isnan(sides)].tolist() == [-2, -4, -6, -8, -10] * 2


@pytest.mark.parametrize("rare", range(10))
def test_an_info_that_only_one_of_ten_episodes_has(tmp_path: Path, rare: int) -> None:
    steps = 0

    def info(step: int) -> dict[str, Any]:
        nonlocal steps
        steps += 1
        return {"rare": step} if (steps - 1) // 10 == rare else {}

    found = replayed(tmp_path, Sampled(Box(0, 1, (1,)), info=info), 100, record_info=True)
    assert found.rows("/info/rare", "step") == list(range(11 * rare, 11 * rare + 10))


@pytest.mark.parametrize("form", ["joined", "compare"])
def test_what_only_the_second_recording_has_is_shown(tmp_path: Path, form: Any) -> None:
    pytest.importorskip("PIL")
    paths = [tmp_path / "plain.mcap", tmp_path / "filmed.mcap"]
    for path in paths:
        env = gym.make("CartPole-v1", render_mode="rgb_array", max_episode_steps=3)
        filmed = path.stem == "filmed"
        callback = (lambda step: {"speed": 2.0}) if filmed else None
        with RecordEpisodes(env, path, frames=filmed, step_callback=callback) as recorder:
            recorder.reset(seed=0)
            for _ in range(3):
                recorder.step(0)
    found = Rrd(viewer.save(paths, tmp_path / "both.rrd", form=form))
    root, first = ("", 4) if form == "joined" else ("/filmed_0", 0)
    assert found.rows(f"{root}/camera/render", "step") == list(range(first, first + 4))
    assert found.rows(f"{root}/info/speed", "step") == list(range(first, first + 3))


def test_infos_whose_keys_are_no_texts(tmp_path: Path) -> None:
    def info(step: int) -> dict[Any, Any]:
        return {0: step / 2, "x": 1.0, 7: "said", (1, 2): np.zeros(17)}

    found = replayed(tmp_path, Sampled(Box(0, 1, (1,)), info=info), record_info=True)
    assert np.array_equal(found.scalars("/info/0")[:, 0], np.tile(np.arange(1, 11) / 2, 2))
    assert len(found.scalars("/info/x")) == 20
    assert found.rows("/info/7", "TextLog:text")[0] == ["said"]
    assert r"info '\(1, 2\)'" in card(found)


def test_time_in_the_environment_is_a_timeline_where_it_is_known(tmp_path: Path) -> None:
    with RecordEpisodes(gym.make("Pendulum-v1"), tmp_path / "pendulum.mcap") as recorder:
        recorder.reset(seed=1)
        for _ in range(100):
            recorder.step(np.zeros(1, np.float32))
    found = Rrd(viewer.save(tmp_path / "pendulum.mcap", tmp_path / "pendulum.rrd"))
    with Recording(tmp_path / "pendulum.mcap") as recording:
        labels = recording.labels
    assert labels.step_seconds is not None
    seconds = [at.total_seconds() for at in found.rows("/state", "episode_time")]
    assert np.allclose(seconds, np.arange(101) * labels.step_seconds, atol=1e-6)
    assert found.rows("/state", "SeriesLines:names") == [list(labels.dimensions["state"])]
    unknown = replayed(tmp_path, Sampled(Box(0, 1, (1,))))
    assert unknown.rows("/state", "step") and unknown.rows("/state", "episode_time") == []


def counted(path: Path, lengths: list[int], known: list[bool]) -> None:
    """Episodes whose states are those of one count, each final one, known or not, included."""
    episodes = []
    first = 0.0
    for length, has_final in zip(lengths, known, strict=True):
        values = np.arange(first, first + length + 1)[:, None]
        ends = np.zeros(length, np.bool_)
        actions = np.arange(length) % 2
        final = values[-1] if has_final else None
        episodes.append(EpisodeData(values[:-1], actions, np.ones(length), ends, ends, final_state=final))
        first += length + 1
    space = Box(-np.inf, np.inf, (1,), np.float64)
    write_recording(path, episodes, observation_space=space, action_space=spaces.Discrete(2))


@pytest.mark.parametrize("known", [True, False])
def test_an_episode_longer_than_a_block_goes_on(tmp_path: Path, known: bool) -> None:
    n = 70_000
    path = tmp_path / "long.mcap"
    counted(path, [3, n, 65_536, 2], [True, known, known, True])
    found = Rrd(viewer.save(path, tmp_path / "long.rrd"))
    rows = list(range(3 + n + 65_536 + 2 + 4))
    steps, finals = joined_rows(np.array([3, n, 65_536, 2]))
    if not known:
        for row in finals[1:3]:
            rows.remove(row)
    assert found.rows("/state", "step") == rows
    assert np.array_equal(found.scalars("/state")[:, 0], rows)
    assert found.rows("/return", "step") == found.rows("/action", "step") == steps
    returns = np.concatenate([np.arange(1, length + 1) for length in (3, n, 65_536, 2)])
    assert np.array_equal(found.scalars("/return")[:, 0], returns)


def test_a_final_state_that_is_not_known_leaves_its_row_empty(tmp_path: Path) -> None:
    path = tmp_path / "unknown.mcap"
    counted(path, [2, 3, 2, 1], [False, True, False, False])
    found = Rrd(viewer.save(path, tmp_path / "unknown.rrd"))
    rows = [0, 1, 3, 4, 5, 6, 7, 8, 10]
    assert found.rows("/state", "step") == rows
    assert found.scalars("/state")[:, 0].tolist() == rows
    assert found.held("/action", 12) == ["0", "1", "", "0", "1", "0", "", "0", "1", "", "0", ""]
    apart = Rrd(viewer.save(path, tmp_path / "apart.rrd", form="apart"))
    assert [apart.rows("/state", "step", i) for i in range(4)] == [[0, 1], [0, 1, 2, 3], [0, 1], [0]]


def test_a_lane_of_states_ends_where_the_final_one_is_not_known(tmp_path: Path) -> None:
    path = tmp_path / "lanes.mcap"
    none = np.zeros(2, np.bool_)
    episodes = [
        EpisodeData(np.array([0, 1]), np.array([1, 1]), np.ones(2), none, none, final_state=final)
        for final in (2, None, 1)
    ]
    write_recording(path, episodes, observation_space=spaces.Discrete(3), action_space=spaces.Discrete(2))
    found = Rrd(viewer.save(path, tmp_path / "lanes.rrd"))
    assert found.held("/state", 9) == ["0", "1", "2", "0", "1", "", "0", "1", "1"]
    assert found.held("/action", 9) == ["1", "1", ""] * 3


def test_the_overview_is_of_all_episodes(tmp_path: Path) -> None:
    n = 1500
    with RecordEpisodes(Sampled(Box(0, 1, (1,))), tmp_path / "many.mcap") as recorder:
        for _ in range(n):
            recorder.reset()
            recorder.step(0)
    found = Rrd(viewer.save(tmp_path / "many.mcap", tmp_path / "many.rrd", "last"))
    assert found.scalars("/overview/return").tolist() == [[1.0]] * n
    assert found.rows("/overview/return", "episode") == list(range(n))
    (bars,) = found.rows("/overview/length", "BarChart:values")
    assert bars[0]["shape"] == [1000]  # no window shows more
    (places,) = found.rows("/overview/length", "BarChart:abscissa")
    (widths,) = found.rows("/overview/length", "BarChart:widths")
    begins = np.array(places[0]["buffer"])
    assert begins[0] == 0 and np.array_equal(begins[:-1] + widths[:-1], begins[1:])
    assert begins[-1] + widths[-1] == n  # the axis counts episodes, not bars
    assert len(found.scalars("/reward")) == 1


def test_recordings_with_other_panels_are_of_other_applications(tmp_path: Path) -> None:
    """A viewer keeps the blueprint of an application: panels that it lacks would stay hidden."""

    def application(**options: Any) -> str:
        env = Sampled(Box(-1, 1, (2,)), lambda t: np.full(2, t / 10, np.float32), info=lambda t: {"t": t})
        env.metadata, env.render_mode = {"render_modes": ["rgb_array"]}, "rgb_array"  # type: ignore[misc]
        env.render = lambda: np.zeros((8, 8, 3), np.uint8)  # type: ignore[method-assign, return-value]
        (entry,) = replayed(tmp_path, env, mode="w", **options).recordings
        return str(entry.application_id)

    plain, filmed, told = application(), application(frames=True), application(record_info=True)
    assert len({plain, filmed, told, application(frames=True, record_info=True)}) == 4
    assert application() == plain and application(frames=2) == filmed


@pytest.mark.parametrize("name", ["läuft gut", "实验"])
def test_the_viewer_takes_the_name_of_any_file(
    name: str, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / f"{name}.mcap"
    space = spaces.Discrete(2)
    episode = EpisodeData([0], [1], [1.0], [True], [False])
    write_recording(path, [episode], observation_space=space, action_space=space)
    viewer.save(path, tmp_path / "r.rrd")
    assert "Application ID" not in capfd.readouterr().err
