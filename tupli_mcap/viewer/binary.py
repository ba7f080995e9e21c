"""The viewer's program, which comes with rerun-sdk."""

from __future__ import annotations

import importlib.util
import shutil
import subprocess
from pathlib import Path

from tupli_mcap.viewer.sdk import ViewerError, rerun_sdk, version_of

__all__ = ["run_quietly", "viewer_program"]


def viewer_program() -> Path:
    """The program `rerun`: the one of the installed rerun-sdk, else one on the PATH of the same version.

    Raises:
        ViewerError: there is none, or it is of another version than the data would be.
    """
    sdk = rerun_sdk().__version__
    again = f"install it with pip install --force-reinstall rerun-sdk=={sdk}"
    spec = importlib.util.find_spec("rerun_cli")
    for folder in (spec.submodule_search_locations or ()) if spec is not None else ():
        program = Path(folder) / "rerun"
        if program.is_file():
            return program
    found = shutil.which("rerun")
    if found is None:
        raise ViewerError(f"there is no viewer: expected the program 'rerun' of rerun-sdk {sdk}; {again}")
    told = run_quietly(Path(found), "--version")
    if version_of(told) != version_of(sdk):
        raise ViewerError(
            f"expected the viewer {found} to be of version {sdk}, as rerun-sdk is, found {told.strip()[:80]!r}; {again}"
        )
    return Path(found)


def run_quietly(program: Path, *arguments: str) -> str:
    """What the program prints.

    Raises:
        ViewerError: it cannot be run, or fails.
    """
    try:
        done = subprocess.run(
            [program, *arguments], capture_output=True, text=True, errors="replace", check=False, timeout=600
        )
    except (OSError, subprocess.TimeoutExpired) as err:
        raise ViewerError(f"the viewer {program} cannot be run: {err}") from err
    if done.returncode:
        last = (done.stderr.strip() or done.stdout.strip() or "nothing").splitlines()[-1]
        raise ViewerError(f"{program.name} {' '.join(arguments[:2])} failed: {last[:200]}")
    return done.stdout
