"""What a page's kernel starts with: `$ ` before a line of a cell runs it in a shell; pictures of the viewer.

IPython runs this file before a page's first cell. None of it is of the pages' own Python.
"""

from __future__ import annotations

import os
import shutil
import subprocess
import warnings


def _run_shell(lines: list[str]) -> list[str]:
    """Turns lines that begin with `$ ` into calls of `_shell`; a line that ends with a backslash goes on."""
    if not any(line.startswith("$ ") for line in lines):
        return lines
    text = "".join(lines).replace("\\\n", " ")
    return [f"_shell({line[2:]!r})\n" if line.startswith("$ ") else line + "\n" for line in text.splitlines()]


def shell(command: str) -> None:
    """As a cell `$ COMMAND`, for commands that the page has to make up; shown with what it writes."""
    print(f"$ {command}")
    _shell(command)


def _shell(command: str) -> None:
    """Runs a command and prints what it writes; a page whose command fails is not built."""
    done = subprocess.run(
        ["bash", "-c", command], stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, check=False
    )
    print(done.stdout, end="")
    if done.returncode:
        raise RuntimeError(f"`{command}` ended with {done.returncode}")


def make_recordings() -> None:
    """The recordings that pages of how-tos work on: run.mcap, and three runs in runs/."""
    shutil.copytree(os.environ["TUPLI_MCAP_DOCS_RECORDINGS"], ".", dirs_exist_ok=True)


def copy_example(name: str) -> None:
    """A script of examples/, to be run by a command."""
    shutil.copy(f"{os.environ['TUPLI_MCAP_DOCS_EXAMPLES']}/{name}", ".")


def show_viewer(
    recording: object, step: int | None = None, size: tuple[int, int] = (1280, 720), **options: object
):
    """A picture of the Rerun viewer that shows a recording (a path), as `tupli-mcap view` does."""
    import tempfile
    from pathlib import Path

    from IPython.display import Image
    from viewing import HeadlessViewer

    from tupli_mcap import viewer

    with tempfile.TemporaryDirectory() as name, HeadlessViewer(Path(name), size) as window:
        saved = viewer.save(recording, Path(name) / "view.rrd", **options)
        picture = Path(name) / "view.png"
        window.portrait(saved, picture, step)
        return Image(data=picture.read_bytes())


_page = get_ipython()  # type: ignore[name-defined]  # noqa: F821
_page.input_transformers_cleanup.append(_run_shell)
# A page shows a report as HTML, and would draw it as a picture in vain.
_pictures = _page.display_formatter.formatters["image/png"]
_pictures.for_type_by_name("tupli_mcap.plots.report", "Report", lambda report: None)
warnings.filterwarnings("ignore", message=".*IProgress.*")
