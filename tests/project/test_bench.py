"""The benchmark itself: it runs, what it writes is whole, and nobody's wrong result is timed."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import xml.etree.ElementTree as ET
from pathlib import Path
from typing import Any

import numpy as np
import pytest

ROOT = Path(__file__).resolve().parents[2]
sys.path.insert(0, str(ROOT))

from tools.bench import report, workloads  # noqa: E402
from tools.bench.contenders import OURS, make  # noqa: E402
from tools.bench.data import check_same  # noqa: E402
from tools.bench.fleet import NoAnswerError, Process  # noqa: E402
from tools.bench.matrix import VECTORS  # noqa: E402
from tools.bench.measure import WrongResultError  # noqa: E402
from tools.bench.worker import Worker  # noqa: E402

SIDES = (OURS, "HDF5 by hand", ".npy, mapped")


@pytest.fixture(scope="module")
def quick(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """What a quick run of some parts writes."""
    pytest.importorskip("h5py")
    output = tmp_path_factory.mktemp("bench")
    command = [sys.executable, "-m", "tools.bench", "--quick", "--output", str(output)]
    command += [part for side in SIDES for part in ("--with", side)]
    command += [
        part for name in ("floats", "growth", "noise", "vector", "pictures") for part in ("--only", name)
    ]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=250, check=False)
    assert done.returncode == 0, done.stderr
    return output


@pytest.mark.sampled(0)  # of a tool; at night, all of it
class TestQuickRun:
    def test_every_cell_has_a_figure_or_a_reason(self, quick: Path) -> None:
        results = json.loads((quick / "results.json").read_text())
        assert results["failures"] == []
        for work, found in results["matrix"].items():
            for operation, row in found["cells"].items():
                loading = {"HDF5 by hand"} if operation.startswith("epoch") else set()
                assert set(row) == set(SIDES) - loading
                for side, cell in row.items():
                    assert bool(cell["values"]) != bool(cell["cannot"]), (work, operation, side)
            assert all(cell["values"] for cell in (row[OURS] for row in found["cells"].values()))

    def test_vector_environments_are_compared(self, quick: Path) -> None:
        cells = json.loads((quick / "results.json").read_text())["vectors"]["cells"]
        assert {operation: set(row) for operation, row in cells.items()} == {
            "record": set(SIDES),
            "size": set(SIDES),
            "read": set(SIDES),
        }
        assert all(cell["values"] for row in cells.values() for cell in row.values())
        assert "## Recording 64 sub-environments" in (quick / "README.md").read_text()

    def test_both_formats_of_images_are_compared(self, quick: Path) -> None:
        rows = json.loads((quick / "results.json").read_text())["pictures"]
        assert [row["form"] for row in rows] == ["raw", "png"] * 5
        assert all(row[key] > 0 for row in rows for key in ("bytes", "read1", "read2"))
        page = (quick / "README.md").read_text()
        assert page.count("| pixels |") == page.count("| PNG |") == 5

    def test_growth_has_all_sizes(self, quick: Path) -> None:
        growth = json.loads((quick / "results.json").read_text())["growth"]
        for points in growth.values():
            assert [point["steps"] // 1000 for point in points][:1] == [1]
            assert {"record", "list", "read", "window", "bytes", "memory"} <= set(points[0])

    def test_pages_and_pictures(self, quick: Path) -> None:
        page = (quick / "README.md").read_text()
        assert all(f"| **{side}** |" in page or f"| {side} |" in page for side in SIDES)
        assert "| size of 256 incompressible bytes a step, over these bytes | <= 1.3 x |" in page
        for name in ("floats", "growth"):
            assert f"({name}.svg)" in page
            assert ET.parse(quick / f"{name}.svg").getroot().tag.endswith("svg")

    def test_drawn_anew_it_is_the_same(self, quick: Path) -> None:
        before = {path.name: path.read_bytes() for path in quick.iterdir()}
        command = [sys.executable, "-m", "tools.bench", "--render", "--output", str(quick)]
        subprocess.run(command, cwd=ROOT, capture_output=True, timeout=120, check=True)
        assert {path.name: path.read_bytes() for path in quick.iterdir()} == before


class TestChecks:
    @pytest.fixture
    def worker(self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Worker:
        monkeypatch.setenv(workloads.DATA, str(tmp_path))
        made = Worker(".npy, mapped")
        request = {"do": "build", "work": "floats", "path": str(tmp_path / "run"), "steps": 2000}
        assert made.answer(request)["value"]["steps"] == 2000
        return made

    @pytest.mark.parametrize("do", ["read", "field", "episode", "window", "filter"])
    def test_wrong_actions_are_not_timed(self, worker: Worker, tmp_path: Path, do: str) -> None:
        ask = {"work": "floats", "path": str(tmp_path / "run")}
        assert worker.answer({"do": do, **ask})["value"] > 0
        actions = np.load(tmp_path / "run" / "actions.npy", mmap_mode="r+")
        actions[:] += 1e-3
        del actions
        worker._sessions.clear()
        assert worker.answer({"do": do, **ask}) == {"failed": "WrongResultError: other actions"}

    def test_wrong_lengths_are_not_timed(self, worker: Worker, tmp_path: Path) -> None:
        np.save(tmp_path / "run" / "lengths.npy", np.array([999, 1001]))
        answer = worker.answer({"do": "list", "work": "floats", "path": str(tmp_path / "run")})
        assert answer == {"failed": "WrongResultError: other lengths"}

    def test_a_narrower_type_is_told_from_another_value(self) -> None:
        wanted = {"rewards": np.array([0.1, 0.2])}
        assert not check_same({"rewards": np.array([0.1, 0.2])}, wanted)
        assert check_same({"rewards": np.array([0.1, 0.2], np.float32)}, wanted)
        with pytest.raises(WrongResultError, match="other rewards"):
            check_same({"rewards": np.array([0.1, 0.3], np.float32)}, wanted)
        with pytest.raises(WrongResultError, match="no rewards"):
            check_same({}, wanted)

    @pytest.mark.parametrize("name", ["cartpole", "floats", "dict", "noise"])
    def test_a_rollout_is_what_the_data_say(
        self, name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        """The data are computed from the tables; the recorder sees the environment."""
        monkeypatch.setenv(workloads.DATA, str(tmp_path))
        work = workloads.WORKLOADS[name]
        data = workloads.reference(name, 2500)
        _, steps = make(OURS).record(work, tmp_path / "run.mcap", len(data.lengths))
        found, lengths = make(OURS).read(tmp_path / "run.mcap")
        assert steps == data.steps >= 2500
        assert not check_same(found, data.leaves)
        assert lengths is not None
        assert lengths.tolist() == data.lengths.tolist()


class TestVectors:
    @pytest.mark.parametrize("name", VECTORS)
    def test_what_was_recorded_is_compared(
        self, name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        """Resets are no steps; where one value differs, there is no time. Each contender is tried with another leaf."""
        worker, path = Worker(name), str(tmp_path / "run.mcap")
        worker._trials = [1.0, 1.0]  # how long it takes is not asked
        ask = {"do": "build", "work": workloads.VECTOR, "steps": 6400}
        answer = worker.answer({**ask, "path": path})
        if "NotFoundError" in answer.get("failed", ""):
            pytest.skip(answer["failed"])
        assert answer["value"]["steps"] == 6400 - 6  # of 100 vector steps
        assert answer["value"]["bytes"] > 0
        read = worker._contender.read_vector
        leaves = sorted(read(Path(path)))
        leaf = leaves[VECTORS.index(name) % len(leaves)]

        def changed(path: Path) -> dict[str, Any]:
            found = read(path)
            found[leaf] = np.array(found[leaf])
            found[leaf].flat[77] = not found[leaf].flat[77]
            return found

        monkeypatch.setattr(worker._contender, "read_vector", changed)
        answer = worker.answer({**ask, "path": str(tmp_path / f"{leaf}.mcap")})
        assert answer["failed"].startswith("WrongResultError: other ")


class TestFleet:
    def test_a_contender_that_dies_is_said_to(self, tmp_path: Path) -> None:
        process = Process(".npy, mapped", tmp_path)
        try:
            assert process.ask("versions")["versions"]["numpy"] == np.__version__
            assert process._process is not None
            os.kill(process._process.pid, 9)
            process._process.wait()
            assert process.ask("versions")["versions"]  # another one was started
            with pytest.raises(NoAnswerError, match=r"took more than 0 s \(build\)"):
                process.ask("build", 0.001, work="floats", path=str(tmp_path / "a"), steps=100_000)
            assert not process.alive
        finally:
            process.stop()

    def test_a_contender_that_is_not_installed(self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        monkeypatch.setattr("tools.bench.fleet.ROOT", tmp_path)
        with pytest.raises(NoAnswerError, match="not installed: run tools/setup-venv-peers"):
            Process("PyTupli", tmp_path).ask("versions")

    def test_a_failure_is_in_the_table(self) -> None:
        cells: dict[str, Any] = {}
        for operation in report.OPERATIONS:
            values = [] if operation == "read" else [2.0, 4.0]
            cells[operation] = {
                OURS: {"values": [4.0, 8.0], "cannot": "", "failed": ""},
                "mcap": {
                    "values": values,
                    "cannot": "",
                    "failed": "" if values else "WrongResultError: other actions",
                },
            }
        table = report.table({"built": {OURS: {"steps": 100}, "mcap": {"steps": 50}}, "cells": cells})
        row = next(line for line in table.splitlines() if line.startswith("| mcap"))
        assert "failed<sup>1</sup>" in row
        assert "<sup>1</sup> mcap: WrongResultError: other actions." in table
        assert row.count("⚡2.0x") == sum(not op.higher for op in report.OPERATIONS.values())
        assert "slower ones fewer, which favours them: mcap 50" in table
