"""Everything else that opens a recording: listing, storages, datasets, recovery, the doctor, the command line."""

from __future__ import annotations

import contextlib
import io
import shutil
import sys
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any
from unittest import mock

from fuzzing.oracle import UnexpectedError, observe
from tupli_mcap.cli import app
from tupli_mcap.dataset import TupliDataset
from tupli_mcap.doctor import examine
from tupli_mcap.errors import TupliError
from tupli_mcap.recording import journal_path, recover_recording, verify_recording
from tupli_mcap.storage import FileStorage
from tupli_mcap.storage.listing import list_recordings

__all__ = ["use_tools"]


def use_tools(path: Path) -> None:
    """Raises UnexpectedError if one of them fails with anything but an error of ours."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)
        for tool in (_list, _dataset, _storage, _verify, _doctor, _recover, _command_line):
            try:
                tool(path)
            except TupliError:
                pass
            except UnexpectedError:
                raise
            except Exception as err:
                raise UnexpectedError(f"{tool.__name__}: {type(err).__name__}: {err}") from err


def _list(path: Path) -> None:
    for _ in list_recordings([path, path.parent]):
        pass


def _dataset(path: Path) -> None:
    dataset = TupliDataset.from_files(path)
    dataset.preview()
    dataset.load()


def _storage(path: Path) -> None:
    root = path.parent / "storage"
    shutil.rmtree(root, ignore_errors=True)
    root.mkdir()
    shutil.copy(path, root)
    with contextlib.suppress(FileNotFoundError):
        shutil.copy(journal_path(path), root)
    with FileStorage(root) as storage:
        for header in storage.list_episodes():
            storage.open_recording(header.recording).close()
    shutil.rmtree(root)


def _verify(path: Path) -> None:
    verify_recording(path)


def _doctor(path: Path) -> None:
    examine(path)


def _recover(path: Path) -> None:
    target = path.with_name("recovered.mcap")
    target.unlink(missing_ok=True)
    report = recover_recording(path, target)
    if report.target is not None:
        facts, refused = observe(target)
        if not facts["open"] or not facts["complete"]:
            raise UnexpectedError(f"the recovered file is not whole: {(refused or ['unfinished'])[0]}")
        target.unlink()


def _command_line(path: Path) -> None:
    for words in (["info"], ["info", "--json"], ["episodes"], ["episodes", "--json"]):
        _run([*words, str(path)])


def _run(words: list[str]) -> None:
    with (
        contextlib.redirect_stdout(io.StringIO()),
        contextlib.redirect_stderr(io.StringIO()),
        mock.patch.object(sys, "argv", ["tupli-mcap", *words]),
        contextlib.suppress(SystemExit),
    ):
        run: Callable[..., Any] = app
        run(words)
