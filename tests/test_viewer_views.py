"""What people see: recordings of all kinds, saved by the command line and opened in the real viewer."""

from __future__ import annotations

from pathlib import Path

import pytest
import viewed
from typer.testing import CliRunner
from viewing import HeadlessViewer

from tupli_mcap.cli import app


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("viewed")


def saved(recording: Path, *options: str) -> Path:
    """The `.rrd` that `tupli-mcap replay` makes of a recording."""
    goal = recording.with_suffix(".rrd")
    result = CliRunner().invoke(app, ["replay", str(recording), *options, "--save", str(goal), "--force"])
    assert result.exit_code == 0, result.output
    return goal


def classes(viewer: HeadlessViewer) -> dict[str, str]:
    return {view.name: view.view_class for view in viewer.client.get_state().views}


ABOUT = {"recording": "TextDocument", "returns": "BarChart", "lengths": "BarChart"}


def test_cart_pole(viewer: HeadlessViewer, folder: Path) -> None:
    state = viewer.show(saved(viewed.cart_pole(folder / "cart_pole.mcap")))
    assert viewer.problems() == []
    assert (
        classes(viewer).items()
        >= {"state": "TimeSeries", "return": "TimeSeries", "reward": "TimeSeries"}.items()
    )
    assert classes(viewer).items() >= ABOUT.items()
    empty = {name for name, filled in viewer.filled().items() if not filled}
    assert empty <= {
        "action"
    }  # of a thousand changes the viewer tells the number, in grey, until one zooms in
    (recording,) = state.recordings
    assert recording.current_timeline == "step"
    ranges = {timeline.name: (timeline.start, timeline.end) for timeline in recording.timelines}
    assert ranges["step"][0] == 0 and ranges["step"][1] > 500
