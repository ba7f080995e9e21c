"""Damaged and crafted recordings: made by `model`, `plain` and `crafted`, read and judged by `oracle` and `run`."""
