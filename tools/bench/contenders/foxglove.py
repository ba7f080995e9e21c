"""foxglove-sdk: a raw channel, a message a step, its bytes prepared. It writes; reading is left to others."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from tools.bench.contenders.mcap import SCHEMA, Mcap


class Foxglove(Mcap):
    """`Channel.log` into `open_mcap`; what it wrote is read back with the `mcap` package."""

    note = "writes as a raw channel does, its bytes prepared before the clock runs; its files are read with `mcap`"

    def _writer(self, path: Path) -> tuple[Any, Any]:
        import foxglove
        from foxglove.mcap import MCAPCompression, MCAPWriteOptions

        context = foxglove.Context()
        writer = foxglove.open_mcap(
            str(path), context=context, writer_options=MCAPWriteOptions(compression=MCAPCompression.Zstd)
        )
        schema = foxglove.Schema(name="steps", encoding="c", data=SCHEMA.encode())
        channel = foxglove.Channel("/step", schema=schema, message_encoding="raw", context=context)

        def add(data: bytes, number: int) -> None:
            channel.log(data, log_time=number)

        def finish() -> Any:
            channel.close()
            writer.close()
            return context  # channels close when nobody holds it any more

        return add, finish
