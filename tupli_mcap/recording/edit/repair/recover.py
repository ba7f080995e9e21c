"""`recover_recording` writes everything good in a damaged recording to a new one, and reports what was lost."""

from __future__ import annotations

import contextlib
import os
import shlex
from collections.abc import Callable
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

from tupli_mcap import files
from tupli_mcap.errors import (
    FormatError,
    MissingExtraError,
    RecordingError,
    SignatureError,
    os_reason,
    taken,
)
from tupli_mcap.mcap.container import Container
from tupli_mcap.mcap.lock import is_locked
from tupli_mcap.mcap.records import MAGIC, OTHER_TOOLS
from tupli_mcap.mcap.source import PathSource, Source
from tupli_mcap.mcap.walk import attachment_name
from tupli_mcap.messages.step import StepLayout
from tupli_mcap.progress import progress
from tupli_mcap.recording.check.signature import verify_signature
from tupli_mcap.recording.contents import step_channels
from tupli_mcap.recording.edit.assemble import replacing
from tupli_mcap.recording.edit.repair.write import RepairWriter
from tupli_mcap.recording.index import INDEX_NAME
from tupli_mcap.recording.recording import Recording
from tupli_mcap.recording.recover.damaged import gather, is_recording, may_be_recording, read_file_end
from tupli_mcap.recording.recover.episodes import Plan, losses, make_plan
from tupli_mcap.recording.recover.evidence import Evidence, PackedStore, RecordedChannels
from tupli_mcap.recording.recover.from_journal import add_journal
from tupli_mcap.recording.signature_file import SIGNATURE_NAME, is_covered_kind
from tupli_mcap.recording.write.options import RecordOptions, check_name
from tupli_mcap.recording.write.writer import finish_in_place
from tupli_mcap.remote import path_of


class DamagedPlace(NamedTuple):
    """`size` bytes from `offset` on that are damaged, and why."""

    offset: int
    size: int
    why: str


class LostSteps(NamedTuple):
    """Steps `first:stop` of an episode, as numbered in the damaged file; `stop` is None if its length is not known."""

    episode: int
    first: int
    stop: int | None


class CutEpisode(NamedTuple):
    """A part of an episode that lost steps: `steps` from `first_step` on are episode `becomes` in the new file."""

    episode: int
    first_step: int
    steps: int
    becomes: int


@dataclass
class RecoveryReport:
    """What was found in a file, what was saved, and what was lost.

    Attributes:
        target: the new file; None if none was written.
        finished: the file has its end.
        journal: "none", "used", "missing", "damaged" or "stale".
        episodes, steps, messages, attachments: how many were saved; a part of an episode that was cut is an episode.
        episodes_lost: number of episodes of which nothing was saved.
        steps_lost: how many steps are known to be lost.
        attachments_lost: their names.
        lost: which steps are lost, by episode.
        cut: the parts of episodes that lost steps.
        starts_lost, ends_lost, final_states_lost: numbers of the episodes, as in the damaged file.
        infos_lost, frames_lost: how many are known to be lost.
        damaged: the damaged places of the file.
        notes: sentences for people on what else was found.
    """

    source: str
    target: str | None = None
    finished: bool = True
    journal: str = "none"
    episodes: int = 0
    steps: int = 0
    messages: int = 0
    attachments: int = 0
    episodes_lost: int = 0
    steps_lost: int = 0
    attachments_lost: list[str] = field(default_factory=list)
    lost: list[LostSteps] = field(default_factory=list)
    cut: list[CutEpisode] = field(default_factory=list)
    starts_lost: list[int] = field(default_factory=list)
    ends_lost: list[int] = field(default_factory=list)
    final_states_lost: list[int] = field(default_factory=list)
    infos_lost: int = 0
    frames_lost: int = 0
    damaged: list[DamagedPlace] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)

    @property
    def bytes_skipped(self) -> int:
        """Number of damaged bytes in the file."""
        return sum(place.size for place in self.damaged)

    @property
    def saved(self) -> bool:
        """Whether anything could be saved; of a damaged recording, at least one step."""
        journal_lost = self.journal not in ("none", "used")
        if self.steps_lost or self.lost or self.damaged or journal_lost:
            return self.steps > 0
        return bool(self.messages or self.attachments)

    @property
    def intact(self) -> bool:
        """Whether nothing was wrong with the file."""
        return self.finished and not (self.damaged or self.notes or self.lost or self.steps_lost)

    def to_json(self) -> dict[str, Any]:
        """The report as a JSON value."""
        plain = asdict(self)
        for name in ("lost", "cut", "damaged"):
            plain[name] = [item._asdict() for item in getattr(self, name)]
        facts = {"bytes_skipped": self.bytes_skipped, "saved": self.saved, "intact": self.intact}
        return {**plain, **facts}


def recovered_path(source: Path) -> Path:
    """The default path of a repaired file: `<name>.recovered.mcap` beside the damaged one."""
    return source.with_name(f"{source.name.removesuffix('.mcap')}.recovered.mcap")


def recover_recording(
    source: str | os.PathLike[str],
    target: str | os.PathLike[str] | None = None,
    *,
    overwrite: bool = False,
    dry_run: bool = False,
    compression: str = "zstd",
) -> RecoveryReport:
    """Writes everything good in a recording into a new one. The source is only read.

    An episode that lost steps in between becomes several episodes of consecutive steps (`schemas/README.md`, Repair).
    Nothing in the file is executed.

    Args:
        source: the damaged recording.
        target: `<name>.recovered.mcap` beside the source by default.
        overwrite: whether an existing target may be replaced (in one rename).
        dry_run: only reports.
        compression: "zstd", "lz4" or "none".

    Raises:
        RecordingError: the source cannot be opened, a writer works on it, or the target exists or cannot be written.
        FormatError: the source is no recording, or nothing can be read from it.
    """
    path = path_of(source)
    check_name(recovered_path(path) if target is None else target)
    goal = recovered_path(path) if target is None else Path(target)
    try:
        _check(path, goal, overwrite=overwrite)
    except OSError as err:
        raise RecordingError(f"{path} cannot be recovered to {goal}: {os_reason(err)}") from err
    with contextlib.closing(PathSource(path)) as opened:
        if dry_run:
            with Path(os.devnull).open("wb") as nowhere:
                return _recover(opened, nowhere.fileno(), goal, compression)
        with contextlib.suppress(_NothingSavedError), replacing(goal, overwrite=overwrite) as (fd, temporary):
            report = _recover(opened, fd, goal, compression)
            if not _signature_fits(temporary):
                os.ftruncate(fd, 0)
                report = _recover(opened, fd, goal, compression, signed=False)
            if not (report.saved or report.attachments):
                raise _NothingSavedError
            report.target = str(goal)
        return report


class _NothingSavedError(Exception):
    """Keeps a file that would hold nothing from its path."""


def _check(path: Path, goal: Path, *, overwrite: bool) -> None:
    if is_locked(path):
        raise RecordingError(f"{path} is being recorded; close its writer first, then recover it")
    if files.is_same(goal, path):
        raise RecordingError(f"{path} is never overwritten; give another file to write to")
    if goal.exists() and not overwrite:
        raise RecordingError(taken(goal))


def _signature_fits(path: Path) -> bool:
    """Whether the signature fits the written file; True if it is not signed."""
    with Recording(path) as recording:
        if SIGNATURE_NAME not in recording.attachments:
            return True
        try:
            verify_signature(recording)
        except (SignatureError, FormatError, MissingExtraError):
            return False
    return True


def finish_recording(path: str | os.PathLike[str], *, dry_run: bool = False) -> RecoveryReport:
    """Finishes a recording that its writer did not finish, in place, as a writer that appends would.

    A finished recording stays as it is. So does one that lost something: use `recover_recording` for it. `dry_run`
    only reports.

    Raises:
        RecordingError: something in it is lost or damaged, a writer works on it, or it cannot be written.
        FormatError: it is no recording.
    """
    report = recover_recording(path, dry_run=True, overwrite=True)  # whatever lies beside it
    if report.damaged and not report.bytes_skipped:  # killed while it wrote the end, which holds no data
        report.finished, report.damaged = False, []
    if report.lost or report.damaged or report.notes or report.journal not in ("none", "used"):
        raise RecordingError(
            f"{path}: something in it is lost or damaged, so it is not changed; save what is good in a new file: "
            f"tupli-mcap recover {shlex.quote(str(path))}"
        )
    if not dry_run:
        if not report.finished:
            finish_in_place(Path(path), RecordOptions(mode="a"))
        report.target = str(path)
    return report


def _recover(source: Source, fd: int, goal: Path, compression: str, *, signed: bool = True) -> RecoveryReport:
    """Writes what is good in a recording, without the signature if it is known not to fit (not `signed`)."""
    if not source.size:
        raise FormatError(f"{source.name} is empty: nothing can be saved from it; delete it")
    file_end = read_file_end(source)
    # every chunk is read twice: to find what is good, and to copy it
    with progress(2 * source.size, f"recovering {source.name}") as bar:
        evidence = gather(source, file_end, bar.advance) if may_be_recording(source, file_end) else None
        if evidence is None or not is_recording(evidence):
            raise FormatError(f"{source.name} holds nothing of a tupli_mcap recording ({OTHER_TOOLS})")
        add_journal(evidence)
        container = Container(fd, str(goal), compression)
        return _recover_ours(evidence, _layout(evidence), container, bar.advance, signed=signed)


def _layout(evidence: Evidence) -> tuple[StepLayout, RecordedChannels] | None:
    """The layout and the channels; None if the recording has no step channel and no rows. FormatError if the spaces are
    lost, so that its rows cannot be understood."""
    name = evidence.source.name
    advice = 'nothing can be saved as a recording ("mcap recover" copies the messages as they are)'
    try:
        steps = step_channels(evidence.channels, name)
        if steps:
            layout = StepLayout.from_metadata(steps[0].metadata)
            return layout, RecordedChannels.of(evidence, layout)
    except FormatError as err:
        raise FormatError(f"{name}: the spaces of the recording are damaged ({err}); {advice}") from err
    if evidence.pieces:
        raise FormatError(f"{name}: the spaces of the recording are lost; {advice}")
    return None


def _recover_ours(
    evidence: Evidence,
    known: tuple[StepLayout, RecordedChannels] | None,
    container: Container,
    tell: Callable[[int], None],
    *,
    signed: bool,
) -> RecoveryReport:
    report = RecoveryReport(
        evidence.source.name,
        finished=evidence.file_end.finished,
        journal=evidence.journal,
        notes=[*evidence.file_end.why, *evidence.notes],
    )
    writer, attachments_lost = RepairWriter(container, evidence), _attachments_lost(evidence)
    if not signed or any(map(is_covered_kind, attachments_lost)):
        _leave_out_signature(report, evidence)
    if known is None:
        writer.begin(None)
    else:
        layout, channels = known
        store = PackedStore(evidence)
        store.tell = tell
        plan = make_plan(evidence, store, layout, channels)
        _report_plan(report, plan)
        if report.lost:
            _leave_out_signature(report, evidence)
        writer.begin(plan.next_episode)
        writer.steps(layout, channels, plan, store)
        report.infos_lost, report.frames_lost = writer.infos_lost, writer.frames_lost
    writer.finish()
    if evidence.metadata is None:
        report.notes.append("the recording's metadata are lost: it has a new uuid and names no benchmark")
    elif writer.metadata_lost:
        report.notes.append(f"of the recording's metadata, {', '.join(writer.metadata_lost)} are lost")
    places = [DamagedPlace(d.offset, d.end - d.offset, d.why) for d in evidence.damages]
    report.damaged = [*_ends(evidence), *places]
    report.messages = sum(container.counts.values())
    report.attachments = len(container.attachment_indexes) - 1
    report.attachments_lost = attachments_lost
    return report


def _leave_out_signature(report: RecoveryReport, evidence: Evidence) -> None:
    if evidence.attachments.pop(SIGNATURE_NAME, None) is not None:
        report.notes.append("its signature is left out: it does not fit what could be saved")


def _report_plan(report: RecoveryReport, plan: Plan) -> None:
    kept = {episode.run.episode for episode in plan.episodes}
    lost, report.steps_lost = losses(plan)
    report.episodes, report.steps = len(plan.episodes), sum(e.run.steps for e in plan.episodes)
    report.lost = [LostSteps(n, *steps) for n, ranges in sorted(lost.items()) for steps in ranges]
    report.episodes_lost = len(set(lost) - kept)
    report.cut = [
        CutEpisode(e.run.episode, e.run.step, e.run.steps, e.number) for e in plan.episodes if not e.whole
    ]
    report.starts_lost, report.ends_lost = plan.lost_starts, plan.lost_ends
    report.final_states_lost = plan.lost_finals


def _attachments_lost(evidence: Evidence) -> list[str]:
    """Names of the attachments that are lost, as far as the file shows."""
    summary = evidence.file_end.summary
    known = set() if summary is None else set(summary.attachments)
    known |= {attachment_name(evidence.source, damage) or INDEX_NAME for damage in evidence.damages}
    return sorted(known - set(evidence.attachments) - {INDEX_NAME})


def _ends(evidence: Evidence) -> list[DamagedPlace]:
    """Damage of the magic at the start and of the end of the file, which hold no data."""
    source, file_end = evidence.source, evidence.file_end
    places = []
    if source.read(0, min(len(MAGIC), source.size)) != MAGIC:
        places.append(DamagedPlace(0, min(len(MAGIC), source.size), "expected the magic of MCAP"))
    if file_end.finished and file_end.summary is None and not file_end.why:
        places.append(DamagedPlace(source.size, 0, "the footer is damaged or cut off"))
    return places
