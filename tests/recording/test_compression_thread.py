"""Chunks are handed to a thread where compressing them takes long."""

from __future__ import annotations

import threading
import time

import pytest

from tupli_mcap.recording.write.chunks import LARGE, WORTH_A_THREAD, ChunkWorker


@pytest.fixture
def worker() -> ChunkWorker:
    return ChunkWorker()


def busy() -> threading.Thread:
    end = time.thread_time() + 3 * WORTH_A_THREAD
    while time.thread_time() < end:
        pass
    return threading.current_thread()


def test_short_jobs_need_no_thread(worker: ChunkWorker) -> None:
    assert [worker.submit(threading.current_thread, 0)() for _ in range(3)] == [
        threading.current_thread()
    ] * 3
    worker.close()


def test_after_a_long_job_the_next_is_handed_over(worker: ChunkWorker) -> None:
    assert worker.submit(busy, 0)() is threading.current_thread()
    assert worker.submit(threading.current_thread, 0)() is not threading.current_thread()
    assert worker.submit(threading.current_thread, 0)() is threading.current_thread(), (
        "the one before was short"
    )
    worker.close()


def test_a_large_first_job_is_handed_over_the_next_if_it_took_long(worker: ChunkWorker) -> None:
    assert worker.submit(threading.current_thread, LARGE)() is not threading.current_thread()
    assert worker.submit(threading.current_thread, LARGE)() is threading.current_thread()
    worker.close()


def test_what_a_job_raises_comes_with_its_result(worker: ChunkWorker) -> None:
    def fail() -> None:
        busy()
        raise ValueError("full")

    worker.submit(busy, 0)()
    result = worker.submit(fail, 0)
    with pytest.raises(ValueError, match="full"):
        result()
    worker.close()
