"""Datasets for PyTorch, in real DataLoaders with real workers, against the columns they are made of."""

from __future__ import annotations

import pickle
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from environments import same
from gymnasium import spaces
from hypothesis import given, settings
from hypothesis import strategies as st
from test_sampling import SPACES, record

from tupli_mcap import TupliDataset

torch = pytest.importorskip("torch")
from torch.utils.data import DataLoader, DistributedSampler, default_collate  # noqa: E402

from tupli_mcap.torch import Episodes, MapDataset, StreamDataset, collate  # noqa: E402
from tupli_mcap.torch.order import Batches, Blocks, Part  # noqa: E402

SMALL = 20_000  # bytes: a few chunks of what `record` writes


def as_numpy(column: Any) -> Any:
    """A batch with arrays in place of tensors."""
    if isinstance(column, torch.Tensor):
        return column.numpy()
    if isinstance(column, dict):
        return {key: as_numpy(part) for key, part in column.items()}
    return tuple(as_numpy(part) for part in column) if isinstance(column, tuple) else column


@pytest.fixture(scope="module", params=SPACES)
def each_space(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> TupliDataset:
    directory = tmp_path_factory.mktemp(request.param)
    return TupliDataset.from_files(
        [record(directory / f"{i}.mcap", SPACES[request.param], 60 + i, seed=i) for i in range(2)]
    )


@pytest.fixture(scope="module")
def dataset(tmp_path_factory: pytest.TempPathFactory) -> TupliDataset:
    """Images, whose chunks are many and small."""
    directory = tmp_path_factory.mktemp("images")
    return TupliDataset.from_files(
        [record(directory / f"{i}.mcap", SPACES["image"], 200 + i, seed=i) for i in range(3)]
    )


def all_of(batches: Any) -> list[int]:
    """The first step of each item."""
    return [step for batch in numbers(batches) for step in batch]


def numbers(batches: Any) -> list[list[int]]:
    """The first step of each item, batch by batch."""
    return [batch["steps"].tolist() for batch in batches]


def test_a_batch_is_what_the_windows_are(each_space: TupliDataset) -> None:
    windows = each_space.windows(4, pad="zero", history=1)
    found = MapDataset(windows)
    order = np.random.default_rng(0).permutation(len(windows))
    loader = DataLoader(found, batch_size=16, sampler=order.tolist(), collate_fn=collate)
    for i, batch in enumerate(loader):
        expected = windows[order[i * 16 : (i + 1) * 16]].asdict()
        assert same(as_numpy(batch), expected)
    one = found[3]
    assert same(as_numpy(one)["states"], windows[3].states)
    assert one["steps"].ndim == 0


@pytest.mark.parametrize("name", ["box", "nested", "image"])
def test_samples_of_a_batch_are_views_that_pytorch_collates(name: str, tmp_path: Path) -> None:
    windows = TupliDataset.from_files(record(tmp_path / "a.mcap", SPACES[name], 50)).windows(3)
    samples = MapDataset(windows).__getitems__([4, 2, 9])
    batch = collate(samples)
    assert batch is samples.batch
    assert samples[1]["rewards"].data_ptr() == batch["rewards"][1].data_ptr()
    collated = default_collate(samples)
    assert torch.equal(collated["rewards"], batch["rewards"])
    assert [sample["steps"].item() for sample in samples] == batch["steps"].tolist()


def test_tensors_keep_the_dtypes_that_were_recorded(tmp_path: Path) -> None:
    dtypes = (
        np.uint8,
        np.uint16,
        np.uint32,
        np.uint64,
        np.int8,
        np.int64,
        np.float16,
        np.float32,
        np.float64,
    )
    space = spaces.Dict({np.dtype(kind).name: spaces.Box(0, 3, (2,), kind) for kind in dtypes})
    windows = TupliDataset.from_files(record(tmp_path / "a.mcap", space, 30)).windows(3)
    batch = next(iter(DataLoader(MapDataset(windows), batch_size=5, collate_fn=collate, num_workers=1)))
    assert {key: str(part.dtype) for key, part in batch["states"].items()} == {
        np.dtype(kind).name: f"torch.{np.dtype(kind).name}" for kind in dtypes
    }
    assert same(as_numpy(batch["states"]), windows[:5].states)
    assert batch["terminals"].dtype == torch.bool


def test_episodes_are_filled_up_to_the_longest(tmp_path: Path) -> None:
    dataset = TupliDataset.from_files(record(tmp_path / "a.mcap", SPACES["text"], 24, length=10))
    episodes = Episodes(dataset.steps)
    assert [len(episodes[i].mask) for i in range(len(episodes))] == [10, 10, 4]
    batch = collate(MapDataset(episodes).__getitems__([2, 0]))
    assert batch["mask"].sum(1).tolist() == [4, 10]
    assert torch.equal(batch["rewards"][0, :4], torch.from_numpy(episodes[2].rewards))
    assert (batch["rewards"][0, 4:] == 0).all()
    assert batch["states"]["word"] == [[*episodes[2].states["word"], *[None] * 6], episodes[0].states["word"]]


# ---- order


@settings(max_examples=80)
@given(
    st.lists(st.integers(1, 9), min_size=1, max_size=30),
    st.integers(1, 12),
    st.integers(1, 4),
    st.integers(1, 4),
    st.integers(2, 5),
    st.booleans(),
)
def test_each_item_is_in_one_batch_of_one_rank(
    sizes: list[int], size: int, ranks: int, streams: int, mix: int, drop_last: bool
) -> None:
    ends = np.cumsum(sizes)
    blocks = Blocks(ends - sizes, ends, np.arange(len(sizes) + 1))
    total = int(ends[-1])
    parts = [
        Batches(blocks, total, size, Part(rank, ranks, streams), [7], mix, drop_last) for rank in range(ranks)
    ]
    batches = [[part[i] for i in range(len(part))] for part in parts]
    seen = [int(item) for part in batches for batch in part for item in batch]
    if drop_last:
        assert {len(part) for part in batches} == {total // ranks // size}
        assert all(len(batch) == size for part in batches for batch in part)
        assert len(seen) == len(set(seen))
    else:
        assert sorted(seen) == list(range(total))
        assert all(len(batch) == size for part in batches for batch in part[:-1])
    again = Batches(blocks, total, size, Part(0, ranks, streams), [7], mix, drop_last)
    for i in reversed(range(len(again))):
        assert again[i].tolist() == batches[0][i].tolist()


def test_a_shuffle_mixes_chunks_and_reads_each_about_once(dataset: TupliDataset) -> None:
    items = dataset.windows(2)
    stream = StreamDataset(items, 16, seed=0, worker_cache_bytes=1 << 16)
    steps = all_of(stream)
    assert sorted(steps) == sorted(items[:].steps.tolist())
    chunks = dataset.steps.blocks(np.array(steps))
    last = {int(chunk): i for i, chunk in enumerate(chunks)}
    first = {int(chunk): len(chunks) - 1 - i for i, chunk in enumerate(chunks[::-1])}
    spread = np.mean([last[chunk] - first[chunk] for chunk in first])
    assert 16 < spread < len(steps) / 2  # of a chunk's items: over several batches, but not over the epoch
    assert np.abs(np.diff(steps)).mean() > len(steps) / 10
    other = StreamDataset(items, 16, seed=1, worker_cache_bytes=1 << 16)
    assert numbers(other) != numbers(stream) == numbers(stream)
    stream.set_epoch(1)
    assert numbers(stream) != numbers(other)


def test_a_seed_of_none_draws_from_pytorch(dataset: TupliDataset) -> None:
    stream = StreamDataset(dataset.windows(2), 16, worker_cache_bytes=SMALL)
    torch.manual_seed(3)
    first, second = numbers(stream), numbers(stream)
    assert first != second
    torch.manual_seed(3)
    assert numbers(stream) == first


@pytest.mark.parametrize("start", ["fork", "spawn", "forkserver"])
def test_workers_of_every_kind(dataset: TupliDataset, start: str) -> None:
    windows = dataset.windows(2, fields=["states", "rewards"])
    expected = dict(zip(windows[:].steps.tolist(), windows[:].states["eye"], strict=True))
    stream = StreamDataset(windows, 32, seed=0, streams=2, worker_cache_bytes=SMALL)
    loader = DataLoader(
        stream,
        None,
        num_workers=2,
        multiprocessing_context=start,
        persistent_workers=True,
        collate_fn=collate,
    )
    for epoch in range(2):
        stream.set_epoch(epoch)
        found = list(loader)
        assert numbers(found) == numbers(stream)  # `streams` makes it the order without workers
        for batch in found:
            for step, eye in zip(batch["steps"].tolist(), batch["states"]["eye"].numpy(), strict=True):
                assert same(eye, expected[step])


@pytest.mark.parametrize("workers", [0, 2])
def test_items_by_number_in_workers(dataset: TupliDataset, workers: int) -> None:
    windows = dataset.windows(2, stride=2)
    mapped = pickle.loads(pickle.dumps(MapDataset(windows, worker_cache_bytes=SMALL)))
    sampler = DistributedSampler(mapped, num_replicas=2, rank=1, seed=5)
    loader = DataLoader(mapped, 50, sampler=sampler, num_workers=workers, collate_fn=collate)
    found = {
        step: eye
        for batch in loader
        for step, eye in zip(batch["steps"].tolist(), batch["states"]["eye"], strict=True)
    }
    expected = windows[list(sampler)]
    assert sorted(found) == sorted(expected.steps.tolist())
    for step, eye in zip(expected.steps.tolist(), expected.states["eye"], strict=True):
        assert same(found[step].numpy(), eye)


@pytest.mark.parametrize("workers", [1, 2])
def test_each_item_comes_from_one_worker(dataset: TupliDataset, workers: int) -> None:
    stream = StreamDataset(dataset.windows(2), 32, worker_cache_bytes=SMALL)
    loader = DataLoader(stream, batch_size=None, num_workers=workers, collate_fn=collate)
    first, second = all_of(loader), all_of(loader)
    assert first != second
    assert sorted(first) == sorted(second) == dataset.windows(2)[:].steps.tolist()


def test_without_a_shuffle_workers_do_not_matter(dataset: TupliDataset) -> None:
    windows = dataset.windows(2)
    stream = StreamDataset(windows, 32, shuffle=False)
    loader = DataLoader(stream, batch_size=None, num_workers=2, collate_fn=collate)
    assert all_of(loader) == all_of(stream) == windows[:].steps.tolist()
