"""Commands that serve recordings: browse, on this machine; serve, to others; and copies of all data of a server."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from tupli_mcap.cli.options import Json, local_path
from tupli_mcap.cli.output import print_result
from tupli_mcap.cli.terminal import flush, say
from tupli_mcap.errors import bytes_of, missing_extra, plural
from tupli_mcap.remote import is_web


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
        from tupli_mcap.page.app import browse as show_pages
    except ImportError as err:
        raise missing_extra("`tupli-mcap browse` needs FastAPI, Jinja2 and uvicorn", "browse") from err

    def tell(address: str) -> None:
        say(f"{path} at {address} (Ctrl-C ends it)")
        flush()

    show_pages(path, port, tell, show=not no_open)


_Served = Annotated[Path, typer.Argument(metavar="DIR", help="The directory of the server's data.")]
_Database = Annotated[
    str,
    typer.Option(
        envvar="TUPLI_MCAP_DATABASE",
        metavar="URL",
        help="The database's URL, such as postgresql://user@host/name; by default, SQLite in DIR.",
    ),
]
_Blobs = Annotated[
    str,
    typer.Option(
        envvar="TUPLI_MCAP_BLOBS",
        metavar="URL",
        help="A bucket for recordings and artifacts, such as s3://lab/server; by default, DIR.",
    ),
]
_Presigned = Annotated[
    bool,
    typer.Option(
        "--presigned",
        help="Let clients fetch files from the bucket itself, which they must be able to reach.",
    ),
]
_Host = Annotated[str, typer.Option(help="The address to listen on; 0.0.0.0 means all addresses.")]
_Port = Annotated[int, typer.Option(min=0, max=65535, help="The port to listen on; 0 takes a free one.")]
_Signup = Annotated[bool, typer.Option("--open-signup", help="Let everybody sign up.")]
_MinPassword = Annotated[
    int, typer.Option(min=1, max=1024, help="The least number of characters of a new password.")
]
_Guests = Annotated[
    bool, typer.Option("--guests", help="Show what is published in 'global' without a sign-in.")
]
_Workers = Annotated[int, typer.Option(min=1, max=256, help="The number of server processes.")]
_Quota = Annotated[float | None, typer.Option(min=0, metavar="GB", help="How much each user may store.")]
_Seconds = Annotated[float, typer.Option(min=1, help="How many seconds a database query may take.")]
_Metrics = Annotated[bool, typer.Option("--open-metrics", help="Show /metrics without a sign-in.")]
_Loader = Annotated[
    str,
    typer.Option(
        metavar="URL",
        help="Foxglove's remote data loader that reads this server; pages open chosen episodes by it.",
    ),
]
_Certificate = Annotated[
    Path | None, typer.Option(exists=True, dir_okay=False, help="The TLS certificate, in PEM; with --key.")
]
_Key = Annotated[
    Path | None, typer.Option(exists=True, dir_okay=False, help="The TLS key, in PEM; with --certificate.")
]
_Proxies = Annotated[
    list[str] | None,
    typer.Option(metavar="ADDRESS", help="A proxy whose X-Forwarded headers are believed. Repeatable."),
]
_Accel = Annotated[
    str, typer.Option(metavar="PREFIX", help="Let nginx send files from DIR, its internal location PREFIX.")
]


def serve(
    directory: _Served,
    host: _Host = "127.0.0.1",
    port: _Port = 8080,
    open_signup: _Signup = False,
    min_password: _MinPassword = 8,
    guests: _Guests = False,
    workers: _Workers = 1,
    database: _Database = "",
    blobs: _Blobs = "",
    presigned: _Presigned = False,
    quota: _Quota = None,
    query_seconds: _Seconds = 30,
    open_metrics: _Metrics = False,
    foxglove_loader: _Loader = "",
    certificate: _Certificate = None,
    key: _Key = None,
    trusted_proxy: _Proxies = None,
    accel: _Accel = "",
) -> None:
    """Share benchmarks and recordings with others over HTTP.

    The first start creates the user `admin`. Its password is TUPLI_MCAP_ADMIN_PASSWORD, or a
    random one that is printed. Ctrl-C ends the server once running requests are answered.
    """
    try:
        from tupli_mcap.server.run import Listening, run
        from tupli_mcap.server.settings import Settings
    except ImportError as err:
        raise missing_extra("`tupli-mcap serve` needs FastAPI and uvicorn", "server") from err
    if (certificate is None) != (key is None):
        raise typer.BadParameter("expected both --certificate and --key, found only one of them")
    if foxglove_loader and not is_web(foxglove_loader):
        raise typer.BadParameter(
            f"--foxglove-loader: expected an address such as https://loader.example.org, found {foxglove_loader!r:.80}"
        )

    def tell(address: str, password: str | None) -> None:
        if password is not None:
            say(f"user admin, password {password} (shown only this once; `tupli-mcap password` changes it)")
        say(f"serving {directory} at {address} (Ctrl-C ends it)")
        flush()

    settings = Settings(
        directory.absolute(),
        database=database,
        blobs=blobs,
        presigned=presigned,
        accel=accel,
        open_signup=open_signup,
        min_password=min_password,
        guests=guests,
        quota=None if quota is None else round(quota * 1e9),
        query_seconds=query_seconds,
        open_metrics=open_metrics,
        loader=foxglove_loader,
    )
    run(settings, Listening(host, port, workers, certificate, key, trusted_proxy or ()), tell)


def backup_server(
    directory: _Served,
    output: Annotated[
        Path,
        typer.Option(
            "-o", "--output", metavar="DIR", help="The backup's directory: a new one, or an earlier backup."
        ),
    ],
    database: _Database = "",
    blobs: _Blobs = "",
    as_json: Json = False,
) -> None:
    """Back up a server's data into a directory, while it runs.

    Into an earlier backup, only new files are copied. `serve` can serve a backup as it is.
    """
    _copy(directory, output, database, blobs, "backed up", as_json=as_json)


def restore_server(
    backup: Annotated[Path, typer.Argument(metavar="BACKUP", help="The directory that backup-server wrote.")],
    directory: _Served,
    database: _Database = "",
    blobs: _Blobs = "",
    as_json: Json = False,
) -> None:
    """Restore a server's data from a backup.

    DIR, the database and the bucket have to be empty. They may be others than those of the
    backup: this is how to move a server.
    """
    _copy(directory, backup, database, blobs, "restored", as_json=as_json)


def _copy(directory: Path, backup: Path, database: str, blobs: str, done: str, *, as_json: bool) -> None:
    try:
        from tupli_mcap.server.backup import back_up, restore
        from tupli_mcap.server.settings import Settings
    except ImportError as err:
        raise missing_extra("a server's data need SQLAlchemy and Alembic", "server") from err
    settings = Settings(directory.absolute(), database=database, blobs=blobs)
    copied = restore(backup, settings) if done == "restored" else back_up(settings, backup)
    contents = ", ".join(
        plural(count, what)
        for count, what in (
            (copied.users, "user"),
            (copied.recordings, "recording"),
            (copied.artifacts, "artifact"),
        )
    )
    print_result(
        {"directory": str(directory), "backup": str(backup), **copied._asdict()},
        f"{done} {contents} ({bytes_of(copied.bytes)}); {plural(copied.copied, 'file')} copied",
        as_json=as_json,
    )
