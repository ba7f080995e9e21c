"""What the errors say to do about a missing extra has to work where the user is."""

from __future__ import annotations

import json
import os
import re
import shlex
import shutil
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest

import tupli_mcap
from tupli_mcap.errors import MissingExtraError, install_line, missing_extra

ROOT = Path(tupli_mcap.__file__).parents[1]


def test_in_a_checkout_it_is_installed_from_there() -> None:
    assert shlex.split(install_line("rerun")) == ["pip", "install", "-e", f"{ROOT}[rerun]"]
    err = missing_extra("reports need matplotlib", "plot")
    assert isinstance(err, MissingExtraError)
    assert str(err) == f"reports need matplotlib: {install_line('plot')}"


@pytest.mark.parametrize(
    ("origin", "source"),
    [
        (None, "tupli-mcap"),
        ({"url": "file://@/my%20checkout", "dir_info": {}}, "@/my checkout"),
        ({"url": "file://@/tupli.whl", "archive_info": {}}, "@/tupli.whl"),
        ({"url": "file://@/gone", "dir_info": {}}, "tupli-mcap"),
        ({"url": "https://example.org/tupli.whl", "archive_info": {}}, "tupli-mcap"),
        ({"nonsense": 1}, "tupli-mcap"),
    ],
)
def test_installed_it_is_installed_as_before(
    tmp_path: Path, origin: dict[str, str] | None, source: str
) -> None:
    site = tmp_path / "site"
    about = site / "tupli_mcap-0.1.0.dist-info"
    about.mkdir(parents=True)
    (about / "METADATA").write_text("Metadata-Version: 2.1\nName: tupli-mcap\nVersion: 0.1.0\n")
    if origin is not None:
        (about / "direct_url.json").write_text(json.dumps(origin).replace("@", str(tmp_path)))
    (tmp_path / "my checkout").mkdir()
    (tmp_path / "tupli.whl").touch()
    (site / "pyproject.toml").write_text('[project]\nname = "of somebody else"\n')
    (site / "tupli_mcap").mkdir()
    (site / "tupli_mcap" / "__init__.py").touch()
    shutil.copy(ROOT / "tupli_mcap" / "errors.py", site / "tupli_mcap")
    script = "from tupli_mcap.errors import install_line; print(install_line('rerun'))"
    environment = {**os.environ, "PYTHONPATH": str(site)}
    found = subprocess.run(
        [sys.executable, "-c", script],
        cwd=tmp_path,
        env=environment,
        capture_output=True,
        text=True,
        check=True,
    )
    expected = source.replace("@", str(tmp_path))
    assert shlex.split(found.stdout) == ["pip", "install", f"{expected}[rerun]"]


def test_every_extra_that_is_named_exists() -> None:
    extras = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["optional-dependencies"]
    sources = [path.read_text() for path in (ROOT / "tupli_mcap").rglob("*.py") if path.name != "errors.py"]
    named = {
        name for text in sources for name in re.findall(r"missing_extra\([^)]*?\"(\w+)\"\)", text, re.DOTALL)
    }
    assert named <= extras.keys()
    assert len(named) > 8
    assert not [text for text in sources if re.search(r"pip install[^\n]*tupli-mcap", text)]
