"""The command that serves a directory: serve."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from tupli_mcap.cli.terminal import say
from tupli_mcap.errors import missing_extra

__all__ = ["serve"]


def serve(
    directory: Annotated[Path, typer.Argument(metavar="DIR", help="Where the server keeps everything.")],
    host: Annotated[
        str, typer.Option(help="The address to listen at; 0.0.0.0 is all of them.")
    ] = "127.0.0.1",
    port: Annotated[int, typer.Option(min=0, max=65535)] = 8080,
    open_signup: Annotated[bool, typer.Option("--open-signup", help="Let everybody sign up.")] = False,
    guests: Annotated[
        bool,
        typer.Option("--guests", help="Show what is published in 'global' to everybody, without a sign-in."),
    ] = False,
    database: Annotated[
        str,
        typer.Option(
            envvar="TUPLI_MCAP_DATABASE",
            metavar="URL",
            help="A database's URL, such as postgresql+psycopg://…; by default SQLite in DIR.",
        ),
    ] = "",
    blobs: Annotated[
        str,
        typer.Option(
            envvar="TUPLI_MCAP_BLOBS",
            metavar="URL",
            help="A bucket for recordings and artifacts, such as s3://lab/server; DIR by default.",
        ),
    ] = "",
    presigned: Annotated[
        bool, typer.Option("--presigned", help="Send clients to the bucket, which they must reach.")
    ] = False,
) -> None:
    """Share benchmarks and recordings with others over HTTP.

    The first start makes the user `admin` and prints a password, unless TUPLI_MCAP_ADMIN_PASSWORD names
    one. Ctrl-C ends the server after the requests that have begun.
    """
    try:
        from tupli_mcap.server.run import run
    except ImportError as err:
        raise missing_extra("`tupli-mcap serve` needs FastAPI and uvicorn", "server") from err
    from tupli_mcap.server.settings import Settings

    def tell(address: str, password: str | None) -> None:
        if password is not None:
            say(f"user admin, password {password} (shown this once; `tupli-mcap password` changes it)")
        say(f"serving {directory} at {address} (Ctrl-C ends it)")

    settings = Settings(
        directory.absolute(),
        database=database,
        blobs=blobs,
        presigned=presigned,
        open_signup=open_signup,
        guests=guests,
    )
    run(settings, host, port, tell)
