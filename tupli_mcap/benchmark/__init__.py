"""Benchmarks: environments that are stored, shared and recorded under one identity."""

from tupli_mcap.benchmark.wrapper import DeletedBenchmark, TupliEnvWrapper

__all__ = ["DeletedBenchmark", "TupliEnvWrapper"]
