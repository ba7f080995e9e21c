"""The Rerun web viewer of rerun-sdk, as files that our pages serve, so that they load nothing from other hosts.

The program `rerun` contains the files and serves them. We fetch them from it once, and keep them compressed in the
user's cache directory, where nobody else can write. Viewer and data have the same version: a viewer reads no other.
"""

from __future__ import annotations

import gzip
import threading
import urllib.request
from pathlib import Path
from typing import Final

from tupli_mcap import files
from tupli_mcap.cache import cache_dir, make_private
from tupli_mcap.errors import StorageError, os_reason
from tupli_mcap.storage.catalog.place import is_private

NAMES: Final = {"re_viewer.js": "text/javascript", "re_viewer_bg.wasm": "application/wasm"}
_turn = threading.Lock()


def viewer_version() -> str:
    """The version of rerun-sdk. MissingExtraError if it is not installed."""
    from tupli_mcap.viewer.sdk import rerun_sdk

    return str(rerun_sdk().__version__)


def viewer_file(name: str) -> Path:
    """One of NAMES, compressed by gzip.

    Raises:
        MissingExtraError: rerun-sdk is not installed.
        ViewerError: its program cannot be run.
        StorageError: the files cannot be kept, or others may write to their directory.
    """
    folder = cache_dir() / "viewer" / viewer_version()
    with _turn:
        if not (folder / f"{name}.gz").is_file():
            _take(folder)
        if not is_private(folder) or not is_private(folder / f"{name}.gz"):
            raise StorageError(f"other users may write to {folder}; remove it, or set TUPLI_MCAP_CACHE_DIR")
    return folder / f"{name}.gz"


def _take(folder: Path) -> None:
    from tupli_mcap.viewer.process import LOCAL, viewer_program, web_viewer

    try:
        make_private(folder)
        with web_viewer(viewer_program()) as (_, _, page):
            for name in NAMES:
                with urllib.request.urlopen(f"http://{LOCAL}:{page}/{name}", timeout=60) as answer:
                    data = gzip.compress(answer.read(), 6, mtime=0)
                files.write_bytes(folder / f"{name}.gz", data, permissions=0o600)
    except OSError as err:
        raise StorageError(f"the viewer's files cannot be kept in {folder}: {os_reason(err)}") from err
