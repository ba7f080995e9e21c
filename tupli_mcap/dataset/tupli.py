"""`TupliDataset`: episodes and steps chosen by filters, as arrays."""

from __future__ import annotations

import copy
import os
from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import TYPE_CHECKING, Any, ClassVar, Self

import numpy as np

from tupli_mcap.arrays import Array, map_arrays
from tupli_mcap.dataset import display
from tupli_mcap.dataset.access import RandomAccess
from tupli_mcap.dataset.columns import convert
from tupli_mcap.dataset.columns.convert import BaseTupleParser, NumpyTupleParser
from tupli_mcap.dataset.columns.load import TupleFilter, TupleSelector
from tupli_mcap.dataset.columns.saved import save_columns
from tupli_mcap.dataset.columns.tuples import TupleMaker, episode_items
from tupli_mcap.dataset.dataset import Dataset
from tupli_mcap.dataset.items import FIELDS, MemorySteps, Steps
from tupli_mcap.dataset.items.beside import FrameValues
from tupli_mcap.dataset.items.recorded import cache_options
from tupli_mcap.dataset.sources import DatasetError, EpisodeSource, FilesSource, StorageSource, checked_whole
from tupli_mcap.dataset.which import as_filter, text_of
from tupli_mcap.messages.step import StepLayout
from tupli_mcap.recording.columns.fields import FIVE, GymnasiumNames
from tupli_mcap.schema import BaseFilter, BenchmarkHeader, EpisodeHeader, EpisodeItem, F, RLTuple, check_keys
from tupli_mcap.storage import TupliStorage, storage_at
from tupli_mcap.storage.base import anew

if TYPE_CHECKING:
    import pandas as pd

SIX = (*FIVE, "infos")


class TupliDataset(RandomAccess, GymnasiumNames):
    """Episodes of a storage (or of files, see `from_files`), and the steps in them, as filters choose them.

    A dataset reads on access, and only what is requested. Its filters never change: `with_benchmark_filter`,
    `with_episode_filter` and `with_tuple_filter` return another dataset, which lists its own episodes and where the
    new filter holds beside the earlier ones (None removes those of its kind).

    The episodes are listed once, and all results agree with that list until `preview()` or `load()` list them
    anew. Properties keep the columns they have read, as read-only arrays; the `convert_to_…` methods return
    arrays that the caller may change, and keep nothing but what `load()` has read before.

    A column is an array of shape (steps, ...) in the recorded dtype, a list with a value for each step if
    values differ in size (texts, graphs), or dicts and tuples of those, nested as the environment's
    space is. Recordings may differ in dtype if one dtype holds the values of both exactly. Not
    thread-safe.

    Args:
        storage: where the episodes are: a storage, or the path of its directory.
        info: anything to keep with the dataset.

    Raises:
        StorageError: there is no storage at the path.
    """

    _elsewhere: ClassVar = {
        name: f"its dataset has it: .dataset.{name}" for name in dir(Dataset) if not name.startswith("_")
    }

    def __init__(
        self, storage: TupliStorage | str | os.PathLike[str], info: dict[str, Any] | None = None
    ) -> None:
        self._setup(StorageSource(storage_at(storage, existing=True)), info)

    @classmethod
    def from_files(
        cls,
        files: str | os.PathLike[str] | Iterable[str | os.PathLike[str]],
        info: dict[str, Any] | None = None,
    ) -> Self:
        """A dataset of recordings outside of a storage: a file, a directory, a pattern, a URL, or several of those.

        An episode that is in two of the files counts once, with a warning; one that is still being recorded
        is listed as interrupted.

        Raises:
            RecordingError: there is no such file.
        """
        made = cls.__new__(cls)
        made._setup(FilesSource(files), info)
        return made

    def _setup(self, source: StorageSource | FilesSource, info: dict[str, Any] | None) -> None:
        self.info = info
        self._source = source
        self._episode_filter: BaseFilter | None = None
        self._selector: TupleSelector | None = None
        self._cache: dict[str, int] = {}  # arguments of `RecordedSteps`
        self._begin()
        self.set_seed(None)

    def _begin(self) -> None:
        self._listing = _Listing(self._unlisted())
        self._benchmarks: list[BenchmarkHeader] | None = None

    def _unlisted(self) -> Dataset:
        """The episodes and steps that the filters choose, which it lists when it is asked."""
        made = Dataset(self._source)
        made._filter, made._selector, made._cache = self._episode_filter, self._selector, self._cache
        by = (self._source.benchmark_filter, self._episode_filter)
        made.chosen_by = tuple(text_of(each) for each in by if each is not None)
        return made

    @property
    def storage(self) -> TupliStorage | None:
        """The storage; None for a dataset of files."""
        return self._source.storage if isinstance(self._source, StorageSource) else None

    @property
    def dataset(self) -> Dataset:
        """Its episodes as a `Dataset`, as they are listed now, with the steps that the tuple filter chooses."""
        self.preview()
        return self._listing.dataset

    # --- filters ---

    def with_benchmark_filter(self, filter: BaseFilter | F | str | None) -> Self:
        """The dataset with a further benchmark filter, over the fields of `BenchmarkHeader`; None removes all.

        Raises:
            FilterError: the filter names an unknown field.
        """
        source = copy.copy(self._source)
        source.benchmark_filter = _both(source.benchmark_filter, filter, BenchmarkHeader)
        return self._with(_source=source)

    def with_episode_filter(self, filter: BaseFilter | F | str | None) -> Self:
        """The dataset with a further episode filter, over the fields of `EpisodeHeader` (`metadata.score`,
        `n_tuples`, `end`, …); None removes all.

        Raises:
            FilterError: the filter names an unknown field. Metadata that no episode has are found out, and raise it, as
                soon as the episodes are listed.
        """
        return self._with(_episode_filter=_both(self._episode_filter, filter, EpisodeHeader))

    def with_tuple_filter(self, filter_fcn: TupleFilter | F | str | None) -> Self:
        """The dataset with a further tuple filter, which chooses steps like `Dataset.filter_steps`; None removes all.

        Raises:
            FilterError: it is no expression, text or function, or names an unknown field.
        """
        selector = None if filter_fcn is None else TupleSelector(as_filter(filter_fcn))
        if self._selector is not None and selector is not None:
            selector = self._selector & selector
        return self._with(_selector=selector)

    def _with(self, **changes: Any) -> Self:
        made = copy.copy(self)
        made.__dict__.update(changes)
        made._begin()
        made.set_seed(self._seed)
        return made

    def with_cache(self, cache_bytes: int, threads: int | None = None) -> Self:
        """The dataset with another budget for the cache of random access (bytes, 512 MiB by default).

        `threads` read chunks; by default as many as there are cores, at most 4.

        Raises:
            SamplingError: a number is no integer, or too small.
        """
        return self._with(_cache={**self._cache, **cache_options(cache_bytes, threads)})

    # --- listing and loading ---

    def preview(self) -> list[EpisodeHeader]:
        """Lists the episodes again; reads no step."""
        before, listed = self._listing.dataset, self._unlisted()
        if before._listed is not None and _identity(before.headers) == _identity(listed.headers):
            listed._known, listed._steps = before._known, before._steps
            self._listing.dataset = listed
        else:
            self._listing = _Listing(listed)
        self._benchmarks = None
        return list(listed.headers)

    def load(self) -> None:
        """List the episodes again and read their steps (states, actions, rewards, terminals, timeouts) into
        memory.

        Raises:
            SpaceError: one array cannot hold the steps of two recordings; the message names them.
        """

        def attempt() -> None:
            self.preview()
            self._listing.dataset._steps = None  # of files that may have been written anew
            self._listing.read(FIVE)

        anew(attempt)  # again if episodes are deleted while they are read: the next listing lacks them

    def save_columns(self, directory: str | os.PathLike[str]) -> None:
        """Writes the steps, as they are listed now, to an unused directory; see `Dataset.save_columns`."""
        save_columns(directory, self.steps, self._headers, self._step_seconds())

    # --- contents ---

    @property
    def steps(self) -> Steps:
        """The steps that the filters choose by number, from 0; windows and samplers read them."""
        return self._listing.steps

    @property
    def _headers(self) -> Sequence[EpisodeHeader]:
        return self._listing.dataset.headers

    def _episodes(self, filter: BaseFilter | None) -> tuple[EpisodeSource, Sequence[EpisodeHeader]]:
        """The source that opens its recordings, and its episodes, listed again, that also match the filter."""
        return self._source, (self if filter is None else self.with_episode_filter(filter)).preview()

    def _step_seconds(self) -> float | None:
        return self._listing.dataset._step_seconds()

    @property
    def benchmarks(self) -> list[BenchmarkHeader]:
        """The benchmarks that match the benchmark filter."""
        if self._benchmarks is None:
            self._benchmarks = self._source.benchmarks()
        return list(self._benchmarks)

    @property
    def episodes(self) -> Sequence[EpisodeItem]:
        """The episodes with those of their steps that match the tuple filter; each is made on access.

        Steps are read at the first access to an item. For facts about episodes alone, use `preview()`.
        """
        listing = self._listing
        return episode_items(
            listing.dataset.headers, lambda: (listing.read(SIX), listing.dataset.lengths, listing.layout)
        )

    @property
    def tuples(self) -> Sequence[RLTuple]:
        """The steps; each is made on access."""
        return TupleMaker(self._listing.read(SIX), self._listing.layout).all()

    @property
    def states(self) -> Any:
        """The state of each step, the observation its action was chosen on: a read-only column."""
        return self._listing.read(["states"])["states"]

    @property
    def next_states(self) -> Any:
        """The state after each step, never one of another episode: a read-only column.

        If it was not recorded (the last step of an episode made from values), it is the step's own state.
        """
        return self._listing.read(["next_states"])["next_states"]

    @property
    def actions(self) -> Any:
        """The action of each step: a read-only column."""
        return self._listing.read(["actions"])["actions"]

    @property
    def rewards(self) -> Any:
        """The reward of each step: a read-only column, float64 unless there is a reward space."""
        return self._listing.read(["rewards"])["rewards"]

    @property
    def terminals(self) -> np.ndarray[Any, np.dtype[np.bool_]]:
        """Whether the environment ended with the step: read-only, bool."""
        found: np.ndarray[Any, np.dtype[np.bool_]] = self._listing.read(["terminals"])["terminals"]
        return found

    @property
    def timeouts(self) -> np.ndarray[Any, np.dtype[np.bool_]]:
        """Whether the episode was truncated with the step, as recorded: read-only, bool."""
        found: np.ndarray[Any, np.dtype[np.bool_]] = self._listing.read(["timeouts"])["timeouts"]
        return found

    @property
    def infos(self) -> list[dict[str, Any]]:
        """The info of each step; an empty dict where none was recorded."""
        return list(self._listing.read(["infos"])["infos"])

    def _infos(self) -> Sequence[Mapping[str, Any]]:
        return self.infos

    def _frames(self) -> FrameValues:
        return self._listing.dataset._frames()

    def __len__(self) -> int:
        """The number of steps, after all filters; with a tuple filter, this evaluates it."""
        return self._listing.dataset.n_steps

    def __iter__(self) -> Iterator[RLTuple]:
        return iter(self.tuples)

    # --- conversions ---

    def convert_to_numpy(self, *, mark_cuts: bool = True) -> tuple[Any, Any, Any, Any, Any]:
        """States, actions, rewards, terminals and timeouts as columns of NumPy arrays; the caller may change
        them.

        Args:
            mark_cuts: also set the timeout of a step that is not followed by its own episode's next step: the
                last one of an interrupted episode, or the one before steps that a tuple filter left out.
                Otherwise learners that find episodes by their flags (d3rlpy, D4RL) would join two episodes.
                False returns the recorded flags.
        """
        columns = self._listing.own(FIVE)
        if mark_cuts:
            convert.mark_cuts(columns, self._listing.dataset._selected)
        return (
            columns["states"],
            columns["actions"],
            columns["rewards"],
            columns["terminals"],
            columns["timeouts"],
        )

    def convert_to_tensors(
        self, parser: type[BaseTupleParser] = NumpyTupleParser, *, mark_cuts: bool = True
    ) -> tuple[Any, ...]:
        """The five columns of `convert_to_numpy` in the form of a parser.

        Raises:
            MissingExtraError: the library the parser needs is not installed.
            DatasetError: the parser is none.
        """
        return _checked_parser(parser).parse_lists(*self.convert_to_numpy(mark_cuts=mark_cuts))

    def convert_to_d4rl_format(self, *, mark_cuts: bool = True) -> dict[str, Any]:
        """Columns named as in D4RL: observations, actions, next_observations, rewards, terminals, timeouts.

        `next_observations` are `next_states`; `terminals` are true terminals only. `mark_cuts` is that of
        `convert_to_numpy`.
        """
        columns = self._listing.own((*FIVE, "next_states"))
        if mark_cuts:
            convert.mark_cuts(columns, self._listing.dataset._selected)
        return {name: columns[field] for name, field in convert.D4RL_NAMES.items()}

    def convert_to_dataframe(self) -> pd.DataFrame:
        """A pandas DataFrame with a row for each step: the episode (its position in `preview()`), the step (from
        0 in its episode), and the columns of `convert_to_d4rl_format` with the recorded flags.

        Columns of numbers keep their dtype; a value of several numbers is one object in its cell.

        Raises:
            MissingExtraError: pandas is not installed.
        """
        convert.import_pandas()
        columns = self._listing.own((*FIVE, "next_states", "steps"))
        return convert.dataframe(columns, self._listing.dataset._selected)

    # --- batches and samples ---

    def set_seed(self, seed: int | None) -> None:
        """Seed the draws of `as_batch_generator` and `sample_episodes`, and no others.

        Datasets derived from this one by filters start from the same seed. None takes a random seed.

        Raises:
            DatasetError: it is no integer from 0.
        """
        self._seed = None if seed is None else checked_whole(seed, 0, "a seed")
        self._random = np.random.default_rng(self._seed)

    def as_batch_generator(
        self, batch_size: int, shuffle: bool = False, parser: type[BaseTupleParser] | None = None
    ) -> Iterator[Any]:
        """Batches of `batch_size` steps; the last one may have fewer. The steps are loaded first.

        Args:
            shuffle: in a new random order each time, see `set_seed`.
            parser: turns the five columns of each batch into its form; without one, a batch is a list of `RLTuple`.

        Raises:
            DatasetError: the batch size is no integer from 1, or the parser is none.
        """
        size = checked_whole(batch_size, 1, "a batch size")
        if parser is not None:
            _checked_parser(parser)
        columns = self._listing.read(FIVE if parser else SIX)
        order = self._random.permutation(len(columns["terminals"])) if shuffle else None
        return convert.batches(columns, self._listing.layout, size, order, parser)

    def sample_episodes(self, n_samples: int) -> list[EpisodeItem]:
        """Up to `n_samples` different episodes, drawn at random, with all their steps: the tuple filter does not
        apply.

        Only their steps are read. See `set_seed`.

        Raises:
            DatasetError: the number is no integer from 0.
        """
        headers = self._headers
        n = min(checked_whole(n_samples, 0, "a number of episodes"), len(headers))
        drawn = self._random.choice(len(headers), n, replace=False)
        sample = Dataset(self._source, [headers[i] for i in drawn])
        columns, layout = sample._read(SIX)
        return list(episode_items(sample.headers, lambda: (columns, sample.lengths, layout)))

    # --- display ---

    def _facts(self) -> display.Facts:
        facts = self._listing.dataset._facts()
        filters = {"benchmarks": self._source.benchmark_filter, "episodes": self._episode_filter}
        return facts._replace(filters={**filters, **facts.filters})

    def __repr__(self) -> str:
        return display.text(type(self).__name__, self._facts())

    def _repr_html_(self) -> str:
        _ = self._headers
        return display.html(type(self).__name__, self._facts())


class _Listing:
    """A dataset that lists its episodes once, and the columns of its steps that were read so far.

    `layout` is that of the first recording; None before a column is read.
    """

    def __init__(self, dataset: Dataset) -> None:
        self.dataset = dataset
        self.layout: StepLayout | None = None
        self._columns: dict[str, Any] = {}

    def __getstate__(self) -> dict[str, Any]:
        # A copy reads the same episodes itself; a layout cannot be pickled.
        return {"dataset": self.dataset, "layout": None, "_columns": {}}

    @property
    def steps(self) -> Steps:
        """The wanted steps by number: from columns in memory, else from the recordings, on access."""
        loaded = {field: column for field, column in self._columns.items() if field in FIELDS}
        return MemorySteps(loaded, self.dataset.steps) if loaded else self.dataset.steps

    def read(self, fields: Sequence[str]) -> dict[str, Any]:
        """Columns by field, read-only; they are kept."""
        if missing := [field for field in fields if field not in self._columns]:
            found, self.layout = self.dataset._read(missing)
            self._columns |= {field: map_arrays(column, _frozen, list) for field, column in found.items()}
        return {field: self._columns[field] for field in fields}

    def own(self, fields: Sequence[str]) -> dict[str, Any]:
        """Columns by field that the caller may change; those that have to be read for this are not kept."""
        kept = {field: self._columns[field] for field in fields if field in self._columns}
        missing = [field for field in fields if field not in kept]
        copies = {field: map_arrays(column, np.copy, copy.deepcopy) for field, column in kept.items()}
        return {**copies, **(self.dataset._read(missing)[0] if missing else {})}


def _identity(headers: Sequence[EpisodeHeader]) -> list[tuple[str, int, str]]:
    """The facts that the columns of some episodes depend on."""
    return [(header.id, header.n_tuples, header.recording) for header in headers]


def _frozen(array: Array) -> Array:
    array.flags.writeable = False
    return array


def _both(
    own: BaseFilter | None, further: BaseFilter | F | str | None, model: type[BenchmarkHeader | EpisodeHeader]
) -> BaseFilter | None:
    """A filter that holds where both do; None if the further one is None. FilterError if it is none of the model."""
    if further is None:
        return None
    wanted: BaseFilter = as_filter(further)
    check_keys(wanted, model)
    return wanted if own is None else own & wanted


def _checked_parser(parser: Any) -> type[BaseTupleParser]:
    """The parser. DatasetError if it is none."""
    if not hasattr(parser, "parse_lists"):
        raise DatasetError(f"expected a parser, such as TorchTupleParser, found {parser!r:.80}")
    found: type[BaseTupleParser] = parser
    return found
