"""The processes of the contenders, seen from the one that runs the benchmark."""

from __future__ import annotations

import contextlib
import json
import os
import select
import signal
import subprocess
import sys
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from tools.bench.contenders import ENTRIES

ROOT = Path(__file__).resolve().parent.parent.parent


class NoAnswerError(Exception):
    """A contender has not given a figure.

    Attributes:
        why: "cannot", "failed".
    """

    def __init__(self, why: str, what: str) -> None:
        super().__init__(what)
        self.why = why


@dataclass
class Process:
    """One contender; started when it is first asked, and again when it has died."""

    name: str
    directory: Path  # what the processes of this run share
    _process: subprocess.Popen[str] | None = field(default=None, init=False)

    def ask(self, do: str, timeout: float = 60.0, **arguments: Any) -> Any:
        """The value of the answer.

        Raises:
            NoAnswerError: it cannot, it failed, it died, or there was no answer in `timeout` seconds.
        """
        process = self._started()
        stdin, stdout = process.stdin, process.stdout
        if stdin is None or stdout is None:
            raise NoAnswerError("failed", "has no pipes")
        try:
            print(json.dumps({"do": do, **arguments}), file=stdin, flush=True)
            ready, _, _ = select.select([stdout], [], [], timeout)
            line = stdout.readline() if ready else None
        except OSError as err:
            line = ""
            del err
        if not line:
            self.stop()
            what = f"took more than {timeout:.0f} s" if line is None else "its process died"
            raise NoAnswerError("failed", f"{what} ({do})")
        answer = json.loads(line)
        if "value" in answer:
            return answer["value"]
        why = "cannot" if "cannot" in answer else "failed"
        raise NoAnswerError(why, answer[why])

    @property
    def alive(self) -> bool:
        """Whether its process runs."""
        return self._process is not None and self._process.poll() is None

    def _started(self) -> subprocess.Popen[str]:
        if not self.alive:
            self.stop()
            venv = ENTRIES[self.name].venv
            python = Path(sys.executable) if not venv else ROOT / venv / "bin" / "python"
            if not python.exists():
                script = {".venv-peers": "tools/setup-venv-peers", ".venv-d3rlpy": "tools/setup-venv-d3rlpy"}[
                    venv
                ]
                raise NoAnswerError("cannot", f"not installed: run {script}")
            self._process = subprocess.Popen(
                [str(python), "-m", "tools.bench.worker", self.name],
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                text=True,
                cwd=ROOT,
                start_new_session=True,
                env=environment(self.directory),
            )
        return self._process

    def stop(self) -> None:
        """Ends it and all its children."""
        if self._process is None:
            return
        with contextlib.suppress(ProcessLookupError):
            os.killpg(self._process.pid, signal.SIGKILL)
        self._process.wait()
        for pipe in (self._process.stdin, self._process.stdout):
            if pipe is not None:
                pipe.close()
        self._process = None


def environment(directory: Path) -> dict[str, str]:
    """What a process of the benchmark finds in its environment: one thread each, nothing of the user's."""
    from tools.bench.workloads import DATA

    threads = dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"), "1")
    home = directory / "home"
    home.mkdir(exist_ok=True)
    own = {DATA: str(directory), "PYTHONPATH": str(ROOT), "TMPDIR": str(directory), "HF_HOME": str(home)}
    ours = {"TUPLI_MCAP_CONFIG_DIR": str(home), "TUPLI_MCAP_CACHE_DIR": str(home / "cache")}
    return {**os.environ, **threads, **own, **ours, "PYTHONWARNINGS": "ignore"}
