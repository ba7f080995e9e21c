"""The counters of a server, for Prometheus."""

from __future__ import annotations

import os
from collections.abc import Iterable
from typing import Any, Final

from prometheus_client import CollectorRegistry, Counter, Gauge, Histogram, generate_latest
from prometheus_client.core import GaugeMetricFamily
from prometheus_client.metrics_core import Metric
from prometheus_client.multiprocess import MultiProcessCollector
from sqlalchemy import Connection, func, select

from tupli_mcap.server.tables import FILE, ITEM, PENDING, UPLOAD, USER
from tupli_mcap.storage.catalog.tables import TALLY

# the directory in which the processes of one server count together
_SHARED: Final = "PROMETHEUS_MULTIPROC_DIR"
_SECONDS: Final = (0.005, 0.02, 0.1, 0.5, 2, 10, 60, 600)


class Metrics:
    """Counters of requests. Thread-safe."""

    def __init__(self) -> None:
        self._registry = CollectorRegistry()
        told: dict[str, Any] = {"namespace": "tupli_mcap", "registry": self._registry}
        by_route = ("method", "route", "status")
        self.requests = Counter("requests", "Requests that were answered.", by_route, **told)
        self.seconds = Histogram(
            "request_seconds", "How long answers took.", by_route[:2], buckets=_SECONDS, **told
        )
        self.received = Counter("received_bytes", "Bytes of bodies that came.", **told)
        self.sent = Counter("sent_bytes", "Bytes of bodies that went.", **told)
        self.running = Gauge(
            "requests_running", "Requests that are being answered.", multiprocess_mode="livesum", **told
        )

    def text(self, connection: Connection) -> bytes:
        """The counters of all processes of the server, and the current amounts of stored data."""
        counted, kept = self._registry, CollectorRegistry()
        if os.environ.get(_SHARED):
            counted = CollectorRegistry()
            MultiProcessCollector(counted)  # type: ignore[no-untyped-call]
        kept.register(_Kept(connection))
        return generate_latest(counted) + generate_latest(kept)


class _Kept:
    def __init__(self, connection: Connection) -> None:
        self._connection = connection

    def collect(self) -> Iterable[Metric]:
        for name, told, value in (
            ("users", "Users.", func.count(USER.c.name)),
            ("recordings", "Files of recordings.", func.count(FILE.c.path)),
            ("recording_bytes", "Their bytes.", func.sum(FILE.c.size)),
            ("episodes", "Episodes that are listed.", func.sum(TALLY.c.episodes)),
            ("items", "Benchmarks and artifacts.", func.count(ITEM.c.number)),
            ("item_bytes", "Their bytes.", func.sum(ITEM.c.size)),
            ("uploads", "Uploads that are not finished.", func.count(UPLOAD.c.id)),
            ("pending_files", "Files on their way in or out.", func.count(PENDING.c.path)),
        ):
            found = self._connection.execute(select(value)).scalar()
            yield GaugeMetricFamily(f"tupli_mcap_{name}", told, float(found or 0))
