"""Opens `tupli-mcap view --web` in a real Chromium and looks whether there are curves, on 127.0.0.1 only.

    .venv/bin/python tools/web_viewer.py [FILE.mcap] [--screenshot page.png]

Needs Chromium (`tools/setup-viewer web`). Exits with 1 if the page stays empty, complains, or listens elsewhere.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests" / "support"))
import browsing
import viewed


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("file", type=Path, nargs="?", help="a recording; by default one is made")
    parser.add_argument("--screenshot", type=Path, help="where to write what Chromium shows")
    options = parser.parse_args()
    if browsing.CHROMIUM is None:
        sys.exit("expected chromium on the PATH, found none; `tools/setup-viewer web` installs it")
    with tempfile.TemporaryDirectory() as folder:
        recording = options.file or viewed.courier(Path(folder) / "courier.mcap")
        with browsing.served(recording) as (url, addresses):
            print(f"{url}, listening on {', '.join(sorted(addresses))}")
            seen = browsing.browse(url)
    if options.screenshot:
        browsing.save(seen, options.screenshot)
    print(
        f"{seen.ink:.1%} of the page is in colour, {len(seen.complaints)} complaints {seen.complaints or ''}"
    )
    sys.exit(seen.ink < browsing.FILLED or bool(seen.complaints) or addresses != {"127.0.0.1"})


if __name__ == "__main__":
    main()
