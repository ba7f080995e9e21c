"""Kill recording processes and look for lost steps: `python tools/kill.py [--kills N] [--seed N] [--jobs N]`.

Starts each recording, kills its process, checks the file, appends to it and kills again, up to five times, and finishes
it. The processes report every step over a pipe. Exits with 1 if a step is missing or differs in a bit, or anything else
is wrong. `tests/failures/test_kill.py` runs a sample.
"""

from __future__ import annotations

import argparse
import collections
import json
import multiprocessing
import os
import random
import shutil
import sys
import tempfile
import time
from collections.abc import Iterator
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from pathlib import Path
from typing import Any, NamedTuple

from rich.console import Console
from rich.table import Table

ROOT = Path(__file__).resolve().parents[1]
sys.path[:0] = [str(ROOT / "tests" / "support")]

from killing.breakages import BREAKAGES  # noqa: E402
from killing.chain import Death, lives, moments_of  # noqa: E402
from killing.kinds import KINDS  # noqa: E402
from killing.moments import MOMENTS  # noqa: E402


class Chain(NamedTuple):
    """One recording and the moments at which its processes die."""

    kind: str
    moments: tuple[str, ...]
    seed: int


class Pair:
    """The results of one kind at one moment, in new or appended recordings."""

    def __init__(self) -> None:
        self.kills = self.steps = self.losses = 0

    def add(self, death: Death) -> None:
        self.kills += death.killed
        self.steps += death.steps
        self.losses += bool(death.problems)


def plan(kinds: list[str], moments: list[str], seed: int) -> Iterator[Chain]:
    """Endless recordings: kind after kind, each through all of its moments."""
    rng = random.Random(seed)
    left: dict[tuple[str, bool], list[str]] = collections.defaultdict(list)
    while True:
        for kind in rng.sample(kinds, len(kinds)):
            chosen = []
            for i in range(rng.randint(1, 5)):
                waiting = left[kind, i > 0]
                if not waiting:
                    waiting += [name for name in moments_of(kind, appends=i > 0) if name in moments]
                    rng.shuffle(waiting)
                if waiting:
                    chosen.append(waiting.pop())
            if chosen:
                yield Chain(kind, tuple(chosen), rng.randrange(1 << 30))


def live(chain: Chain, breakage: str, keep: str | None) -> list[Death]:
    """Runs in a worker process; keeps the files that went wrong, if asked."""
    directory = Path(tempfile.mkdtemp(prefix="tupli-mcap-kill-"))
    try:
        os.environ["TUPLI_MCAP_CONFIG_DIR"] = str(directory / "config")
        os.environ["TUPLI_MCAP_CACHE_DIR"] = str(directory / "cache")
        place = directory / "here"
        place.mkdir()
        deaths = lives(chain.kind, chain.moments, chain.seed, place, breakage)
        if keep and any(death.problems for death in deaths):
            shutil.copytree(place, Path(keep) / f"{chain.kind}-{chain.seed}", dirs_exist_ok=True)
        return deaths
    finally:
        shutil.rmtree(directory, ignore_errors=True)


def kill(options: argparse.Namespace, console: Console) -> Iterator[tuple[Chain, list[Death]]]:
    """Yields recordings and their results until there were enough kills."""
    chains, killed = plan(options.kind or list(KINDS), options.moment or list(MOMENTS), options.seed), 0
    context = multiprocessing.get_context("spawn")  # each worker forks on its own, and must be small
    with (
        ProcessPoolExecutor(options.jobs, context) as pool,
        console.status("") as status,
    ):
        running: dict[Future[list[Death]], Chain] = {}
        while killed < options.kills or running:
            while killed < options.kills and len(running) < 2 * options.jobs:
                chain = next(chains)
                running[pool.submit(live, chain, options.breakage, options.keep)] = chain
            for done in wait(running, return_when=FIRST_COMPLETED).done:
                deaths = done.result()
                before, killed = killed, killed + sum(death.killed for death in deaths)
                status.update(f"{killed} of {options.kills} kills")
                if not console.is_terminal and killed // 100 > before // 100:
                    console.print(f"{killed} kills")
                yield running.pop(done), deaths


def table(title: str, rows: dict[str, Pair]) -> Table:
    """Kills, steps and losses, a line each."""
    made = Table(title=title, title_justify="left")
    made.add_column("")
    for heading in ("kills", "steps checked", "losses"):
        made.add_column(heading, justify="right")
    for name, pair in rows.items():
        losses = f"[red]{pair.losses}[/]" if pair.losses else "0"
        made.add_row(name, str(pair.kills), f"{pair.steps:,}", losses)
    return made


def matrix(pairs: dict[tuple[str, str], Pair]) -> Table:
    """Kills of each kind at each moment, with losses after a `!`."""
    kinds = [kind for kind in KINDS if any(key[0] == kind for key in pairs)]
    moments = [name for name in MOMENTS if any(key[1] == name for key in pairs)]
    made = Table(title="kills by kind and moment", title_justify="left", padding=(0, 0), pad_edge=False)
    made.add_column("")
    for i in range(len(moments)):
        made.add_column(str(i + 1), justify="right", min_width=3)
    for kind in kinds:
        found = [pairs.get((kind, moment)) for moment in moments]
        made.add_row(
            kind,
            *(
                "" if p is None else f"{p.kills}" + (f"[red]!{p.losses}[/]" if p.losses else "")
                for p in found
            ),
        )
    made.caption = "  ".join(f"{i + 1} {name}" for i, name in enumerate(moments))
    return made


def _options() -> argparse.Namespace:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--kills", type=int, default=500, help="how many (default 500)")
    parser.add_argument("--seed", type=int, default=0, help="of the plan; a kill by time stays what it is")
    parser.add_argument("--jobs", type=int, default=2, help="recordings at once (default 2)")
    parser.add_argument("--kind", action="append", choices=KINDS, help="this only (may be repeated)")
    parser.add_argument("--moment", action="append", choices=MOMENTS, help="this only (may be repeated)")
    parser.add_argument(
        "--break", dest="breakage", default="", choices=BREAKAGES, help="break the recorder first"
    )
    parser.add_argument("--keep", help="a directory for the recordings that something is wrong with")
    parser.add_argument("--json", action="store_true", help="print the figures as JSON")
    return parser.parse_args()


def main() -> int:
    """Kills until there were enough, then reports; 1 if anything was wrong."""
    options = _options()
    console, began = Console(stderr=True), time.monotonic()
    pairs: dict[tuple[str, str], Pair] = collections.defaultdict(Pair)
    groups: dict[str, dict[str, Pair]] = {
        name: collections.defaultdict(Pair) for name in ("kind", "moment", "place")
    }
    total, longest = Pair(), 0
    for chain, deaths in kill(options, console):
        longest = max(longest, sum(death.killed for death in deaths))
        for death in deaths:
            where = "a recording that goes on" if death.appended else "a new recording"
            for pair in (
                total, pairs[death.kind, death.moment], groups["kind"][death.kind],
                groups["moment"][death.moment], groups["place"][where],
            ):  # fmt: skip
                pair.add(death)
            if death.problems:
                console.print(f"{chain}: {death.moment}", style="red", highlight=False, markup=False)
                console.print(*death.problems[:5], sep="\n", markup=False, highlight=False)
    took = time.monotonic() - began
    if options.json:
        figures: dict[str, Any] = {
            "kills": total.kills, "steps": total.steps, "losses": total.losses, "seconds": round(took, 1),
            "pairs": [{"kind": k, "moment": m, **vars(pair)} for (k, m), pair in pairs.items()],
        }  # fmt: skip
        print(json.dumps(figures, indent=2))
    else:
        out = Console(width=None if sys.stdout.isatty() else 160)
        order = {name: i for i, name in enumerate([*KINDS, *MOMENTS])}
        for name, rows in groups.items():
            out.print(table(f"by {name}", dict(sorted(rows.items(), key=lambda row: order.get(row[0], 0)))))
        out.print(matrix(pairs))
        out.print(
            f"{total.kills} kills, up to {longest} of one recording; {total.steps:,} finished steps looked for, "
            f"{total.losses} losses; {took:.0f} s, seed {options.seed}"
        )
    return 1 if total.losses else 0


if __name__ == "__main__":
    sys.exit(main())
