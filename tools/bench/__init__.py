"""The benchmark, `python -m tools.bench`: workloads, contenders, and what is measured of them."""
