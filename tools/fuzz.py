#!/usr/bin/env python
"""Reads damaged and crafted recordings: the right data or one FormatError, nothing else, in bounded time and memory.

    python tools/fuzz.py --count 100000 --seed 1 --jobs 2        # a run
    python tools/fuzz.py --seed 1 --case 4711 --keep /tmp/found   # one input again, kept

Inputs are golden recordings, changed by a mutator. A worker that takes too much memory dies, and one that hangs is
killed; both are findings. Exits with 1 if there are any.
"""

from __future__ import annotations

import argparse
import contextlib
import faulthandler
import json
import multiprocessing as mp
import os
import queue
import resource
import signal
import sys
import tempfile
import time
from collections import Counter
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).parent))

from fuzzing.model import load_seeds
from fuzzing.run import MUTATORS, SECONDS, Finding, Fuzzer, case_of

BATCH = 250
PROGRESS = 5_000
ADDRESS_SPACE = 2 << 30  # more than a worker has once everything is imported


def work(inbox: Any, outbox: Any, now: Any, options: argparse.Namespace) -> None:
    """Reads and judges batches of inputs; `now` tells the parent the number of the current one."""
    faulthandler.enable()
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the parent's business
    taken = int(Path("/proc/self/statm").read_text().split()[0]) * os.sysconf("SC_PAGE_SIZE")
    resource.setrlimit(resource.RLIMIT_AS, (taken + ADDRESS_SPACE, taken + ADDRESS_SPACE))
    shm = Path("/dev/shm")
    with tempfile.TemporaryDirectory(dir=shm if shm.exists() else None) as directory:
        fuzzer = Fuzzer(load_seeds(), Path(directory), memory=True)
        while (start := inbox.get()) is not None:
            fuzzer.outcomes = {}
            findings = []
            for number in range(start, min(start + BATCH, options.first + options.count)):
                now.value = number
                finding = fuzzer.run(case_of(options.seed, number, fuzzer.seeds, options.only))
                if finding is not None:
                    findings.append(finding)
            now.value = -1
            outbox.put((start, findings, fuzzer.outcomes))


class Worker:
    """A process and its current input."""

    def __init__(self, inbox: Any, outbox: Any, options: argparse.Namespace) -> None:
        self.now = mp.Value("q", -1)
        self.process = mp.Process(target=work, args=(inbox, outbox, self.now, options), daemon=True)
        self.process.start()
        self.seen, self.since = -1, time.monotonic()

    def stuck(self) -> bool:
        number = self.now.value
        if number != self.seen:
            self.seen, self.since = number, time.monotonic()
        return number >= 0 and time.monotonic() - self.since > 15 * SECONDS


def run(options: argparse.Namespace) -> int:
    inbox, outbox = mp.Queue(), mp.Queue()
    begun, end = time.monotonic(), options.first + options.count
    starts = list(range(options.first, end, BATCH))
    for start in starts:
        inbox.put(start)
    workers = [Worker(inbox, outbox, options) for _ in range(options.jobs)]
    outcomes: dict[str, Counter[str]] = {}
    findings: list[Finding] = []
    waiting = set(starts)
    stopped = []  # a run that is stopped says what it has done
    for number in (signal.SIGTERM, signal.SIGINT):
        signal.signal(number, lambda *_: stopped.append(True))
    told = 0
    while (
        waiting and not stopped and not (options.minutes and time.monotonic() - begun > 60 * options.minutes)
    ):
        with contextlib.suppress(queue.Empty):
            start, found, counts = outbox.get(timeout=1)
            waiting.discard(start)
            for name, outcome in counts.items():
                outcomes.setdefault(name, Counter()).update(outcome)
            for finding in found:
                report(finding, findings)
            done = sum(sum(counts.values()) for counts in outcomes.values())
            if done // PROGRESS > told:
                told = done // PROGRESS
                print(
                    f"{done} inputs, {len(findings)} findings, {time.monotonic() - begun:.0f} s", flush=True
                )
        for i, worker in enumerate(workers):
            dead = not worker.process.is_alive()
            if dead or worker.stuck():
                number = worker.now.value
                worker.process.kill()
                how = (
                    f"the process died ({worker.process.exitcode})" if dead else "hangs beyond Python's reach"
                )
                case = case_of(options.seed, number, load_seeds(), options.only)
                report(Finding(number, case.mutator, case.seed, case.mutant.note, how), findings)
                waiting.discard(options.first + (number - options.first) // BATCH * BATCH)
                workers[i] = Worker(inbox, outbox, options)
    for worker in workers:
        worker.process.kill()
    done = sum(sum(counts.values()) for counts in outcomes.values())
    table(outcomes)
    print(f"{done} inputs, {len(findings)} findings, {time.monotonic() - begun:.0f} s, seed {options.seed}")
    if options.json:
        Path(options.json).write_text(json.dumps([finding._asdict() for finding in findings], indent=1))
    return 1 if findings else 0


def report(finding: Finding, findings: list[Finding]) -> None:
    findings.append(finding)
    print(
        f"#{finding.number} {finding.mutator} of {finding.seed} ({finding.note:.200}): {finding.problem}",
        flush=True,
    )


def table(outcomes: dict[str, Counter[str]]) -> None:
    kinds = ["refused", "partly", "recovered", "read", "error", "wrong", "memory", "hang"]
    print(f"{'mutator':<16}{'inputs':>8}" + "".join(f"{kind:>10}" for kind in kinds))
    for name in MUTATORS:
        if name in outcomes:
            counts = outcomes[name]
            print(f"{name:<16}{sum(counts.values()):>8}" + "".join(f"{counts[kind]:>10}" for kind in kinds))


def one(options: argparse.Namespace) -> int:
    """Repeats one input, and keeps it if asked."""
    seeds = load_seeds()
    case = case_of(options.seed, options.case, seeds, options.only)
    with tempfile.TemporaryDirectory() as directory:
        place = Path(options.keep or directory)
        place.mkdir(parents=True, exist_ok=True)
        fuzzer = Fuzzer([seed for seed in seeds if seed.name == case.seed], place, memory=True)
        finding = fuzzer.run(case)
    print(f"#{case.number} {case.mutator} of {case.seed}: {case.mutant.note}")
    print(finding.problem if finding else f"as it should be: {fuzzer.outcomes}")
    return 1 if finding else 0


def main() -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--count", type=int, default=10_000, help="inputs to read")
    parser.add_argument("--first", type=int, default=0, help="number of the first one")
    parser.add_argument("--seed", type=int, default=0, help="of the whole run")
    parser.add_argument("--jobs", type=int, default=1, help="worker processes")
    parser.add_argument("--minutes", type=float, default=0, help="stop after that long")
    parser.add_argument("--only", nargs="*", default=[], choices=list(MUTATORS), help="mutators")
    parser.add_argument("--case", type=int, help="read this one input again")
    parser.add_argument("--keep", help="directory to leave that input in")
    parser.add_argument("--json", help="file to write the findings to")
    options = parser.parse_args()
    return run(options) if options.case is None else one(options)


if __name__ == "__main__":
    sys.exit(main())
