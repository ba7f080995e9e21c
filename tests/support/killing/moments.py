"""The moments at which a recording process is killed, and the traps that kill it exactly there.

A trap is in the process itself: it counts the interpreter's instructions in our own code below a function, wraps a
system call, or sets a kernel timer while a chunk is compressed. Linux only.
"""

from __future__ import annotations

import ctypes
import os
import random
import signal
import sys
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass
from types import CodeType, FrameType
from typing import Any

from tupli_mcap.mcap.container import Container

__all__ = ["MOMENTS", "Moment", "die", "lay_trap"]

ENCODER = "<tupli_mcap row encoder>"


@dataclass(frozen=True)
class Moment:
    """When to kill.

    below: names of functions; the process dies between two instructions while one of them runs, or, with `after`,
        soon after it has returned.
    call: a function of `os`; the process dies before it, after it or, writing, in its middle.
    starts: what the bytes of that write start with.
    times: the occurrence is drawn from 1 to this.
    """

    name: str
    below: tuple[str, ...] = ()
    after: bool = False
    call: str = ""
    starts: tuple[bytes, ...] = ()
    times: int = 1
    closes: bool = False  # the process closes its recording, to get there
    appends: bool = False  # only where a recording goes on
    grows: bool = False  # only where steps become larger than the journal
    told: bool = False  # only where episodes are derived from rows
    threaded: bool = False  # only where a thread writes the chunks
    syncs: bool = False  # only where file and journal are synced
    rotates: bool = False  # only where a recording goes on in other files
    flushes: bool = False  # the process flushes now and then


_CHUNK, _ATTACHMENT, _DATA_END = b"\x06", b"\x09", b"\x0f"
MOMENTS = {
    moment.name: moment
    for moment in (
        Moment("any time"),
        Moment("any line"),
        Moment("step", ("RecordEpisodes.step",), times=40),
        Moment(
            "stores",
            (
                *(f"encoder.<locals>.{name}" for name in ("put", "put_next")),
                "StepLog.commit",
                "VectorRows.put",
                "ImageRows.put",
            ),
            times=60,
        ),
        Moment(
            "reset", ("SingleRecorder.reset", "SingleRecorder.begin_next", "VectorRecorder.reset"), times=6
        ),
        Moment(
            "told",
            ("SingleRows.derive_pending", "VectorRows._derive", "EpisodeLog.extend"),
            times=3,
            told=True,
            flushes=True,
        ),
        Moment("settled", ("SingleRecorder._derive_pending", "VectorRecorder._derive_pending"), times=4),
        Moment(
            "episode log",
            ("EventLog.append", "EpisodeLog.start", "EpisodeLog.end", "EventLog.drop_last"),
            times=20,
        ),
        Moment(
            "switch",
            ("SingleRows._switch", "StepLog._switch", "VectorRows._switch", "ImageRows._emit"),
            times=4,
        ),
        Moment("flush", ("RecordingWriter._flush",), times=3, flushes=True),
        Moment("chunk", ("Container.finish_chunks",), times=8, flushes=True),
        Moment("after chunk", ("Container.finish_chunks",), after=True, times=8, flushes=True),
        Moment("compression", times=6, flushes=True),
        Moment("torn chunk", call="pwrite", starts=(_CHUNK,), times=6, flushes=True),
        Moment("chunk thread", ("ChunkWorker.submit.<locals>.run",), times=4, threaded=True),
        Moment("sync", call="fdatasync", times=12, syncs=True),
        Moment("opening", ("RecordingWriter._open",)),
        Moment("torn opening", call="pwrite", starts=(b"\x89", b"\x0c", b"\x03"), times=3),
        Moment("journal", ("RecordingWriter.begin",)),
        Moment("reserve", call="posix_fallocate"),
        Moment("rename", call="replace"),
        Moment("growth", ("RecordingWriter._grow",), times=3, grows=True),
        Moment("renamed growth", call="replace", times=3, grows=True),
        Moment("rotation", ("EpisodeWrapper._rotate",), times=2, rotates=True),
        Moment("after rotation", ("EpisodeWrapper._rotate",), after=True, times=2, rotates=True),
        Moment("close", ("RecordingWriter.close",), closes=True),
        Moment("torn index", call="pwrite", starts=(_ATTACHMENT,), closes=True),
        Moment("torn summary", call="pwrite", starts=(_DATA_END,), closes=True),
        Moment("unlink", call="unlink", closes=True),
        Moment("resume", ("resume",), appends=True),
        Moment("truncate", call="ftruncate", appends=True),
        Moment("torn resume", call="pwrite", starts=(_CHUNK,), appends=True),
    )
}


def die() -> None:
    """Ends this process as `kill -9` does."""
    os.kill(os.getpid(), signal.SIGKILL)
    time.sleep(60)


def lay_trap(
    moment: Moment, rng: random.Random, length: int | None, tell: Callable[[str, Any], None]
) -> None:
    """Makes this process die at `moment`.

    `length` is the number of instructions of the moment. If it is None, the process dies at the moment's end, and
    first reports ("length", instructions).
    """
    occurrence = rng.randint(1, moment.times)
    if moment.name == "any line":
        _Instructions(moment, 0, int(10 ** rng.uniform(0, 4.5)), tell, lines=True).set()
    elif moment.name == "compression":
        _trap_compression(occurrence, rng)
    elif moment.call == "pwrite":
        _trap_write(moment, occurrence, rng)
    elif moment.call:
        _trap_call(moment.call, occurrence, rng)
    elif moment.below:
        at = None if length is None else rng.randint(1, max(1, length))
        _Instructions(moment, occurrence, at, tell).set()


class _Instructions:
    """Counts instructions (or lines) in our own code below a function, and kills at a given one."""

    def __init__(
        self,
        moment: Moment,
        occurrence: int,
        at: int | None,
        tell: Callable[[str, Any], None],
        *,
        lines: bool = False,
    ) -> None:
        self._names = set(moment.below)
        self._after = moment.after
        self._left = occurrence
        self._at = at
        self._tell = tell
        self._event = "line" if lines else "opcode"
        self._active = occurrence == 0
        self._root: FrameType | None = None
        self._count = 0
        self._codes: dict[CodeType, tuple[bool, bool]] = {}

    def set(self) -> None:
        """Starts to count, also in threads made from now on.

        Python 3.12 tells of instructions if a frame asks for them by then, and 3.13 from the second call on that asks.
        """
        sys._getframe().f_trace_opcodes = self._event == "opcode"
        threading.settrace(self._called)
        sys.settrace(self._called)

    def _kind(self, code: CodeType) -> tuple[bool, bool]:
        """(is it ours, does its call start the count)."""
        if code not in self._codes:
            ours = "/tupli_mcap/" in code.co_filename or code.co_filename == ENCODER
            self._codes[code] = ours, ours and code.co_qualname in self._names
        return self._codes[code]

    def _called(self, frame: FrameType, event: str, arg: Any) -> Any:
        ours, starts = self._kind(frame.f_code)
        if not ours:
            return None
        if starts and not self._active and self._root is None:
            self._left -= 1
            if self._left == 0:
                self._root = frame
                self._active = not self._after
        frame.f_trace_opcodes = self._event == "opcode"
        if not self._active and frame is not self._root:
            return None
        return self._traced

    def _traced(self, frame: FrameType, event: str, arg: Any) -> Any:
        if event == "return" and frame is self._root:
            if not self._after:
                self._end()
            self._active, self._root, self._at = True, None, random.Random(self._count).randint(1, 200)
            self._after = False
            back: FrameType | None = frame.f_back
            while back is not None:
                if self._kind(back.f_code)[0]:
                    back.f_trace, back.f_trace_opcodes = self._traced, True
                back = back.f_back
        elif event == self._event and self._active:
            self._count += 1
            if self._count == self._at:
                die()
        return self._traced

    def _end(self) -> None:
        sys.settrace(None)
        self._tell("length", self._count)
        die()


def _trap_write(moment: Moment, occurrence: int, rng: random.Random) -> None:
    """Kills at a write of certain bytes: none, some or all of them get into the file."""
    left, pwrite = occurrence, os.pwrite

    def write(fd: int, data: Any, offset: int) -> int:
        nonlocal left
        head = bytes(data[:100])
        if head.startswith(moment.starts) and (head[:1] != _ATTACHMENT or b"episodes.index" in head):
            left -= 1
            if left == 0:
                part = rng.choice([0, 1, len(data), rng.randint(0, len(data)), rng.randint(0, len(data))])
                if part:
                    pwrite(fd, data[:part], offset)
                die()
        return pwrite(fd, data, offset)

    os.pwrite = write
    os.pwritev = lambda fd, parts, offset: write(fd, b"".join(parts), offset)


def _trap_call(name: str, occurrence: int, rng: random.Random) -> None:
    left, before = occurrence, rng.random() < 0.5
    function = getattr(os, name)

    def call(*args: Any, **kwargs: Any) -> Any:
        nonlocal left
        left -= 1
        if left == 0 and before:
            die()
        result = function(*args, **kwargs)
        if left == 0:
            die()
        return result

    setattr(os, name, call)


def _trap_compression(occurrence: int, rng: random.Random) -> None:
    """Kills in the compressor, after a part of the time that compressing the same chunk took before."""
    left = occurrence

    def trapped(compress: Callable[[Container, Any], Any]) -> Callable[[Container, Any], Any]:
        def pack(container: Container, data: Any) -> Any:
            nonlocal left
            left -= 1
            if left == 0:
                begin = time.perf_counter_ns()
                compress(container, data)
                took = time.perf_counter_ns() - begin
                kill_after(rng.randint(1, max(2, took)))
            return compress(container, data)

        return pack

    Container.pack = trapped(Container.pack)  # type: ignore[method-assign]
    Container.pack_all = trapped(Container.pack_all)  # type: ignore[method-assign]


class _Event(ctypes.Structure):
    """`struct sigevent` of Linux."""

    _fields_ = [
        ("value", ctypes.c_void_p),
        ("signal", ctypes.c_int),
        ("notify", ctypes.c_int),
        ("rest", ctypes.c_char * 48),
    ]


class _Time(ctypes.Structure):
    """`struct itimerspec`."""

    _fields_ = [("interval", ctypes.c_long * 2), ("value", ctypes.c_long * 2)]


def kill_after(ns: int) -> None:
    """Has the kernel kill this process after so many nanoseconds, whatever code runs then."""
    libc = ctypes.CDLL(None, use_errno=True)
    event = _Event(None, signal.SIGKILL, 0, b"")
    timer = ctypes.c_void_p()
    when = _Time((0, 0), divmod(ns, 10**9))
    if libc.timer_create(
        time.CLOCK_MONOTONIC, ctypes.byref(event), ctypes.byref(timer)
    ) or libc.timer_settime(timer, 0, ctypes.byref(when), None):
        raise OSError(ctypes.get_errno(), "no timer")
