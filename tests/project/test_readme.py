"""What the README says is so: its Python runs, and what it names is there."""

from __future__ import annotations

import os
import re
from pathlib import Path

import pytest
import typer
from code_blocks import _BLOCK, blocks, run_python

from tupli_mcap.cli import app

ROOT = Path(__file__).parents[2]
README = (ROOT / "README.md").read_text(encoding="utf-8")

_LINK = re.compile(r"\]\(([^)\s]+)\)")
_PATH = re.compile(r"(?<![\w./-])(?:tools|tests|schemas|docs|tupli_mcap|\.ci)/[\w./-]*\w")
_COMMAND = re.compile(r"(?<![\w./-])(?:\.venv/bin/)?tupli-mcap +([a-z][a-z-]*)")


def missing(text: str) -> list[str]:
    """The files and commands that a text names and that are not there."""
    links = {link.partition("#")[0] for link in _LINK.findall(text) if not re.match(r"[a-z]+:|#", link)}
    paths = links | set(_PATH.findall(text))
    gone = [path for path in sorted(paths) if not (ROOT / path).exists()]
    scripts = [path for path in sorted(paths) if re.fullmatch(r"tools/[\w-]+", path) and path not in gone]
    gone += [f"{path} is not executable" for path in scripts if not os.access(ROOT / path, os.X_OK)]
    code = "\n".join([body for _, body in _BLOCK.findall(text)] + re.findall(r"`([^`\n]+)`", text))
    known = typer.main.get_command(app).commands  # type: ignore[attr-defined]
    return gone + [f"tupli-mcap {name}" for name in sorted(set(_COMMAND.findall(code)) - set(known))]


def test_its_python_prints_what_it_says(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    run_python(README)
    assert capsys.readouterr().out == "".join(text for _, text in blocks(README, "text"))


def test_what_it_names_is_there() -> None:
    assert missing(README) == []


def test_every_block_is_closed_and_says_its_language() -> None:
    assert README.count("\n```") % 2 == 0
    assert all(language for language, _ in _BLOCK.findall(README))


# --- that these tests can fail ---

EXAMPLE = """
Read [this](LICENSE), [that](nowhere.md#part), [the web](https://example.org) or [below](#below); run `tools/demo`,
`tools/nothing` or `tupli-mcap info FILE`.

```console
$ .venv/bin/tupli-mcap vanish
$ tools/demo.py
```

```python
first = 1
```

```python
second = first + 1
assert second == 2
```

```python
raise RuntimeError("third")
```
"""


def test_missing_files_and_commands_are_found() -> None:
    assert missing(EXAMPLE) == ["nowhere.md", "tools/nothing", "tupli-mcap vanish"]


def test_blocks_run_in_order_in_one_namespace() -> None:
    with pytest.raises(RuntimeError, match="third") as raised:
        run_python(EXAMPLE)
    assert raised.traceback[-1].lineno + 1 == EXAMPLE.split("\n").index('raise RuntimeError("third")') + 1
    assert run_python(EXAMPLE.rpartition("```python")[0])["second"] == 2
