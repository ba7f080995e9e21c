"""Each script in examples/ runs as it is, in an empty directory and without a display."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

SCRIPTS = sorted((Path(__file__).parents[2] / "examples").glob("*.py"))


ELSEWHERE = {"atari", "cleanrl_ppo", "sb3_ppo"}  # pages of the tutorials run them


@pytest.mark.sampled(0, keep=sorted({path.stem for path in SCRIPTS} - ELSEWHERE))
@pytest.mark.parametrize("script", SCRIPTS, ids=lambda path: path.stem)
def test_it_runs(script: Path, tmp_path: Path) -> None:
    shown = {"DISPLAY", "WAYLAND_DISPLAY"}
    environment = {name: value for name, value in os.environ.items() if name not in shown}
    # on a busy machine, threads of PyTorch that wait for each other take minutes
    environment["OMP_NUM_THREADS"] = "1"
    done = subprocess.run(
        [sys.executable, str(script)],
        cwd=tmp_path,
        env=environment,
        stdin=subprocess.DEVNULL,
        capture_output=True,
        text=True,
        check=False,
        timeout=240,
    )
    assert done.returncode == 0, done.stderr
    assert "Traceback" not in done.stderr
    assert "Warning" not in done.stderr
    assert done.stdout
    assert list(tmp_path.rglob("*.mcap")), "an example records"


def test_no_two_write_the_same_file() -> None:
    written = [name for path in SCRIPTS for name in set(re.findall(r'"([\w/]+\.mcap)"', path.read_text()))]
    assert len(written) == len(set(written)) > 5
