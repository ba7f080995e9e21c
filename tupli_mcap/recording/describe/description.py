"""Facts about a recording that need no step: counts, sizes, spaces, channels."""

from __future__ import annotations

import contextlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import gymnasium as gym
import numpy as np

from tupli_mcap import jsonvalue, signing
from tupli_mcap.arrays import Array, DType
from tupli_mcap.environment import DOCUMENT_NAME
from tupli_mcap.errors import FormatError, plural
from tupli_mcap.journal.file import recorded_journal
from tupli_mcap.mcap.lock import is_locked
from tupli_mcap.messages.episodes import END_NAMES
from tupli_mcap.recording.about.run import Run
from tupli_mcap.recording.about.success import success_of
from tupli_mcap.recording.columns.chunk_store import IN_MEMORY
from tupli_mcap.recording.contents import Contents
from tupli_mcap.recording.describe.series import MOST_INFOS, sampled_infos
from tupli_mcap.recording.recording import Recording
from tupli_mcap.recording.signature_file import SIGNATURE_NAME, Signed
from tupli_mcap.spaces.labels import Labels, element_names
from tupli_mcap.spaces.leaves import Leaf
from tupli_mcap.spaces.statistics import element_bounds

_MOST_BOUNDS = 16  # dimensions of a leaf whose bounds get a line each


class Spread(NamedTuple):
    """Mean, population standard deviation, minimum and maximum of one number of each episode.

    `nan` episodes have no number and are left out; if none has a number, all are NaN.
    """

    mean: float
    std: float
    min: float
    max: float
    nan: int


class ChannelFacts(NamedTuple):
    """A channel: its messages take `size` bytes in memory, `stored` bytes in the file."""

    topic: str
    schema: str
    messages: int
    size: int
    stored: int


@dataclass(frozen=True)
class RecordingDescription:
    """Facts about a recording. Spaces are None without a step, spreads are None without an episode.

    Attributes:
        state: see `state_of`.
        size: of the file (bytes).
        created_ns, start_ns, end_ns: wall clock; the latter two are 0 without an episode.
        environment: the name in its run, else in its benchmark; None if neither has one.
        signed_by: the fingerprint of the key that its signature names, unchecked; None if it is not signed.
        run: the parts of its run, or of the first one, that are known.
        runs: `name`, `split`, number of `episodes` and `metadata` of each run that has some of them.
        made_of: the recordings it was made of; None if it was recorded.
        annotations: who said something (`by`) about how many `episodes`, and when (`at`, ISO 8601 in UTC).
        metadata_keys: keys of the episodes' metadata.
        info_keys: keys of the infos of its steps; of a long recording, of a sample.
        seeds: number of different seeds of its episodes.
        success: the share of the episodes that succeeded, among the `success_known` whose metadata say it; None if
            none do.
        left_out: number of recorded episodes that the file lacks: they were deleted, lost, or not chosen for it. A
            merged recording lacks all that its sources lacked: two parts of one lack the episodes of each other.
        ends: number of episodes by how they ended.
        observation, action: their spaces in lines for people, see `space_lines`; empty without a step.
        compression: bytes of messages for one byte of chunks in the file; None without a chunk.
    """

    name: str
    uuid: str
    state: str
    size: int
    library: str
    created_ns: int
    start_ns: int
    end_ns: int
    benchmark_id: str
    environment: str | None
    signed_by: str | None
    run: dict[str, Any]
    runs: list[dict[str, Any]]
    made_of: dict[str, Any] | None
    annotations: list[dict[str, Any]]
    metadata_keys: list[str]
    info_keys: list[str]
    seeds: int
    success: float | None
    success_known: int
    num_envs: int
    episodes: int
    left_out: int
    steps: int
    ends: dict[str, int]
    lengths: Spread | None
    returns: Spread | None
    observation_space: str | None
    action_space: str | None
    observation: list[str]
    action: list[str]
    compression: float | None
    channels: list[ChannelFacts]
    attachments: list[dict[str, Any]]


def describe(recording: Recording, positions: Array | None = None) -> RecordingDescription:
    """Describes a recording from its summary, its episode index and attachments such as `benchmark.json`.

    Args:
        recording: an open one.
        positions: of the episodes that count for times, ends, steps, lengths, returns, success and metadata keys; all
            by default. Other facts are those of the whole file.

    Raises:
        FormatError: the environment that the recording carries is damaged, or its labels, its annotations, its sources
            or its signature are. (If its runs are, that is a warning.)
    """
    positions = np.arange(len(recording.index)) if positions is None else positions
    said = successes(recording, positions)
    rows, runs = recording.index[positions], _runs(recording, positions)
    run = runs[0][0]
    contents, seeds = recording.file.contents, recording.seeds
    table = contents.table
    chunks = table[table["offset"] < IN_MEMORY]
    stored = int(chunks["length"].sum())
    named = recording.benchmark.record.name if DOCUMENT_NAME in recording.attachments else None
    layout = recording.layout if recording.num_envs else None
    return RecordingDescription(
        name=recording.name,
        uuid=recording.uuid,
        state=state_of(recording),
        size=recording.size,
        library=recording.metadata.get("library", ""),
        created_ns=recording.created_ns,
        start_ns=int(rows["start_time"].min()) if len(rows) else 0,
        end_ns=int(rows["end_time"].max()) if len(rows) else 0,
        benchmark_id=recording.benchmark_id,
        environment=run.environment or named,
        signed_by=claimed_signer(recording),
        run={key: value for key, value in vars(run).items() if value},
        runs=[
            {"name": one.name, "split": one.split, "episodes": count, "metadata": one.metadata}
            for one, count in runs
        ],
        made_of=recording.made_of,
        annotations=_annotations(recording, rows),
        metadata_keys=_metadata_keys(recording, positions),
        info_keys=info_keys(recording, positions),
        seeds=len({seeds[i] for i in positions.tolist()} - {None}),
        success=sum(said) / len(said) if said else None,
        success_known=len(said),
        num_envs=recording.num_envs,
        episodes=len(rows),
        left_out=contents.next_episode - len(recording.index),
        steps=int(rows["length"].sum()),
        ends={name: int((rows["end"] == i).sum()) for i, name in enumerate(END_NAMES)},
        lengths=spread_of(rows["length"]),
        returns=spread_of(rows["return"]),
        observation_space=describe_space(recording.observation_space) if recording.num_envs else None,
        action_space=describe_space(recording.action_space) if recording.num_envs else None,
        observation=space_lines(layout.state, recording.labels, layout.dtypes) if layout else [],
        action=space_lines(layout.action, recording.labels, layout.dtypes) if layout else [],
        compression=int(chunks["uncompressed"].sum()) / stored if stored else None,
        channels=_channels(contents),
        attachments=[info._asdict() for info in recording.attachments.values()],
    )


def state_of(recording: Recording) -> str:
    """The state of the file: "complete"; "recording" while a writer works on it; "unfinished" if its writer did not
    finish it and its journal is there; "incomplete" if its journal is missing."""
    if recording.complete:
        return "complete"
    path = recording.path
    if path is not None and is_locked(path):
        return "recording"
    with contextlib.suppress(FormatError):
        if path is not None and recorded_journal(path, recording.metadata).exists():
            return "unfinished"
    return "incomplete"


def _runs(recording: Recording, positions: Array) -> list[tuple[Run, int]]:
    """The runs of some episodes, each with how many of these it has; without episodes, all runs."""
    runs = recording.readable_runs
    counts = np.bincount(recording.readable_places[positions], minlength=len(runs)).tolist()
    return [pair for pair in zip(runs, counts, strict=True) if pair[1] or not len(positions)]


def _annotations(recording: Recording, rows: Array) -> list[dict[str, Any]]:
    numbers = set(rows["episode"].tolist())
    counts = [(one, len(numbers.intersection(one.episodes))) for one in recording.annotations.said]
    return [{"by": one.by, "at": one.at, "episodes": count} for one, count in counts if count]


def _metadata_keys(recording: Recording, positions: Array) -> list[str]:
    every = recording.all_metadata()
    texts = {every[i] for i in positions.tolist()} - {"{}"}
    return sorted({key for text in texts for key in jsonvalue.loads(text)})


def info_keys(recording: Recording, positions: Array, most: int = MOST_INFOS) -> list[str]:
    """The keys of infos of some episodes, of a sample of about `most` of them; none if they are damaged."""
    with contextlib.suppress(FormatError):  # `verify` names damage; the other facts are known all the same
        return sorted({key for info in sampled_infos(recording, positions, most) for key in info})
    return []


def successes(recording: Recording, positions: Array) -> list[bool]:
    """Whether each episode succeeded; episodes whose metadata have neither `success` nor `is_success` are left out."""
    texts = recording.all_metadata()
    said = []
    for i in positions.tolist():
        if 'success"' not in texts[i]:
            continue
        found = success_of(recording.episode_metadata(i))
        if found is not None:
            said.append(found)
    return said


def describe_space(space: gym.Space[Any]) -> str:
    """A space in one line: `Box(-inf, inf, (4,), float32)`; bounds that differ are shown as their range."""
    if isinstance(space, gym.spaces.Box):
        low, high = _bound(space.low), _bound(space.high)
        return f"Box({low}, {high}, {space.shape}, {space.dtype})"
    if isinstance(space, gym.spaces.Dict):
        return f"Dict({', '.join(f'{key!r}: {describe_space(inner)}' for key, inner in space.items())})"
    if isinstance(space, gym.spaces.Tuple):
        return f"Tuple({', '.join(describe_space(inner) for inner in space)})"
    if isinstance(space, gym.spaces.Text):
        return f"Text({space.min_length}..{space.max_length}, {len(space.character_set)} characters)"
    return " ".join(str(space).split())


def space_lines(leaves: Sequence[Leaf], labels: Labels, stored: Mapping[str, DType]) -> list[str]:
    """A space in lines: one for each leaf, and below it one for each dimension if their bounds differ.

    For example `2 numbers (float32)`, `Cart Position  -4.8 … 4.8`, `Pole Angle     -0.4189 … 0.4189`. `stored` has
    dtypes of leaves by their names, which may differ from the declared ones.
    """
    return [line for leaf in leaves for line in _leaf_lines(leaf, labels, stored.get(leaf.name))]


def _leaf_lines(leaf: Leaf, labels: Labels, stored: DType | None) -> list[str]:
    name = f"{leaf.path}: " if leaf.keys else ""
    if leaf.kind == "variable":
        return [name + describe_space(leaf.space)]
    low, high = element_bounds(leaf)
    if isinstance(leaf.space, gym.spaces.Discrete):
        named = [f"{int(low[0]) + i} {text}" for i, text in enumerate(labels.values.get(leaf.path, ()))]
        return [f"{name}one of {leaf.space.n:,}: {', '.join(named) or _range(low[0], high[0])}"]
    sizes = " x ".join(map(str, leaf.shape)) or "1"
    what = f"{name}{sizes} number{'' if sizes == '1' else 's'}"
    whole = isinstance(leaf.space, gym.spaces.MultiDiscrete | gym.spaces.MultiBinary)
    dtype = leaf.dtype if stored == leaf.dtype else f"{stored}, declared {leaf.dtype}"
    kind = "" if whole else f" ({dtype})"
    if not leaf.size:
        return [what + kind]
    alike = bool((low == low[0]).all() and (high == high[0]).all())
    if alike and leaf.path not in labels.dimensions and _is_unbounded(leaf, low[0], high[0]):
        return [what + kind]
    if leaf.size > _MOST_BOUNDS or (alike and leaf.path not in labels.dimensions):
        between = "," if leaf.size == 1 else ", each" if alike else ", of"
        return [f"{what}{between} {_range(low.min(), high.max())}{kind}"]
    names = element_names(leaf, labels)
    widest = max(map(len, names))
    bounds = map(_range, low, high)
    return [what + kind, *(f"{text:<{widest}}  {ends}" for text, ends in zip(names, bounds, strict=True))]


def _is_unbounded(leaf: Leaf, low: Any, high: Any) -> bool:
    """Whether the bounds are those of the dtype; False for uint8 and int8, whose bounds are always shown."""
    dtype = np.dtype(leaf.dtype)
    if dtype.kind == "f":
        return bool(low == -np.inf and high == np.inf)
    return (
        dtype.kind in "iu"
        and dtype.itemsize > 1
        and (low, high) == (np.iinfo(dtype).min, np.iinfo(dtype).max)
    )


def _range(low: Any, high: Any) -> str:
    return _short(low) if low == high else f"{_short(low)} … {_short(high)}"


def _short(value: Any) -> str:
    return f"{value + 0.0:.4g}" if isinstance(value, np.floating) else str(int(value))  # 0 for -0.0


def _bound(values: Array) -> str:
    if values.size == 0:
        return "-"
    low, high = values.min(), values.max()
    return f"{low:g}" if low == high else f"{low:g}..{high:g}"


def spread_of(values: Array) -> Spread | None:
    """The spread of one number of each episode; None without an episode."""
    if len(values) == 0:
        return None
    numbers = values.astype(np.float64)
    none = np.isnan(numbers)
    numbers = numbers[~none] if not none.all() else numbers
    with np.errstate(invalid="ignore", over="ignore"):  # infinite returns have no spread
        mean, std, least, most = map(float, (numbers.mean(), numbers.std(), numbers.min(), numbers.max()))
    return Spread(mean, std, least, most, int(none.sum()))


def by_scale(sizes: Sequence[float], ratio: float, most: int) -> list[list[int]]:
    """Groups of dimensions that may share an axis: within `ratio` of the largest, at most `most` together.

    Dimensions that are always zero go with the smallest others. Groups and dimensions keep their order.
    """
    groups: list[list[int]] = []
    for i in sorted(range(len(sizes)), key=lambda i: -sizes[i]):
        largest = sizes[groups[-1][0]] if groups else 0.0
        if groups and len(groups[-1]) < most and (sizes[i] == 0 or sizes[i] * ratio >= largest):
            groups[-1].append(i)
        else:
            groups.append([i])
    return sorted(sorted(group) for group in groups)


def nan_text(count: int, episodes: int) -> str:
    """Says for people how many of the episodes have NaN; empty if none has."""
    if not count:
        return ""
    return "NaN in every episode" if count == episodes else f"NaN in {plural(count, 'episode')}, left out"


def _channels(contents: Contents) -> list[ChannelFacts]:
    facts = []
    for channel in contents.channels.values():
        chunks = contents.table[contents.table["channel"] == channel.id]
        schema = contents.schemas.get(channel.schema_id)
        rows, size = int(chunks["rows"].sum()), int(chunks["uncompressed"].sum())
        stored = int(chunks["length"][chunks["offset"] < IN_MEMORY].sum())
        facts.append(ChannelFacts(channel.topic, "" if schema is None else schema.name, rows, size, stored))
    return facts


def claimed_signer(recording: Recording) -> str | None:
    """The fingerprint of the key that a recording's signature names, unchecked; None if it is not signed. Raises
    FormatError if the signature cannot be decoded."""
    if SIGNATURE_NAME not in recording.attachments:
        return None
    signed = Signed.decode(recording.read_attachment(SIGNATURE_NAME), recording.name)
    return signing.fingerprint(signed.public_key)
