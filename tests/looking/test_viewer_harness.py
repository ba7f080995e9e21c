"""That the tests of the viewer can fail: it sees empty views, complaints and files that are none; it leaves nothing."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import psutil
import pytest
import rerun as rr
import rerun.blueprint as rrb
from viewing import HeadlessViewer, NoViewerError


def save(path: Path, *views: rrb.View) -> rr.RecordingStream:
    recording = rr.RecordingStream(path.stem)  # the viewer keeps the blueprint of an application once opened
    recording.save(path, default_blueprint=rrb.Blueprint(rrb.Grid(*views), collapse_panels=True))
    return recording


def test_it_sees_which_views_are_empty(viewer: HeadlessViewer, tmp_path: Path) -> None:
    full = rrb.TimeSeriesView(origin="/state", name="full"), rrb.TextDocumentView(origin="/card", name="card")
    empty = rrb.TimeSeriesView(origin="/no", name="empty"), rrb.TextDocumentView(origin="/no", name="no card")
    with save(tmp_path / "views.rrd", *full, *empty) as recording:
        values = np.sin(np.arange(200) / 5)
        recording.send_columns(
            "/state", [rr.TimeColumn("step", sequence=np.arange(200))], rr.Scalars.columns(scalars=values)
        )
        recording.log("/card", rr.TextDocument("# Card\n" + "words " * 50), static=True)
    recording.disconnect()
    viewer.show(tmp_path / "views.rrd")
    assert viewer.problems() == []
    assert viewer.filled() == {"full": True, "card": True, "empty": False, "no card": False}


def test_it_hears_complaints(viewer: HeadlessViewer, tmp_path: Path) -> None:
    with save(tmp_path / "bad.rrd", rrb.Spatial2DView(origin="/picture", name="picture")) as recording:
        recording.log("/picture", rr.Image(bytes=b"4", width=9, height=9, color_model="L", datatype="U8"))
    recording.disconnect()
    viewer.show(tmp_path / "bad.rrd")
    (problem,) = viewer.problems()
    assert problem.startswith("picture: error: Invalid data length for texture")


def test_it_moves_in_time(viewer: HeadlessViewer, tmp_path: Path) -> None:
    with save(tmp_path / "time.rrd", rrb.Spatial2DView(origin="/picture", name="picture")) as recording:
        for step, color in enumerate(([255, 0, 0], [0, 0, 255])):
            recording.set_time("step", sequence=step)
            recording.log("/picture", rr.Image(np.tile(np.uint8(color), (8, 8, 1))))
    recording.disconnect()
    (view,) = viewer.show(tmp_path / "time.rrd").views
    middle = []
    for step in (0, 1):
        viewer.seek("step", step)
        picture = viewer.screenshot(view)
        middle.append(picture[picture.shape[0] // 2, picture.shape[1] // 2].tolist())
    assert middle == [[255, 0, 0], [0, 0, 255]]


def test_it_leaves_no_process(tmp_path: Path) -> None:
    with HeadlessViewer(tmp_path) as viewer:
        assert psutil.pid_exists(viewer.pid)
    assert not psutil.pid_exists(viewer.pid)


def test_it_says_why_there_is_no_viewer(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("WGPU_BACKEND", "nothing")
    monkeypatch.setenv("VK_DRIVER_FILES", str(tmp_path))
    monkeypatch.setenv("VK_ICD_FILENAMES", str(tmp_path))
    with pytest.raises(NoViewerError, match="graphics"):
        HeadlessViewer(tmp_path).settled()
