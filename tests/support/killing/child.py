"""A process that records, reports every step over a pipe, and dies."""

from __future__ import annotations

import gc
import os
import pickle
import random
import select
import signal
import threading
import time
import traceback
import warnings
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from killing import breakages
from killing.kinds import KINDS, open_recorder
from killing.moments import MOMENTS, lay_trap
from tupli_mcap.recording.write import chunks as worker

__all__ = ["Job", "Told", "record_and_die"]

_write = os.write
_PATIENCE = 60.0  # seconds until a process that does not die is taken for hung


class Job(NamedTuple):
    """What a process records, and when it dies. Of a storage, `path` is its directory."""

    kind: str
    moment: str
    path: Path
    mode: str
    chunk: int
    seed: int
    length: int | None = None  # instructions that the moment takes, where known
    benchmark_id: str = ""
    breakage: str = ""  # a defect to put into the recorder, so that the check can be seen to fail


class Told(NamedTuple):
    """The reports of a process before it died, in order. killed is False if it ended by itself."""

    reports: list[tuple[str, Any]]
    killed: bool
    trouble: str = ""


def record_and_die(job: Job) -> Told:
    """Forks a process that does the job; returns its reports."""
    read, write = os.pipe()
    gc.collect()
    pid = os.fork()
    if pid == 0:
        os.close(read)
        code = 1
        try:
            _Recorder(job, write).run()
            code = 0
        except BaseException:  # noqa: BLE001 - the parent is told of whatever it was
            _send(write, ("error", traceback.format_exc()))
        finally:
            os._exit(code)
    os.close(write)
    try:
        data, hung = _listen(read, pid, job)
    finally:
        os.close(read)
    status = os.waitpid(pid, 0)[1]
    reports = list(_reports(data))
    errors = [value for name, value in reports if name == "error"]
    trouble = f"hung for {_PATIENCE:g} seconds" if hung else errors[0] if errors else ""
    return Told(reports, os.WIFSIGNALED(status) and not hung, trouble)


def _listen(read: int, pid: int, job: Job) -> tuple[bytes, bool]:
    """Reads the pipe until its other end is closed; kills after a time, if that is the moment."""
    give_up = time.monotonic() + _PATIENCE
    at, rng = None, random.Random(job.seed)
    wanted = rng.choice([0, 400, 4000])  # bytes: from its birth, or from its first steps on
    parts: list[bytes] = []
    while True:
        now = time.monotonic()
        if now > give_up or (at is not None and now >= at):
            os.kill(pid, signal.SIGKILL)
            at = None
        wait = min(give_up, at or give_up) - now
        if select.select([read], [], [], max(0.0, min(wait, 0.5)))[0]:
            part = os.read(read, 1 << 20)
            if not part:
                return b"".join(parts), now > give_up
            parts.append(part)
            if at is None and job.moment == "any time" and sum(map(len, parts)) > wanted:
                at, wanted = now + rng.random() ** 2 * 0.15, 1 << 62


_sending = threading.RLock()  # the thread that compresses may tell something while another one does


def _send(fd: int, report: tuple[str, Any]) -> None:
    data = pickle.dumps(report, 5)
    view = memoryview(len(data).to_bytes(4, "little") + data)
    with _sending:
        while view:
            view = view[_write(fd, view) :]


def _reports(data: bytes) -> Any:
    at = 0
    while at + 4 <= len(data):
        end = at + 4 + int.from_bytes(data[at : at + 4], "little")
        if end > len(data):
            break
        yield pickle.loads(data[at + 4 : end])
        at = end


class _Recorder:
    """Runs in the forked process."""

    def __init__(self, job: Job, fd: int) -> None:
        self._job, self._fd = job, fd
        self._kind, self._moment = KINDS[job.kind], MOMENTS[job.moment]
        self._random = random.Random(job.seed)

    def _tell(self, name: str, value: Any = None) -> None:
        _send(self._fd, (name, value))

    def run(self) -> None:
        warnings.simplefilter("ignore")
        job, moment, rng = self._job, self._moment, self._random
        if job.breakage:
            breakages.BREAKAGES[job.breakage]()
        if moment.threaded or not moment.below:  # small chunks are made without the thread otherwise
            worker.WORTH_A_THREAD = 0.0
        self._tell("born")
        lay_trap(moment, rng, job.length, self._tell)
        env = open_recorder(self._kind, job.path, job.mode, job.chunk, job.seed, self._tell, job.benchmark_id)
        env.action_space.seed(job.seed)
        steps = rng.choice([1, rng.randint(2, 60), rng.randint(2, 60)]) if moment.closes else 400
        if moment.name == "any time":
            steps = 100_000
        if steps:
            self._roll(env, steps)
        env.close()
        self._tell("closed")

    def _roll(self, env: Any, steps: int) -> None:
        rng, kind = self._random, self._kind
        self._reset(env, seed=self._job.seed)
        flushes = (0.15 if self._moment.flushes else 0.01) if not kind.storage else 0
        for _ in range(steps):
            _, _, terminal, timeout, _ = env.step(env.action_space.sample())
            self._tell("done")
            over = np.logical_or(terminal, timeout)
            if rng.random() < 0.02:
                self._reset(env)
            elif kind.vector is None:
                if over:
                    self._reset(env)
            elif kind.vector.value == "Disabled" and over.any():
                self._reset(env, options={"reset_mask": over})
            if rng.random() < flushes:
                env.flush()

    def _reset(self, env: Any, **arguments: Any) -> None:
        if not arguments and self._random.random() < 0.3:
            arguments = {"seed": self._random.randrange(1000)}
        if self._kind.vector is None and self._random.random() < 0.3:
            arguments["options"] = {"level": self._random.randrange(9)}
        env.reset(**arguments)
        self._tell("done")
