"""Measure tupli-mcap side by side with its peers: `python -m tools.bench` (about 15 minutes).

Writes docs/bench/ (README.md, plots, results.json). Peers live in
environments of their own (tools/setup-venv-peers, tools/setup-venv-d3rlpy); who is not installed is left out. What
fails is said in the tables. All other files go to a temporary directory, which is removed.
"""

from __future__ import annotations

import argparse
import json
import os
import signal
import sys
import tempfile
import time
import traceback
from pathlib import Path
from typing import Any

from tools.bench import draw, machine, pictures, report, targets
from tools.bench.cases import CASES, MORE
from tools.bench.contenders import ENTRIES
from tools.bench.fleet import ROOT
from tools.bench.matrix import STEPS, Workbench, grow, start
from tools.bench.measure import Run
from tools.bench.workloads import DATA, VECTOR, play

GROWING = [
    "tupli-mcap",
    "HDF5 by hand",
    ".npy, mapped",
    "Parquet by hand",
    "mcap",
    "Minari HDF5",
    "PyTupli",
    "d3rlpy",
]
PARTS = [*STEPS, "growth", "pictures", *CASES, *MORE]


def _options() -> argparse.Namespace:
    parser = argparse.ArgumentParser(
        prog="python -m tools.bench",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("--only", action="append", choices=PARTS, help="measure this only (may be repeated)")
    parser.add_argument(
        "--with", action="append", choices=ENTRIES, dest="names", help="these contenders only"
    )
    parser.add_argument("--quick", action="store_true", help="a fiftieth of the work: a look, not a result")
    parser.add_argument("--rounds", type=int, default=5, help="rounds of each comparison (default 5)")
    parser.add_argument("--output", type=Path, default=ROOT / "docs" / "bench", help="default docs/bench")
    parser.add_argument(
        "--render", action="store_true", help="write page and plots of OUTPUT/results.json anew"
    )
    options = parser.parse_args()
    if options.rounds < 1:
        parser.error("--rounds must be at least 1")
    return options


class _Log:
    """What goes on, with the seconds since the start; failures are kept."""

    def __init__(self) -> None:
        self._began = time.monotonic()
        self.failures: list[str] = []

    def say(self, line: str) -> None:
        print(f"[{time.monotonic() - self._began:6.0f} s] {line}", file=sys.stderr, flush=True)

    def fail(self, line: str) -> None:
        """The same of something that failed."""
        self.failures.append(line)
        self.say(line)


def _measure(options: argparse.Namespace, log: _Log) -> dict[str, Any]:
    wanted = options.only or [part for part in PARTS if part not in MORE]
    matrix: dict[str, Any] = {}
    results: dict[str, Any] = {
        "quick": options.quick,
        "whole": not (options.only or options.names or options.quick),
        "machine": machine.about(),
        "growth": {},
        "matrix": matrix,
    }
    with tempfile.TemporaryDirectory(prefix="tupli-mcap-bench-", ignore_cleanup_errors=True) as name:
        run = Run(Path(name), options.quick, rounds=2 if options.quick else options.rounds)
        os.environ[DATA] = name
        os.environ["TUPLI_MCAP_CONFIG_DIR"] = name
        os.environ["TUPLI_MCAP_CACHE_DIR"] = f"{name}/cache"
        results["screens"] = play(run.directory / "frames.npy", 310 if options.quick else 1010)
        processes = start(run, options.names)
        bench = Workbench(run, processes, log.say, log.fail, rounds=run.rounds)
        if options.quick:
            bench.rounds, bench.build_seconds, bench.record_seconds, bench.operation_seconds = 1, 0.3, 0.05, 0
            bench.loading = ("tupli-mcap", ".npy, mapped")  # importing PyTorch takes longer than all the rest
        try:
            results["contenders"] = machine.contenders(processes)
            for work in (work for work in STEPS if work in wanted):
                log.say(f"{work} ...")
                matrix[work] = bench.measure(work)
            if "growth" in wanted:
                sizes = [1000, 10_000] if options.quick else [10_000, 100_000, 1_000_000, 10_000_000]
                results["growth"] = grow(bench, GROWING, sizes, 3.0 if options.quick else 60.0)
            if VECTOR in wanted:
                log.say("vector: side by side ...")
                results["vectors"] = bench.vectors()
        finally:
            for process in processes.values():
                process.stop()
        if "pictures" in wanted:
            log.say("pictures ...")
            results["pictures"] = pictures.compare(run, run.directory / "frames.npy")
        results["targets"] = _targets(run, wanted, matrix, log)
    results["failures"] = log.failures
    return results


def _targets(run: Run, wanted: list[str], matrix: dict[str, Any], log: _Log) -> list[dict[str, Any]]:
    found = list(targets.from_matrix(matrix)) if matrix else []
    for name, case in (CASES | MORE).items():
        if name not in wanted:
            continue
        log.say(f"{name} ...")
        try:
            found += case(run)
        except Exception as err:  # noqa: BLE001 whatever it is, the others are measured
            log.fail(f"{name} failed: {err!r}")
            traceback.print_exc()
            found.append(targets.Target(name, "", None, None, f"failed: {err!r}"))
    return [target.as_json() for target in found]


def main() -> int:
    """Measures and writes; 1 if something failed, but everything else is written."""
    options = _options()
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(143))  # and the directory is removed
    log = _Log()
    kept = options.output / "results.json"
    if options.render:
        results = json.loads(kept.read_text())
    else:
        results = _measure(options, log)
    options.output.mkdir(parents=True, exist_ok=True)
    kept.write_text(json.dumps(results, indent=1) + "\n")
    draw.write(results, options.output)
    (options.output / "README.md").write_text(report.page(results))
    for target in results["targets"]:
        mark = {None: "?", True: "reached", False: "NOT REACHED"}[target["reached"]]
        print(f"{mark:12} {target['what']}: {report.measured(target)} ({target['words']}) {target['note']}")
    for line in report.vectors(results["vectors"]) if "vectors" in results else ():
        print(f"{'':12} {line}")
    log.say(f"wrote {options.output}; {len(results['failures'])} failed")
    return 1 if results["failures"] else 0


if __name__ == "__main__":
    sys.exit(main())
