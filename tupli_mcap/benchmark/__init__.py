"""Benchmarks: environments that are stored, shared and recorded under one identity.

wrapper    `TupliEnvWrapper`
_tap       lets it put a recorder on an environment after a reset, and take it off"""

from tupli_mcap.benchmark.wrapper import DeletedBenchmark, TupliEnvWrapper

__all__ = ["DeletedBenchmark", "TupliEnvWrapper"]
