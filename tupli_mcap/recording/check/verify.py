"""`verify_recording` checks everything that can be wrong with a recording. It executes nothing from the file."""

from __future__ import annotations

import hashlib
import json
import os
import warnings
from collections.abc import Callable
from pathlib import Path

from tupli_mcap.environment import DOCUMENT_NAME, PICKLE_NAME, EnvironmentRecord
from tupli_mcap.errors import FormatError, MissingExtraError, RecordingError, SignatureError, TupliError
from tupli_mcap.files import is_there
from tupli_mcap.journal.file import journal_info, recorded_journal
from tupli_mcap.mcap.container import Container
from tupli_mcap.mcap.lock import is_locked
from tupli_mcap.mcap.records import OTHER_TOOLS, has_summary
from tupli_mcap.mcap.source import PathSource, Source
from tupli_mcap.messages.images.codecs import png_leaves
from tupli_mcap.messages.infos import InfoCodec
from tupli_mcap.messages.topics import INFO
from tupli_mcap.progress import progress
from tupli_mcap.recording.about.annotations import ANNOTATIONS_NAME
from tupli_mcap.recording.about.described import MADE_OF_NAME
from tupli_mcap.recording.about.run import RUN_NAME
from tupli_mcap.recording.channels import register_channels
from tupli_mcap.recording.check.episodes import verify_episodes
from tupli_mcap.recording.check.frames import verify_frames
from tupli_mcap.recording.check.report import RECOVER, Findings, VerifyReport
from tupli_mcap.recording.check.signature import verify_signature
from tupli_mcap.recording.check.structure import Structure
from tupli_mcap.recording.contents import NewerVersionError
from tupli_mcap.recording.recording import Recording
from tupli_mcap.recording.recover.damaged import is_foreign, may_be_recording, read_file_end
from tupli_mcap.recording.recover.evidence import head
from tupli_mcap.recording.recover.from_journal import KEEP_JOURNAL, STEPS_IN_JOURNAL, belongs
from tupli_mcap.recording.signature_file import SIGNATURE_NAME
from tupli_mcap.spaces.labels import LABELS_NAME

_ARTIFACT = "artifacts/"
_KINDS = {DOCUMENT_NAME: "benchmark", SIGNATURE_NAME: "signature"}  # of problems of attachments
_UNVERIFIED = "; steps that are still in its journal are not verified: they get a checksum when they leave it"
_FROM_STORAGE = "load its benchmark from the storage it is in"
# attachments that say something of runs, episodes and values, and what raises FormatError if one of them is damaged
_STATED: dict[str, Callable[[Recording], object]] = {
    RUN_NAME: lambda recording: recording.runs,
    ANNOTATIONS_NAME: lambda recording: recording.annotations,
    MADE_OF_NAME: lambda recording: recording.made_of,
    LABELS_NAME: lambda recording: recording.labels,
}


def verify_recording(path: str | os.PathLike[str]) -> VerifyReport:
    """Checks a file: structure, every CRC, indexes against contents, layouts, episodes, digests.

    A file that cannot be read, or is no recording, is a problem in the report. Chunks are read one at a time.

    Raises:
        RecordingError: there is no such file, or the disk fails.
    """
    report = VerifyReport(str(path))
    findings = Findings(report, str(Path(path)))
    try:
        source = PathSource(Path(path))
    except RecordingError:
        if not (is_there(path) and Path(path).is_file()):
            raise
        findings.error("file", "it cannot be opened", advice="check its permissions")
        return report
    try:
        _verify(source, findings)
    except NewerVersionError as err:
        why, _, advice = str(err).removeprefix(f"{source.name}: ").rpartition("; ")
        findings.error("file", why, advice=advice)
    except (FormatError, OSError) as err:
        findings.error("file", str(err))
    finally:
        source.close()
    return report


def _verify(source: Source, findings: Findings) -> None:
    report = findings.report
    report.size = source.size
    if not source.size:
        findings.error("file", "it is empty", advice="delete it, or record again")
        return
    live = source.path is not None and is_locked(source.path)
    file_end = read_file_end(source)
    if not may_be_recording(source, file_end):
        findings.error("file", "it is an MCAP file, but no recording of tupli-mcap", advice=OTHER_TOOLS)
        return
    if is_foreign(source):
        findings.note("file", "another program wrote it", "nothing to be done")
    lost, unreadable = ("", False) if has_summary(source) else _lost_journal(source)
    if not has_summary(source) and (file_end.index is None or not lost):
        report.state = "recording" if live else "unfinished"
    structure = Structure(source, file_end, findings, journal_lost=bool(lost))
    # every chunk is read twice: for its CRC, and for what is in it
    with progress(2 * source.size, f"verifying {source.name}") as bar:
        structure.run(bar.advance)
        if report.state != "complete":
            _note_unfinished(structure, lost, findings, unreadable=unreadable)
        _contents(source, structure, findings, bar.advance)
    if live and report.state == "complete":
        report.state = "recording"


def _note_unfinished(structure: Structure, lost: str, findings: Findings, *, unreadable: bool) -> None:
    if findings.report.state == "recording":
        findings.note("file", "a writer is at work on it", "verify it again once it is closed")
        return
    if unreadable:
        findings.note("file", "its writer did not finish it", "nothing to be done")
        findings.error("journal", f"{lost}: {STEPS_IN_JOURNAL}", advice=KEEP_JOURNAL)
        return
    if lost and not structure.channels:  # no writer has begun a recording in it
        return
    findings.note(
        "file",
        f"its writer did not finish it{'' if lost else _UNVERIFIED}",
        RECOVER if lost else "finish it with 'tupli-mcap recover --in-place', or append to it",
    )
    if lost:
        findings.note(
            "journal",
            f"{lost}: steps that were not yet in a chunk are missing",
            "keep a recording and its journal together",
        )


def _lost_journal(source: Source) -> tuple[str, bool]:
    """Why the journal of an unfinished recording cannot be used ("" if it can); whether it is there and unreadable."""
    if source.path is None:
        return "there is no journal beside it", False
    try:
        metadata = head(source)
    except FormatError:
        return "which journal is its own is not known", False
    try:
        place = recorded_journal(source.path, metadata)
    except FormatError as err:
        return f"its journal is not looked for ({err})", False
    try:
        info = journal_info(place)
    except FileNotFoundError:
        return f"there is no journal {f'at {place}' if 'journal' in metadata else 'beside it'}", False
    except (OSError, FormatError) as err:
        return f"its journal cannot be read ({err})", True
    return "" if belongs(info, metadata) else f"{place.name} is the journal of another recording", False


def _contents(source: Source, structure: Structure, findings: Findings, tell: Callable[[int], None]) -> None:
    """Opens the file as a reader does, and checks its contents; tells how many bytes it has read."""
    damaged = len(findings)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", UserWarning)  # about the journal, which has a note
            recording = Recording(source.name if source.path is None else source.path)
    except (FormatError, RecordingError) as err:
        if not damaged:  # otherwise it repeats known damage, or follows from it
            findings.error("layout", str(err))
        return
    recording.file.store.claims = None  # rows that differ from the index are reported one by one
    recording.file.store.tell = tell
    with recording:
        findings.report.attachments = len(recording.attachments)
        _layout(recording, structure, findings)
        with findings.following(structure.missing):
            verify_episodes(recording, findings)
            verify_frames(recording, findings)
        _carried(recording, structure, findings)


def _layout(recording: Recording, structure: Structure, findings: Findings) -> None:
    """Checks that the definitions in the file are those of the spaces."""
    if not recording.num_envs:
        return
    channels = recording.file.contents.channels
    topics = {channel.topic: channel for channel in channels.values()}
    info = topics.get(INFO)
    expected = Container(-1, recording.name, "none")
    vector = recording.num_envs if recording.is_vector else None
    try:
        infos = None if info is None else (InfoCodec.from_metadata(info.metadata).schema()[0], info.metadata)
        png = png_leaves(channels)
        register_channels(expected, recording.name, recording.layout, vector, infos, recording.cameras, png)
    except FormatError as err:
        findings.error("layout", str(err))
        return
    by_topic = {channel.topic: channel for channel in structure.channels.values()}
    # its writer was killed before it had written these: the journal has them, and all of their rows
    in_journal = {channels[number].topic for number in recording.file.contents.undefined}
    for channel in expected.channels.values():
        if channel.topic in in_journal:
            continue
        defined = by_topic.get(channel.topic)
        schema = None if defined is None else structure.schemas.get(defined.schema_id)
        if defined is None or schema is None:
            findings.error("layout", "the channel is not defined in the file", channel=channel.topic)
            continue
        wanted = expected.schemas[channel.schema_id]
        same = (schema.name, schema.encoding, schema.data) == (wanted.name, "ros2msg", wanted.data)
        if not same or defined.message_encoding != "cdr":
            findings.error("layout", "its schema is not that of its spaces", channel=channel.topic)


def _carried(recording: Recording, structure: Structure, findings: Findings) -> None:
    """Checks the attachments: digests of benchmark and artifacts, what is said of runs and episodes, the signature."""
    for name in recording.attachments:
        try:
            if name.startswith(_ARTIFACT):
                found = hashlib.sha256(recording.read_attachment(name)).hexdigest()
                if found != name.removeprefix(_ARTIFACT):
                    findings.error("attachment", f"the artifact {name!r:.90} has the SHA-256 {found}")
            elif name == DOCUMENT_NAME:
                _benchmark(recording, findings)
            elif name in _STATED:
                _STATED[name](recording)
            elif name == SIGNATURE_NAME:
                with findings.following(structure.missing):
                    _signature(recording, structure, findings)
        except TupliError as err:
            with findings.following(structure.missing):  # what is damaged cannot be read either
                findings.error(_KINDS.get(name, "attachment"), str(err))
    if PICKLE_NAME in recording.attachments and DOCUMENT_NAME not in recording.attachments:
        findings.note("benchmark", "it carries a pickled environment without 'benchmark.json'", _FROM_STORAGE)


def _names_pickle(recording: Recording) -> bool:
    """Whether `benchmark.json` names a pickle."""
    try:
        document = json.loads(recording.read_attachment(DOCUMENT_NAME))
        return document["environment"]["pickle"] is not None
    except (ValueError, KeyError, TypeError, RecursionError):
        return False


def _signature(recording: Recording, structure: Structure, findings: Findings) -> None:
    try:
        found = verify_signature(recording, structure)
        known = f"trusted as {found.name}" if found.trusted else "a key that is not trusted here"
        findings.report.signed_by = f"{found.fingerprint} ({known})"
    except MissingExtraError as err:
        findings.note("signature", "it is signed, which was not checked", str(err))
    except SignatureError as err:
        advice = "ask its signer for another copy, or bundle it anew without the signature"
        findings.error("signature", str(err).removeprefix(f"{recording.name}").lstrip(":, "), advice=advice)


def _benchmark(recording: Recording, findings: Findings) -> None:
    if PICKLE_NAME not in recording.attachments and _names_pickle(recording):
        findings.note(
            "benchmark", "the pickled environment that 'benchmark.json' names is missing", _FROM_STORAGE
        )
        return
    record: EnvironmentRecord = recording.benchmark.record  # checks the digests of spec and pickle
    told = record.benchmark or {}
    if "id" in told and told["id"] != recording.benchmark_id:
        why = f"it carries benchmark {told['id']!r:.70}, its episodes are of {recording.benchmark_id!r:.70}"
        findings.error("benchmark", why)
    carried = [name for name in recording.attachments if name.startswith(_ARTIFACT)]
    artifacts = told.get("artifacts", [])
    if not isinstance(artifacts, list):
        findings.error("benchmark", f"expected a list of artifacts, found {artifacts!r:.70}")
        return
    missing = [item for item in artifacts if _ARTIFACT + str(item) not in carried]
    if carried and missing:
        findings.error(
            "benchmark", f"it lacks artifacts of its benchmark: {', '.join(map(str, missing))[:200]}"
        )
