#!/usr/bin/env python
"""Interrupts recorders at their calls and lines: `python tools/interruptions.py [--every 7] [--twice] [--only NAME]`.

An exception strikes at every `--every`-th event of opening, stepping, resetting, flushing, rotating and closing; with
`--twice` another one follows one to six calls later. Every step that was returned must be in a file that `verify` calls
whole. Prints what fails, with the event that repeats it; exits with 1 if anything does.
"""

from __future__ import annotations

import argparse
import os
import random
import sys
import tempfile
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests" / "support"))

from interruptions import SCENARIOS, interrupted


def main() -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--every", type=int, default=7, help="events from one interruption to the next (7)")
    parser.add_argument("--twice", action="store_true", help="interrupt what follows, too")
    parser.add_argument("--seed", type=int, default=0, help="where the first one is")
    parser.add_argument("--only", choices=SCENARIOS, help="one scenario")
    args = parser.parse_args()
    os.environ["TUPLI_MCAP_CONFIG_DIR"] = tempfile.mkdtemp()
    failed = 0
    for name in [args.only] if args.only else SCENARIOS:
        chance = random.Random(f"{args.seed} {name}")
        at, count, found = chance.randrange(1, args.every + 1), 0, 0
        struck = True
        while struck:
            again, go_on = chance.randrange(1, 7) if args.twice else 0, chance.random() < 0.5
            with tempfile.TemporaryDirectory() as directory:
                try:
                    struck = interrupted(name, Path(directory), at, again, go_on=go_on)
                except Exception as err:  # noqa: BLE001 - whatever it is, it is a finding
                    print(f"{name}: event {at}, again after {again}, go on {go_on}: {err!r:.300}", flush=True)
                    found += 1
            at, count = at + args.every, count + 1
        print(f"{name}: {count} interruptions, {found} failed", flush=True)
        failed += found
    return 1 if failed else 0


if __name__ == "__main__":
    sys.exit(main())
