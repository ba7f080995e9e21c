"""Measure tupli-mcap side by side with its peers: `python tools/bench.py [--only NAME] [--quick] [--json]`.

Peers are optional: `pip install -e '.[bench]'`. Times are wall-clock; what each side recorded or read is
checked before its time counts. Nothing is installed, and all files go to a temporary directory.
"""

from __future__ import annotations

import argparse
import json
import statistics
import sys
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path

from benchmarks import catalog, columns, reading, recording, startup, viewing, watching
from benchmarks.measure import Line, Run
from rich.console import Console
from rich.markup import escape
from rich.table import Table

CASES: dict[str, Callable[[Run], Iterator[Line]]] = {
    "record-cartpole": recording.record_cartpole,
    "record-floats": recording.record_floats,
    "record-vector": recording.record_vector,
    "live": watching.live,
    "size": recording.file_size,
    "read": reading.read_cartpole,
    "read-hdf5": columns.read_hdf5,
    "materialized": columns.materialized,
    "window": reading.window,
    "list": reading.listing,
    "filter": catalog.filter_catalog,
    "startup": startup.startup,
    "replay": viewing.replay_cartpole,
}


def _options() -> argparse.Namespace:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--only", action="append", choices=CASES, help="measure this only (may be repeated)")
    parser.add_argument("--quick", action="store_true", help="a tenth of the work: a look, not a result")
    parser.add_argument(
        "--steps", type=int, help="steps recorded a round by the fast sides (default 100,000)"
    )
    parser.add_argument("--rounds", type=int, help="rounds of each comparison (default 7)")
    parser.add_argument("--json", action="store_true", help="print the lines as JSON")
    options = parser.parse_args()
    if min(options.steps or 10_000, (options.rounds or 1) * 10_000) < 10_000:
        parser.error("--steps must be at least 10000 and --rounds at least 1")
    return options


def _table(lines: list[Line]) -> Table:
    """The report: one row a side, a rule between cases."""
    table = Table(title="tupli-mcap side by side (median, min-max)", title_justify="left")
    for heading in ("case", "side", "what it does"):
        table.add_column(heading, overflow="fold")
    for heading in ("median", "min - max", "ratio"):
        table.add_column(heading, justify="right", no_wrap=True)
    table.add_column("target")
    table.add_column("met")
    for number, line in enumerate(lines):
        last = number + 1 == len(lines) or lines[number + 1].case != line.case
        if line.values:
            figures = (
                f"{statistics.median(line.values):.3g} {line.unit}",
                f"{min(line.values):.3g} - {max(line.values):.3g}",
                "" if line.ratio is None else f"{line.ratio:.3g}",
            )
        else:
            figures = (line.note, "", "")
        met = {None: "", True: "[green]yes[/]", False: "[red]no[/]"}[line.met]
        table.add_row(
            line.case, line.side, escape(line.does), *map(escape, figures), line.target, met, end_section=last
        )
    return table


def main() -> None:
    """Run the chosen cases and print the report; the exit code says only whether they ran."""
    options = _options()
    part = 10 if options.quick else 1
    console = Console(stderr=True)
    lines: list[Line] = []
    with tempfile.TemporaryDirectory(prefix="tupli-mcap-bench-") as directory:
        run = Run(
            Path(directory),
            steps=options.steps or 100_000 // part,
            read_steps=1_000_000 // part,
            rounds=options.rounds or (3 if options.quick else 7),
            episodes=100_000 // part,
            catalogued=1_000_000 // part,
        )
        for name, case in CASES.items():
            if options.only and name not in options.only:
                continue
            with console.status(f"measuring {name}"):
                lines += case(run)
    if options.json:
        json.dump([line.as_json() for line in lines], sys.stdout, indent=2)
        print()
    else:
        Console(width=None if sys.stdout.isatty() else 200).print(_table(lines))


if __name__ == "__main__":
    main()
