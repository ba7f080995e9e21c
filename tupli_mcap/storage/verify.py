"""Verifies many files: recordings of directories, and the other files of a storage. Nothing is written."""

from __future__ import annotations

import contextlib
import hashlib
import os
import warnings
from collections.abc import Iterable, Iterator
from pathlib import Path

from tupli_mcap import files
from tupli_mcap.environment import DOCUMENT_NAME
from tupli_mcap.errors import FormatError, NotFoundError, RecordingError, TupliError, os_reason
from tupli_mcap.journal.file import journal_path
from tupli_mcap.mcap.lock import is_locked
from tupli_mcap.mcap.source import open_regular
from tupli_mcap.recording import Recording, VerifyReport, verify_recording
from tupli_mcap.recording.check.report import Findings
from tupli_mcap.remote import copied, is_server, is_url, path_of, shown
from tupli_mcap.storage.atomic import Lock
from tupli_mcap.storage.bundles import carried_benchmark
from tupli_mcap.storage.files.artifacts import ArtifactFiles
from tupli_mcap.storage.files.benchmarks import BenchmarkFiles
from tupli_mcap.storage.listing import is_storage, recordings_at
from tupli_mcap.storage.sidecar import DELETING, Notes, sidecar_path
from tupli_mcap.storage.texts import is_hash

_AGAIN = "store it again, or import its bundle"


def verify_paths(paths: Iterable[Path | str]) -> Iterator[tuple[VerifyReport, Path]]:
    """Verifies files, patterns and directories, one after the other, also after damage. A URL is copied first.

    A path that does not exist gives a report with a problem. Files that killed processes left are reported last. With
    each report comes the path of what it is about; of a URL, that of its copy, which goes with the next report.
    """
    beside: dict[Path, None] = {}
    for given in paths:
        if isinstance(given, str) and is_url(given):
            for url in _found_at(given):
                yield from _at_url(url)
            continue
        path = path_of(given)
        if path.is_dir():
            try:
                found = [Path(file) for file in recordings_at(path)]
            except TupliError as err:
                refused = VerifyReport(str(path), kind="storage")
                yield _refused(refused, err, "check the directory"), path
                continue
            yield from ((_recording(file), file) for file in found)
            yield from ((report, path) for report in _directory(path))
        else:
            for file in map(Path, _found_at(path)):
                yield _recording(file), file
                beside[file.parent] = None
    for directory in beside:
        yield from ((report, directory) for report in _left_in(directory))


def _found_at(place: Path | str) -> list[str]:
    """What a pattern matches, or the path or URL itself: whether there is a file will be seen."""
    try:
        return recordings_at(place)
    except TupliError:
        return [str(place)]


def _at_url(url: str) -> Iterator[tuple[VerifyReport, Path]]:
    """The report on a file on a server, from a copy."""
    try:
        if is_server(url):
            raise RecordingError(
                f"{shown(url)} is a server, not a recording; fetch its recordings with tupli-mcap pull, and verify them"
            )
        with copied(url) as path:
            report = _recording(path)
            report.path = shown(url)
            yield report, path
    except TupliError as err:
        yield _refused(VerifyReport(shown(url)), err, "check the address"), Path()


def _refused(report: VerifyReport, err: Exception, advice: str) -> VerifyReport:
    """The report on what cannot be read; `advice` is given if the error gives none."""
    message = str(err).removeprefix(f"{report.path}: ").removeprefix(f"{report.path} ")
    message, _, told = message.partition("; ")
    Findings(report).error("file", message, advice=told or advice)
    return report


def _recording(path: Path) -> VerifyReport:
    report = VerifyReport(str(path))
    try:
        report = verify_recording(path)
        findings = Findings(report)
        if report.kind == "recording" and report.ok:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore", UserWarning)  # about the journal, which the report covers
                _sidecar(path, findings)
                _benchmark(path, findings)
    except (TupliError, OSError) as err:
        _refused(report, err, "give a recording (.mcap) or a directory of them")
    return report


def _sidecar(path: Path, findings: Findings) -> None:
    """Checks that the notes beside a recording are about it, and about episodes it has."""
    try:
        notes = Notes.read(path)
    except TupliError as err:
        findings.error(
            "sidecar", str(err), advice=f"delete {sidecar_path(path).name}: deletions are then undone"
        )
        return
    if all(said.is_empty() for said in notes):
        return
    with Recording(path) as recording:
        numbers = {int(number) for number in recording.index["episode"]}
        sidecar, is_left = notes.about(recording.metadata), not notes.beside.is_about(recording.metadata)
    if is_left and not notes.beside.is_empty():
        what = f"{sidecar_path(path).name} is about another recording, whose place this one has taken"
        findings.note(
            "leftover", what, "nothing to be done: it does not count; the next note takes its place"
        )
    strange = sorted((sidecar.deleted | sidecar.published_in.keys()) - numbers)
    if strange:
        what = f"{sidecar_path(path).name} notes episodes that are not in the recording: {strange[:10]}"
        findings.note("sidecar", what, "nothing to be done; compacting the storage removes such notes")


def _benchmark(path: Path, findings: Findings) -> None:
    """Checks that the id of a carried benchmark is the hash of its contents."""
    if any(problem.kind == "benchmark" for problem in findings.report.problems):
        return  # said already
    with Recording(path) as recording:
        carries = DOCUMENT_NAME in recording.attachments
        if carries and "id" in (recording.benchmark.record.benchmark or {}):
            try:
                carried_benchmark(recording, path)
            except TupliError as err:
                findings.error("benchmark", str(err).removeprefix(f"{path}: "))


# ---- the other files of a directory


def _directory(root: Path) -> Iterator[VerifyReport]:
    """A report on the files beside the recordings, if there are any."""
    report = VerifyReport(str(root), kind="storage")
    findings = Findings(report)
    is_whole = is_storage(root)
    for check in (_leftovers, *((_settings, _artifacts, _benchmarks) if is_whole else ())):
        try:
            check(root, findings)
        except (OSError, TupliError) as err:
            findings.error("storage", str(err), advice="check the directory's permissions")
    if is_whole or report.problems:
        yield report


def _left_in(directory: Path) -> Iterator[VerifyReport]:
    """A report on what killed processes have left in a directory, if there is any."""
    report = VerifyReport(str(directory), kind="storage")
    with contextlib.suppress(OSError):  # there is no such directory, or nobody may list it
        for path in files.left_in(directory):
            _left(path.name, Findings(report))
    if report.problems:
        yield report


def _left(name: str, findings: Findings) -> None:
    advice = "delete it; in a storage, tupli-mcap compact removes such files"
    findings.note("leftover", f"{name} was left by a process that was killed", advice)


def _leftovers(root: Path, findings: Findings) -> None:
    """Reports files of killed processes, and those of recordings that are gone."""
    for path in files.left_below(root):
        _left(str(path.relative_to(root)), findings)
    for path in sorted(Path(directory, name) for directory, _, names in os.walk(root) for name in names):
        name, relative = path.name, str(path.relative_to(root))
        if name.endswith(".mcap.journal") and not path.with_name(name.removesuffix(".journal")).exists():
            what = f"{relative} is the journal of a recording that is not here"
            findings.note(
                "leftover", what, "bring its recording back beside it; it holds that one's last steps"
            )
        elif name.endswith(".mcap.journal"):
            _finished_journal(path, relative, findings)
        elif relative == DELETING:
            advice = "nothing to be done: the episodes are gone; the next deletion finishes it, or tupli-mcap compact"
            findings.note("leftover", f"{relative} is of a deletion that was interrupted", advice)
        elif name.endswith(".mcap.json") and not path.with_name(name.removesuffix(".json")).exists():
            findings.note("leftover", f"{relative} is about a recording that is not here", "delete it")


def _finished_journal(path: Path, relative: str, findings: Findings) -> None:
    recording = path.with_name(path.name.removesuffix(".journal"))
    if is_locked(recording) or journal_path(recording).name != path.name:
        return
    with contextlib.suppress(TupliError), Recording(recording) as opened:
        if opened.complete:
            findings.note("leftover", f"{relative} lies beside a finished recording", "delete it")


def _settings(root: Path, findings: Findings) -> None:
    """Checks that the storage can be opened with its settings."""
    if (root / "storage.json").exists():
        from tupli_mcap.storage.files import FileStorage  # needs a database, which the other checks do not

        try:
            FileStorage(root).close()
        except FormatError as err:
            findings.error("storage", str(err), advice="delete it, and declare its keys again")


def _artifacts(root: Path, findings: Findings) -> None:
    """Checks artifacts: bytes against their SHA-256, and their metadata."""
    directory = root / "artifacts"
    if not directory.is_dir():
        return
    artifacts = ArtifactFiles(directory, Lock(root / ".lock"))
    for path in sorted(directory.iterdir()):
        if path.name.endswith(".json") and is_hash(path.stem) and not path.with_suffix("").exists():
            findings.error("artifact", f"artifact {path.stem} has no bytes", advice=_AGAIN)
        if not is_hash(path.name):
            continue
        try:
            with os.fdopen(open_regular(path), "rb") as file:
                digest = hashlib.file_digest(file, "sha256").hexdigest()
        except OSError as err:
            findings.error(
                "artifact", f"artifact {path.name} cannot be read: {os_reason(err)}", advice=_AGAIN
            )
            continue
        findings.report.attachments += 1
        if digest != path.name:
            what = f"artifact {path.name} has bytes with SHA-256 {digest}"
            findings.error("artifact", what, advice=_AGAIN)
        try:
            artifacts.item(path.name)
        except NotFoundError:
            what = f"artifact {path.name} has no metadata, so it is not listed"
            advice = (
                "a process stores it, or was killed while it did: then store it again, or delete the file"
            )
            findings.note("leftover", what, advice)
        except TupliError as err:
            findings.error("artifact", str(err), advice="store it again with its metadata")


def _benchmarks(root: Path, findings: Findings) -> None:
    """Checks benchmarks against the hash of their contents, and that their artifacts are there."""
    directory = root / "benchmarks"
    if not directory.is_dir():
        return
    benchmarks = BenchmarkFiles(directory, Lock(root / ".lock"))
    for path in sorted(directory.glob("*.json")):
        if not is_hash(path.stem):
            continue
        try:
            benchmarks.load(path.stem)
            for artifact in benchmarks.artifacts(path.stem):
                if not (root / "artifacts" / artifact).is_file():
                    what = f"benchmark {path.stem} lacks its artifact {artifact}"
                    findings.error("benchmark", what, advice="store the artifact again, or import its bundle")
        except TupliError as err:
            findings.error("benchmark", str(err), advice=_AGAIN)
