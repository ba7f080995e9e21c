"""The parts of `tools/bench.py`: workloads, the peers, and a module for each kind of work."""
