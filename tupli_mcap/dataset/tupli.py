"""`TupliDataset`: episodes and steps chosen by filters, as arrays."""

from __future__ import annotations

import os
from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import TYPE_CHECKING, Any, ClassVar, Self

import numpy as np

from tupli_mcap.dataset import display
from tupli_mcap.dataset.access import RandomAccess
from tupli_mcap.dataset.columns import convert
from tupli_mcap.dataset.columns.convert import BaseTupleParser, NumpyTupleParser
from tupli_mcap.dataset.columns.load import TupleFilter, read_columns
from tupli_mcap.dataset.columns.saved import save_columns
from tupli_mcap.dataset.columns.tuples import EpisodeItems, Tuples
from tupli_mcap.dataset.dataset import Dataset
from tupli_mcap.dataset.items import Steps
from tupli_mcap.dataset.items.recorded import cache_options
from tupli_mcap.dataset.query import Query
from tupli_mcap.dataset.sources import DatasetError, EpisodeSource, FilesSource, StorageSource, checked_whole
from tupli_mcap.dataset.which import as_filter, text_of
from tupli_mcap.recording.columns.fields import FIVE, GymnasiumNames
from tupli_mcap.schema import BaseFilter, BenchmarkHeader, EpisodeHeader, EpisodeItem, F, RLTuple
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
        self._query = Query(source)
        self.set_seed(None)

    @property
    def storage(self) -> TupliStorage | None:
        """The storage; None for a dataset of files."""
        source = self._query.source
        return source.storage if isinstance(source, StorageSource) else None

    @property
    def dataset(self) -> Dataset:
        """Its episodes as a `Dataset`, as they are listed now, with the steps that the tuple filter chooses."""
        source, headers = self._episodes(None)
        made = Dataset(source, headers)
        by = (self._query.benchmark_filter, self._query.episode_filter)
        made.chosen_by = tuple(text_of(each) for each in by if each is not None)
        made._selector, made._cache = self._query.tuple_filter, self._query.cache
        return made

    # --- filters ---

    def with_benchmark_filter(self, filter: BaseFilter | F | str | None) -> Self:
        """The dataset with a further benchmark filter, over the fields of `BenchmarkHeader`; None removes all.

        Raises:
            FilterError: the filter names an unknown field.
        """
        return self._with(benchmark_filter=filter)

    def with_episode_filter(self, filter: BaseFilter | F | str | None) -> Self:
        """The dataset with a further episode filter, over the fields of `EpisodeHeader` (`metadata.score`,
        `n_tuples`, `end`, …); None removes all.

        Raises:
            FilterError: the filter names an unknown field. Metadata that no episode has are found out, and raise it, as
                soon as the episodes are listed.
        """
        return self._with(episode_filter=filter)

    def with_tuple_filter(self, filter_fcn: TupleFilter | F | str | None) -> Self:
        """The dataset with a further tuple filter, which chooses steps like `Dataset.filter_steps`; None removes all.

        Raises:
            FilterError: it is neither, or names an unknown field.
        """
        return self._with(tuple_filter=filter_fcn)

    def _with(self, **filters: Any) -> Self:
        made = type(self).__new__(type(self))
        made.__dict__.update(self.__dict__)
        made._query = self._query.narrowed(**{name: as_filter(given) for name, given in filters.items()})
        made.set_seed(self._seed)
        return made

    def with_cache(self, cache_bytes: int, threads: int | None = None) -> Self:
        """The dataset with another budget for the cache of random access (bytes, 512 MiB by default).

        `threads` read chunks; by default as many as there are cores, at most 4.

        Raises:
            SamplingError: a number is no integer, or too small.
        """
        made = self._with()
        made._query.cache = {**made._query.cache, **cache_options(cache_bytes, threads)}
        return made

    # --- listing and loading ---

    def preview(self) -> list[EpisodeHeader]:
        """Lists the episodes again; reads no step."""
        return list(self._query.refresh())

    def load(self) -> None:
        """List the episodes again and read their steps (states, actions, rewards, terminals, timeouts) into
        memory.

        Raises:
            SpaceError: one array cannot hold the steps of two recordings; the message names them.
        """

        def attempt() -> None:
            self._query.refresh()
            self._query.read(FIVE)

        anew(attempt)  # again if episodes are deleted while they are read: the next listing lacks them

    def save_columns(self, directory: str | os.PathLike[str]) -> None:
        """Writes the steps, as they are listed now, to an unused directory; see `Dataset.save_columns`."""
        save_columns(directory, self.steps, self._headers, self._step_seconds())

    # --- contents ---

    @property
    def steps(self) -> Steps:
        """The steps that the filters choose by number, from 0; windows and samplers read them."""
        return self._query.steps()

    @property
    def _headers(self) -> Sequence[EpisodeHeader]:
        return self._query.headers

    def _episodes(self, filter: BaseFilter | None) -> tuple[EpisodeSource, Sequence[EpisodeHeader]]:
        """The source that opens its recordings, and its episodes, listed again, that also match the filter."""
        dataset = self if filter is None else self.with_episode_filter(filter)
        return dataset._query.source, dataset.preview()

    def _step_seconds(self) -> float | None:
        known = set()
        for name, episode in {header.recording: header.episode for header in self._headers}.items():
            with self._query.source.open(name, [episode]) as recording:
                known.add(recording.labels.step_seconds)
        return known.pop() if len(known) == 1 else None

    @property
    def benchmarks(self) -> list[BenchmarkHeader]:
        """The benchmarks that match the benchmark filter."""
        return list(self._query.benchmarks)

    @property
    def episodes(self) -> Sequence[EpisodeItem]:
        """The episodes with those of their steps that match the tuple filter; each is made on access.

        Steps are read at the first access to an item. For facts about episodes alone, use `preview()`.
        """
        query, headers = self._query, self._query.headers
        return EpisodeItems(headers, lambda: query.columns_of(headers, SIX))

    @property
    def tuples(self) -> Sequence[RLTuple]:
        """The steps; each is made on access."""
        return Tuples(self._query.read(SIX), self._query.layout)

    @property
    def states(self) -> Any:
        """The state of each step, the observation its action was chosen on: a read-only column."""
        return self._query.read(["states"])["states"]

    @property
    def next_states(self) -> Any:
        """The state after each step, never one of another episode: a read-only column.

        If it was not recorded (the last step of an episode made from values), it is the step's own state.
        """
        return self._query.read(["next_states"])["next_states"]

    @property
    def actions(self) -> Any:
        """The action of each step: a read-only column."""
        return self._query.read(["actions"])["actions"]

    @property
    def rewards(self) -> Any:
        """The reward of each step: a read-only column, float64 unless there is a reward space."""
        return self._query.read(["rewards"])["rewards"]

    @property
    def terminals(self) -> np.ndarray[Any, np.dtype[np.bool_]]:
        """Whether the environment ended with the step: read-only, bool."""
        found: np.ndarray[Any, np.dtype[np.bool_]] = self._query.read(["terminals"])["terminals"]
        return found

    @property
    def timeouts(self) -> np.ndarray[Any, np.dtype[np.bool_]]:
        """Whether the episode was truncated with the step, as recorded: read-only, bool."""
        found: np.ndarray[Any, np.dtype[np.bool_]] = self._query.read(["timeouts"])["timeouts"]
        return found

    @property
    def infos(self) -> list[dict[str, Any]]:
        """The info of each step; empty if none was recorded."""
        return list(self._query.read(["infos"])["infos"])

    def _infos(self) -> Sequence[Mapping[str, Any]]:
        return self.infos

    def __len__(self) -> int:
        """The number of steps, after all filters; with a tuple filter, this evaluates it."""
        if self._query.tuple_filter is None:
            return sum(header.n_tuples for header in self._query.headers)
        return self._query.selected.steps

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
        columns = self._query.own(FIVE)
        if mark_cuts:
            convert.mark_cuts(columns, self._query.selected)
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
        columns = self._query.own((*FIVE, "next_states"))
        if mark_cuts:
            convert.mark_cuts(columns, self._query.selected)
        return {name: columns[field] for name, field in convert.D4RL_NAMES.items()}

    def convert_to_dataframe(self) -> pd.DataFrame:
        """A pandas DataFrame with a row for each step: the episode (its position in `preview()`), the step (from
        0 in its episode), and the columns of `convert_to_d4rl_format` with the recorded flags.

        Columns of numbers keep their dtype; a value of several numbers is one object in its cell.

        Raises:
            MissingExtraError: pandas is not installed.
        """
        convert.import_pandas()
        columns = self._query.own((*FIVE, "next_states", "steps"))
        return convert.dataframe(columns, self._query.selected)

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
        columns = self._query.read(FIVE if parser else SIX)
        order = self._random.permutation(len(columns["terminals"])) if shuffle else None
        return convert.batches(columns, self._query.layout, size, order, parser)

    def sample_episodes(self, n_samples: int) -> list[EpisodeItem]:
        """Up to `n_samples` different episodes, drawn at random, with all their steps: the tuple filter does not
        apply.

        Only their steps are read. See `set_seed`.

        Raises:
            DatasetError: the number is no integer from 0.
        """
        headers = self._query.headers
        n = min(checked_whole(n_samples, 0, "a number of episodes"), len(headers))
        drawn = self._random.choice(len(headers), n, replace=False)
        in_order = np.sort(drawn)
        chosen = [headers[i] for i in in_order]
        columns, selected, layout = read_columns(self._query.source, chosen, SIX)
        items = EpisodeItems(chosen, lambda: (columns, selected.lengths, layout))
        return [items[i] for i in np.searchsorted(in_order, drawn)]

    # --- display ---

    def _facts(self) -> display.Facts:
        headers, selected = self._query.known
        tuples = self._query.tuple_filter
        filters = {
            "benchmarks": self._query.benchmark_filter,
            "episodes": self._query.episode_filter,
            "steps": None if tuples is None else tuples.filters,
        }
        return display.Facts(
            repr(self._query.source), headers, None if selected is None else selected.steps, filters
        )

    def __repr__(self) -> str:
        return display.text(type(self).__name__, self._facts())

    def _repr_html_(self) -> str:
        _ = self._query.headers
        return display.html(type(self).__name__, self._facts())


def _checked_parser(parser: Any) -> type[BaseTupleParser]:
    """The parser. DatasetError if it is none."""
    if not hasattr(parser, "parse_lists"):
        raise DatasetError(f"expected a parser, such as TorchTupleParser, found {parser!r:.80}")
    found: type[BaseTupleParser] = parser
    return found
