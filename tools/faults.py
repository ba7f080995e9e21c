#!/usr/bin/env python3
"""The full sweep of tests/failures/test_faults.py: makes the calls of the operating system fail, one after another.

Each call of recording or of a storage on its files fails once or from then on, with each of its possible errors, before
anything or half of the bytes was written. Prints what went wrong; exits with 1 then.

    tools/faults.py                      everything (an hour or so)
    tools/faults.py --sample 50          50 cases of each workload
    tools/faults.py box compact          these workloads
"""

from __future__ import annotations

import argparse
import errno
import os
import random
import shutil
import sys
import tempfile
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests" / "support"))

from faulty_recordings import WORKLOADS, Case, Outcome, cases, run_case
from faulty_storages import OPERATIONS, run_storage_case, run_trust_case, template

Run = Callable[[Path, Case], Outcome]


def sweep(name: str, run: Run, directory: Path, sample: int | None, seed: int) -> tuple[int, int]:
    """Runs the faults of one workload; returns their number, and how many went wrong."""
    began = time.perf_counter()
    chosen = list(cases(run(directory / "whole", Case(-1, errno.EIO, False)).calls))
    if sample is not None:
        chosen = random.Random(f"{name}{seed}").sample(chosen, min(sample, len(chosen)))
    bad = said = 0
    for i, case in enumerate(chosen):
        place = directory / str(i)
        try:
            said += run(place, case).said
        except Exception as err:  # noqa: BLE001 - whatever it is, it is what is looked for
            bad += 1
            print(f"{name}, {case}: {type(err).__name__}: {str(err)[:300]}", flush=True)
        shutil.rmtree(place, ignore_errors=True)
    seconds = time.perf_counter() - began
    print(f"{name}: {len(chosen)} faults, {said} errors, {bad} wrong, {seconds:.0f} s", flush=True)
    return len(chosen), bad


def main() -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("names", nargs="*")
    parser.add_argument("--sample", type=int, help="so many cases of each workload")
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    base = Path(tempfile.mkdtemp(prefix="faults-"))
    os.environ["TUPLI_MCAP_CONFIG_DIR"] = str(base / "config")
    os.environ["TUPLI_MCAP_CACHE_DIR"] = str(base / "cache")
    made = template(base / "made")
    runs: dict[str, Run] = {name: partial(run_case, name) for name in WORKLOADS}
    runs |= {name: partial(run_storage_case, name, made) for name in OPERATIONS}
    runs["trust"] = run_trust_case
    total = wrong = 0
    try:
        for name in options.names or runs:
            count, bad = sweep(name, runs[name], base / name, options.sample, options.seed)
            total, wrong = total + count, wrong + bad
    finally:
        shutil.rmtree(base, ignore_errors=True)
    print(f"{total} faults, {wrong} wrong")
    return 1 if wrong else 0


if __name__ == "__main__":
    sys.exit(main())
