"""Commands that share recordings as files: bundle, import, export."""

from __future__ import annotations

from contextlib import AbstractContextManager, nullcontext
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from tupli_mcap.cli.options import (
    DEFAULT_STORAGE,
    DryRun,
    FilterText,
    Json,
    Output,
    StoragePath,
    filter_of,
    full_id,
    hinting,
    open_storage,
)
from tupli_mcap.cli.output import number, print_facts, print_json, print_result
from tupli_mcap.cli.terminal import ask_secret, say
from tupli_mcap.errors import bytes_of, plural
from tupli_mcap.remote import copied, is_url

if TYPE_CHECKING:
    from tupli_mcap.signing import SigningKey

RecordingFile = Annotated[str, typer.Argument(metavar="FILE", help="A recording: a path or a URL.")]


def bundle(
    source: Annotated[
        str,
        typer.Argument(
            metavar="BENCHMARK_ID|FILE",
            help="A benchmark's id (its first 4 digits are enough), or a recording.",
        ),
    ],
    output: Output,
    storage_path: StoragePath = DEFAULT_STORAGE,
    filter_text: FilterText = None,
    sign: Annotated[
        Path | None,
        typer.Option(
            "--sign",
            metavar="KEY",
            help="Sign it with this private Ed25519 key (OpenSSH or PEM).",
            readable=False,
        ),
    ] = None,
    as_json: Json = False,
) -> None:
    """Write a benchmark with everything it needs to a file.

    The file holds the benchmark, its artifacts and its episodes. Give a benchmark's id to
    take its episodes (all, or those of the filter) from the storage. Give a FILE to take the
    episodes of that recording; the storage adds what the file lacks. A robot's recording has
    no benchmark: it is copied, and signed if you want.

    The code of your own environment is in the file if the environment was stored, or recorded
    with capture_env="pickle". Else the command says what others need to run it.

    `ssh-keygen -t ed25519` makes a key for --sign. Its passphrase is asked for, or taken from
    TUPLI_MCAP_KEY_PASSPHRASE.
    """
    key = None if sign is None else _signing_key(sign)
    if is_url(source) or source.endswith(".mcap") or Path(source).is_file():
        if filter_text is not None:
            raise typer.BadParameter("--filter goes with a benchmark id, not with a file")
        from tupli_mcap.storage.bundles import bundle_recording

        with (
            open_storage(storage_path) if storage_path.is_dir() else nullcontext() as known,
            _local(source) as path,
        ):
            bundle_recording(path, output, known, key)
    else:
        wanted = filter_of(filter_text)
        with open_storage(storage_path) as storage, hinting([str(storage_path)], wanted):
            storage.bundle(full_id(storage, source), output, wanted, sign=key)
    _print_written(output, as_json)
    if not as_json and (needs := _needs_of(output)):
        say(needs)


def _needs_of(path: Path) -> str:
    """What others need to run a recording again, apart from its file; empty if it is nothing, or it has no
    environment."""
    from tupli_mcap.environment import DOCUMENT_NAME, packages_named_by
    from tupli_mcap.recording import Recording

    with Recording(path) as recording:
        if DOCUMENT_NAME not in recording.attachments:
            return ""
        record = recording.benchmark.record
    packages = packages_named_by(record)
    if "__main__" in packages or (record.spec is None and record.pickle is None):
        return (
            "others cannot run it again: the code of its environment is neither in the file nor in a package that the "
            'file names; record with capture_env="pickle"'
        )
    return (
        f"to run it again, others need {', '.join(packages)}, whose code is not in the file"
        if packages
        else ""
    )


def _local(file: str) -> AbstractContextManager[Path]:
    """The path of a file; a URL is downloaded first."""
    return copied(file) if is_url(file) else nullcontext(Path(file))


def export(
    output: Output,
    storage_path: StoragePath = DEFAULT_STORAGE,
    filter_text: FilterText = None,
    dry_run: DryRun = False,
    as_json: Json = False,
) -> None:
    """Write episodes of a storage to one file.

    They must be of one benchmark. If the storage has several, choose one with
    --filter 'benchmark_id = "..."'. Several recordings are merged, as merge does. Artifacts
    are left out; use bundle to include them.
    """
    from tupli_mcap.storage.bundles import export_episodes

    wanted = filter_of(filter_text)
    with open_storage(storage_path) as storage, hinting([str(storage_path)], wanted):
        headers = export_episodes(storage, output, wanted, dry_run=dry_run)
    if not dry_run:
        _print_written(output, as_json, dry_run=False)
        return
    steps = sum(header.n_tuples for header in headers)
    print_result(
        {
            "dry_run": True,
            "path": output,
            "benchmark_id": headers[0].benchmark_id,
            "episodes": len(headers),
            "steps": steps,
            "size": 0,
        },
        f"would write {output}: {plural(len(headers), 'episode')}, {plural(steps, 'step')}",
        as_json=as_json,
    )


def import_(
    file: RecordingFile,
    storage_path: StoragePath = DEFAULT_STORAGE,
    trust: Annotated[bool, typer.Option("--trust", help="Also trust the code of its environment.")] = False,
    require_signature: Annotated[
        bool,
        typer.Option(
            "--require-signature", help="Refuse the file unless a key that you trust has signed it."
        ),
    ] = False,
    signers: Annotated[
        list[str] | None,
        typer.Option(
            "--from",
            metavar="KEY",
            help="Who must have signed it: a name, fingerprint or .pub file. Repeatable.",
        ),
    ] = None,
    dry_run: Annotated[
        bool, typer.Option("--dry-run", help="Only check the file, and say what is new.")
    ] = False,
    as_json: Json = False,
) -> None:
    """Copy a recording into a storage.

    A bundle brings its benchmark and artifacts. A recording that has no benchmark is stored
    without one; bundle makes one of the environment that it carries. A missing storage is
    created. Importing a file twice changes nothing, and what was deleted from the storage
    stays deleted until restore brings it back. Nothing in the file is executed. If a key that
    you trust has signed it, its environment may be rebuilt later.
    """
    from tupli_mcap.signing import find_key
    from tupli_mcap.storage.bundles import read_bundle

    keys = [find_key(text).public_key for text in signers or ()]
    with _local(file) as path, open_storage(storage_path, create=True) as storage:
        found = read_bundle(
            storage,
            path,
            trust=trust,
            require_signature=require_signature or bool(signers),
            signers=keys,
            name=file,
            dry_run=dry_run,
        )
    if as_json:
        print_json({"dry_run": dry_run, **found._asdict()})
        return
    verb = "would import" if dry_run else "imported"
    say(
        f"{verb} {number(found.new_episodes)} of {plural(found.episodes, 'episode')}, "
        f"{number(found.new_artifacts)} of {plural(found.artifacts, 'artifact')}"
    )
    if found.benchmark_id or found.signed_by:
        told = {"benchmark": found.benchmark_id, "name": found.name, "signed by": found.signed_by or ""}
        print_facts(told.items())


def _signing_key(path: Path) -> SigningKey:
    """The private key in a file; asks for a passphrase if the key needs one and stdin is a terminal."""
    import os

    from tupli_mcap.signing import PassphraseNeededError, SigningKey

    passphrase = os.environ.get("TUPLI_MCAP_KEY_PASSPHRASE")
    try:
        return SigningKey(path, passphrase)
    except PassphraseNeededError:
        answer = None if passphrase is not None else ask_secret(f"Passphrase of {path}")
        if answer is None:
            raise
    return SigningKey(path, answer)


def _print_written(path: Path, as_json: bool, **facts: bool) -> None:
    from tupli_mcap.recording import Recording

    with Recording(path) as recording:
        lengths, size = recording.index["length"], recording.size
        told = {**facts, "path": path, "benchmark_id": recording.benchmark_id}
    episodes, steps = len(lengths), int(lengths.sum())
    print_result(
        {**told, "episodes": episodes, "steps": steps, "size": size},
        f"{path}: {plural(episodes, 'episode')}, {plural(steps, 'step')}, {bytes_of(size)}",
        as_json=as_json,
    )
