"""Runs commands in this process."""

from __future__ import annotations

import json
from typing import Any, NamedTuple

from typer.testing import CliRunner

from tupli_mcap.cli import app


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
