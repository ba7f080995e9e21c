"""Runs commands in this process."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
from typing import Any, NamedTuple

import pytest
from typer.testing import CliRunner

from tupli_mcap.cli.app import app


class Result(NamedTuple):
    """What a command printed, and its exit code."""

    code: int
    out: str
    err: str

    @property
    def json(self) -> Any:
        """The result in the one document that --json prints."""
        assert (self.code, self.err) == (0, "")
        document = json.loads(self.out)
        assert list(document) == ["version", "command", "result"]
        return document["result"]


def run(*args: object) -> Result:
    """Runs `tupli-mcap ARGS`; raises what it does not report."""
    result = CliRunner().invoke(app, [str(arg) for arg in args])
    if result.exception is not None and not isinstance(result.exception, SystemExit):
        raise result.exception
    return Result(result.exit_code, result.stdout, result.stderr)


def ok(*args: object) -> str:
    result = run(*args)
    assert (result.code, result.err) == (0, "")
    return result.out


def fails(*args: object, code: int = 1) -> str:
    """The one line of a failure, without `error: `; nothing else is printed."""
    result = run(*args)
    assert result.code == code
    assert result.out == ""
    assert result.err.count("\n") == 1
    assert result.err.startswith("error: ")
    return result.err.removeprefix("error: ").rstrip("\n")


def unprivileged(*args: object) -> subprocess.CompletedProcess[str]:
    """A command that permissions hold for, as root's do not."""
    drop = ["setpriv", "--bounding-set=-dac_override,-dac_read_search"] if os.geteuid() == 0 else []
    if drop and shutil.which("setpriv") is None:
        pytest.skip("needs setpriv")
    command = [*drop, sys.executable, "-c", "from tupli_mcap.cli import main; main()", *map(str, args)]
    return subprocess.run(command, capture_output=True, text=True, check=False, timeout=60)
