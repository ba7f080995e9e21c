"""The changes since the last release, from the fragments in docs/changes."""

from __future__ import annotations

import shlex
import subprocess
import sys
import tomllib
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
FRAGMENTS = ROOT / "docs" / "changes"


def unreleased() -> str:
    """The section that a release would have today; empty without a fragment."""
    if not any(FRAGMENTS.glob("+*.md")):
        return ""
    version = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["version"]
    command = shlex.split(f"-m towncrier build --draft --version {version} --date unreleased")
    done = subprocess.run([sys.executable, *command], cwd=ROOT, capture_output=True, text=True, check=True)
    return done.stdout[done.stdout.index("## ") :]
