"""The command browse: shows recordings in a browser."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from tupli_mcap.cli.options import local_path
from tupli_mcap.cli.terminal import flush, say
from tupli_mcap.errors import missing_extra

__all__ = ["browse"]


def browse(
    path: Annotated[
        Path,
        typer.Argument(metavar="PATH", help="A directory, a storage, or a recording.", parser=local_path),
    ] = Path(),
    port: Annotated[int, typer.Option(min=0, max=65535, help="The port; 0 takes a free one.")] = 0,
    no_open: Annotated[
        bool, typer.Option("--no-open", help="Only print the address, and open no browser.")
    ] = False,
) -> None:
    """Look through recordings in a browser.

    Shows datasets, tables of episodes, films and curves. Its pages are served on 127.0.0.1
    until Ctrl-C. They change no file, and load nothing from other servers. Reload a page to
    see new recordings, also running ones. With ?format=json, a page is JSON.
    """
    try:
        from tupli_mcap.page.app import browse as serve
    except ImportError as err:
        raise missing_extra("`tupli-mcap browse` needs FastAPI, Jinja2 and uvicorn", "browse") from err

    def tell(address: str) -> None:
        say(f"{path} at {address} (Ctrl-C ends it)")
        flush()

    serve(path, port, tell, show=not no_open)
