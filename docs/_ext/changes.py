"""The changes since the last release, from the fragments in docs/changes."""

from __future__ import annotations

import shlex
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
FRAGMENTS = ROOT / "docs" / "changes"


def unreleased() -> str:
    """The section that a release would have today; empty without a fragment."""
    if not any(FRAGMENTS.glob("+*.md")):
        return ""
    command = shlex.split("-m towncrier build --draft --version Next --date unreleased")
    done = subprocess.run([sys.executable, *command], cwd=ROOT, capture_output=True, text=True, check=True)
    return done.stdout[done.stdout.index("## ") :]
