"""Makes, reads and judges one mutated input by its number; each run of a number is the same."""

from __future__ import annotations

import contextlib
import random
import signal
import traceback
from collections.abc import Iterator, Sequence
from pathlib import Path
from types import FrameType
from typing import Any, NamedTuple

from fuzzing.crafted import CRAFTED
from fuzzing.model import Seed
from fuzzing.oracle import Facts, judge, observe
from fuzzing.plain import PLAIN, Mutant
from fuzzing.tools import use_tools

__all__ = ["MUTATORS", "Case", "Finding", "Fuzzer", "case_of"]

MUTATORS = {**PLAIN, **CRAFTED}
TOOLS_EVERY = 200  # of the inputs all tools are used on: they take ten times as long
SECONDS = 10.0
"""The longest an input may take: golden files are read in about 10 ms."""


class Case(NamedTuple):
    """Number, mutator, golden file, and the mutated bytes."""

    number: int
    mutator: str
    seed: str
    mutant: Mutant


class Finding(NamedTuple):
    """An input that was not treated as it should be."""

    number: int
    mutator: str
    seed: str
    note: str
    problem: str


def case_of(run: int, number: int, seeds: Sequence[Seed], only: Sequence[str] = ()) -> Case:
    """Input `number` of the run with seed `run`; mutators take turns."""
    rng = random.Random(f"{run}/{number}")
    names = list(only) or list(MUTATORS)
    name, seed = names[number % len(names)], rng.choice(seeds)
    return Case(number, name, seed.name, MUTATORS[name](rng, seed, seeds))


class HangError(BaseException):
    """Raised by the alarm; no handler of exceptions takes it for its own."""


@contextlib.contextmanager
def time_limit(seconds: float) -> Iterator[None]:
    def ring(_: int, frame: FrameType | None) -> None:
        raise HangError("".join(traceback.format_stack(frame)[-3:]))

    # of the processor's time, which others cannot take; and a longer one of the clock's, for what waits forever
    timers = [
        (signal.ITIMER_PROF, signal.SIGPROF, seconds),
        (signal.ITIMER_REAL, signal.SIGALRM, 12 * seconds),
    ]
    before = [signal.signal(number, ring) for _, number, _ in timers]
    for timer, _, limit in timers:
        signal.setitimer(timer, limit)
    try:
        yield
    finally:
        for (timer, number, _), handler in zip(timers, before, strict=True):
            signal.setitimer(timer, 0)
            signal.signal(number, handler)


class Fuzzer:
    """Judges inputs in one directory; `counts` and `outcomes` say what came."""

    def __init__(self, seeds: Sequence[Seed], directory: Path, *, memory: bool = False) -> None:
        self.seeds = seeds
        self._path = directory / "fuzzed.mcap"
        self._journal = directory / "fuzzed.mcap.journal"
        self._memory = memory
        self.outcomes: dict[str, dict[str, int]] = {}
        self.truths: dict[str, Facts] = {}
        for seed in seeds:
            self._write(seed.data, seed.journal)
            facts, refused = observe(self._path)
            if refused:
                raise ValueError(f"{seed.name}: the golden file itself is refused: {refused[0]}")
            self.truths[seed.name] = facts

    def _write(self, data: bytes, journal: bytes | None) -> None:
        self._path.write_bytes(data)
        if journal is None:
            self._journal.unlink(missing_ok=True)
        else:
            self._journal.write_bytes(journal)

    def run(self, case: Case) -> Finding | None:
        """What is wrong with the treatment of an input, if anything is."""
        problem, outcome = self._problem(case)
        counts = self.outcomes.setdefault(case.mutator, {})
        counts[outcome] = counts.get(outcome, 0) + 1
        if problem is None:
            return None
        return Finding(case.number, case.mutator, case.seed, case.mutant.note, problem)

    def _problem(self, case: Case) -> tuple[str | None, str]:
        mutant = case.mutant
        self._write(mutant.data, mutant.journal)
        if self._memory:
            _reset_peak()
        try:
            with time_limit(SECONDS):
                facts, refused = observe(self._path)
                if case.number % TOOLS_EVERY == 0:
                    use_tools(self._path)
        except HangError as err:
            return f"took more than {SECONDS} s:\n{err}", "hang"
        except Exception as err:  # noqa: BLE001 (any other than a FormatError is the finding)
            cause: Any = err.__cause__ or err
            frames = traceback.extract_tb(cause.__traceback__)[-3:]
            where = "; ".join(f"{Path(f.filename).name}:{f.lineno} {f.name}" for f in frames)
            return f"{err} [{where}]", "error"
        if self._memory and (peak := _peak()) > LIMIT + 16 * len(mutant.data):
            return f"took {peak >> 20} MiB for a file of {len(mutant.data)} bytes", "memory"
        if mutant.accident:
            wrong = list(judge(facts, self.truths[case.seed]))
            if wrong:
                return "; ".join(wrong[:3]), "wrong"
        if not facts["open"]:
            return None, "refused"
        return None, "partly" if refused else "read" if facts["complete"] else "recovered"


LIMIT = 512 << 20


def _reset_peak() -> None:
    Path("/proc/self/clear_refs").write_text("5")


def _peak() -> int:
    """Bytes of the largest resident set since `_reset_peak`."""
    for line in Path("/proc/self/status").read_text().splitlines():
        if line.startswith("VmHWM"):
            return int(line.split()[1]) << 10
    return 0
