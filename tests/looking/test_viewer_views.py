"""What people see: recordings of all kinds, saved by the command line and opened in the real viewer."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import viewed
from environments import Sampler
from gymnasium import spaces
from rerun.experimental import ViewerState
from typer.testing import CliRunner
from viewing import HeadlessViewer, patiently

from tupli_mcap import RecordEpisodes
from tupli_mcap.cli import app

PLOT, LANES, PICTURE, TEXT, BARS = "TimeSeries", "StateTimeline", "2D", "TextDocument", "BarChart"
ABOUT = {"recording": TEXT, "returns": BARS, "lengths": BARS}
REWARDS = {"return": PLOT, "reward": PLOT}


@pytest.fixture(scope="module")
def cart_pole(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return viewed.cart_pole(tmp_path_factory.mktemp("viewed") / "cart_pole.mcap", episodes=3)


def shown(viewer: HeadlessViewer, recording: Path, *options: str) -> ViewerState:
    """What the viewer says of the file that `tupli-mcap view` makes of a recording; it complains of nothing."""
    goal = recording.with_suffix(".rrd")
    result = CliRunner().invoke(app, ["view", str(recording), *options, "-o", str(goal), "--force"])
    assert result.exit_code == 0, result.output
    state = viewer.show(goal)
    assert viewer.problems() == []
    return state


def views(state: ViewerState) -> dict[str, str]:
    return {view.name: view.view_class for view in state.views}


def ranges(state: ViewerState) -> dict[str, tuple[int | None, int | None]]:
    return {line.name: (line.start, line.end) for line in state.recordings[0].timelines}


def test_cart_pole(viewer: HeadlessViewer, cart_pole: Path) -> None:
    state = shown(viewer, cart_pole)
    assert views(state) == {"state": PLOT, "action": LANES, **REWARDS, **ABOUT}
    assert viewer.filled() == dict.fromkeys(["state", "action", "return", "reward", "recording"], True)
    assert state.recordings[0].current_timeline == "step"
    steps, seconds = ranges(state)["step"], ranges(state)["episode_time"]
    assert steps[0] == 0 and steps[1] > 400
    assert seconds == (0, steps[1] * 20_000_000)  # CartPole's steps take 20 ms
    assert ranges(state)["time"][0] > 1_700_000_000_000_000_000


def test_many_episodes(viewer: HeadlessViewer, tmp_path: Path) -> None:
    state = shown(viewer, viewed.cart_pole(tmp_path / "many.mcap", episodes=12))
    assert views(state) == {"state": PLOT, "action": LANES, **REWARDS, **ABOUT}
    assert viewer.filled("returns", "state") == {"returns": True, "state": True}  # no view is behind a tab
    assert ranges(state)["step"][1] < 3 * 301


def test_one_of_several_episodes_apart(viewer: HeadlessViewer, cart_pole: Path) -> None:
    state = shown(viewer, cart_pole, "--apart")
    assert views(state) == {"state": PLOT, "action": LANES, **REWARDS, **ABOUT}
    (start, end), (first, last) = ranges(state)["step"], ranges(state)["episode_time"]
    assert (start, first) == (0, 0) and end <= 300 and last == end * 20_000_000


def test_all_episodes_apart_are_opened_from_the_standard_input(
    viewer: HeadlessViewer, cart_pole: Path, tmp_path: Path
) -> None:
    shown(viewer, cart_pole, "--apart")
    with HeadlessViewer(tmp_path, piped=cart_pole.with_suffix(".rrd")) as window:
        for _ in patiently(120.0):
            if len(window.settled().recordings) == 3:
                break
        assert len(window.client.get_state().recordings) == 3 and window.problems() == []


def test_recordings_of_different_environments_are_opened_without_a_complaint(
    cart_pole: Path, tmp_path: Path
) -> None:
    other, goal = viewed.talk(tmp_path / "talk.mcap"), tmp_path / "both.rrd"
    result = CliRunner().invoke(app, ["replay", str(cart_pole), str(other), "--save", str(goal)])
    assert "open it with: rerun - < " in result.output
    with HeadlessViewer(tmp_path, piped=goal) as window:
        for _ in patiently(120.0):
            if len(window.settled().recordings) == 2:
                break
        assert len(window.client.get_state().recordings) == 2 and window.problems() == []


def test_compared_episodes(viewer: HeadlessViewer, cart_pole: Path) -> None:
    state = shown(viewer, cart_pole, "--compare", "--episode", "best,worst")
    names = ("Cart Position", "Cart Velocity", "Pole Angle", "Pole Angular Velocity")
    assert views(state).items() >= {f"state: {name}": PLOT for name in names}.items()
    assert viewer.filled("state: Pole Angle", "return") == {"state: Pole Angle": True, "return": True}
    assert ranges(state)["step"] == (0, 300)  # the final state follows the last step


def test_compared_texts_say_whose_they_are(viewer: HeadlessViewer, tmp_path: Path) -> None:
    state = shown(viewer, viewed.courier(tmp_path / "courier.mcap", episodes=2), "--compare")
    wanted = {f"episode {number}: state · task": TEXT for number in range(2)}
    assert views(state).items() >= wanted.items()


def test_lanes_of_all_compared_episodes_are_in_sight(viewer: HeadlessViewer, cart_pole: Path) -> None:
    def height(*options: str) -> int:
        (lanes,) = (v for v in shown(viewer, cart_pole, *options).views if v.view_class == LANES)
        return len(viewer.screenshot(lanes))

    assert height("--compare") > 1.15 * height("--compare", "--episode", "best")


def test_pixels(viewer: HeadlessViewer, tmp_path: Path) -> None:
    state = shown(viewer, viewed.atari(tmp_path / "atari.mcap", episodes=1, steps=60))
    assert views(state) == {"state": PICTURE, "action": LANES, **REWARDS, **ABOUT}
    (screen,) = (view for view in state.views if view.view_class == PICTURE)
    viewer.seek("step", 40)
    colors = viewer.screenshot(screen).reshape(-1, 3)
    bricks = (colors == (200, 72, 72)).all(axis=1) | (colors == (66, 72, 200)).all(axis=1)
    assert bricks.mean() > 0.02  # the top and the bottom row, as the Atari paints them
    assert viewer.filled("action", "return") == {"action": True, "return": True}


@pytest.mark.parametrize(
    ("shape", "name"), [((4, 40, 30), "state: 4 frames, the newest first"), ((40, 30), "state")]
)
def test_a_stack_says_its_order(
    viewer: HeadlessViewer, tmp_path: Path, shape: tuple[int, ...], name: str
) -> None:
    env = Sampler(spaces.Box(0, 255, shape, np.uint8), spaces.Discrete(2))
    with RecordEpisodes(env, tmp_path / "stack.mcap") as recorded:
        viewed.rollout(recorded, lambda _: 0, 1)
    assert views(shown(viewer, tmp_path / "stack.mcap"))[name] == PICTURE


def test_dict(viewer: HeadlessViewer, tmp_path: Path) -> None:
    state = shown(viewer, viewed.courier(tmp_path / "courier.mcap", episodes=1))
    plots = dict.fromkeys([f"state · {name}" for name in ("position", "velocity", "goal", "battery")], PLOT)
    rest = {"state · carrying": LANES, "action · gripper": LANES, "action · thrust": PLOT}
    seen = {"state · camera": PICTURE, "state · task": TEXT, "state · task: log": "TextLog"}
    assert views(state).items() >= {**plots, **rest, **seen, **REWARDS, **ABOUT}.items()
    (camera,) = (view for view in state.views if view.view_class == PICTURE)
    assert viewer.screenshot(camera).size > 0.13 * viewer.screenshot().size
    heat = "state · lidar: 24 dimensions, each from its lowest to its highest"
    assert views(state)[heat] == "Tensor"
    drawn = [
        "state · position",
        "state · carrying",
        "state · camera",
        "state · task",
        "action · thrust",
        heat,
    ]
    assert viewer.filled(*drawn) == dict.fromkeys(drawn, True)


def test_many_dimensions(viewer: HeadlessViewer, tmp_path: Path) -> None:
    state = shown(viewer, viewed.legged(tmp_path / "legged.mcap"))
    heat = "state: 40 dimensions, each from its lowest to its highest"
    assert views(state)[heat] == "Tensor"
    assert views(state).items() >= {"action": PLOT, **REWARDS, **ABOUT}.items()
    assert viewer.filled("action", heat) == {"action": True, heat: True}


def test_text(viewer: HeadlessViewer, tmp_path: Path) -> None:
    state = shown(viewer, viewed.talk(tmp_path / "talk.mcap"))
    assert views(state).items() >= {"state": TEXT, "action": TEXT, **REWARDS, **ABOUT}.items()
    viewer.seek("step", 1)
    assert viewer.filled("state", "action") == {"state": True, "action": True}


def test_vector(viewer: HeadlessViewer, tmp_path: Path) -> None:
    state = shown(viewer, viewed.pendulums(tmp_path / "pendulums.mcap"))
    assert views(state).items() >= {"state": PLOT, "action": PLOT, **REWARDS, **ABOUT}.items()
    assert viewer.filled("state", "action") == {"state": True, "action": True}
