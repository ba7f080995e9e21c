"""Listens to everything that a Foxglove server on a port of this machine publishes: `python listener.py PORT`."""

from __future__ import annotations

import asyncio
import sys

import aiohttp


async def _listen(port: int) -> None:
    async with aiohttp.ClientSession() as session:
        while True:
            try:
                async with session.ws_connect(
                    f"ws://127.0.0.1:{port}", protocols=("foxglove.sdk.v1",), max_msg_size=0
                ) as socket:
                    await _subscribe(socket)
            except (aiohttp.ClientError, OSError):
                await asyncio.sleep(0.2)


async def _subscribe(socket: aiohttp.ClientWebSocketResponse) -> None:
    async for message in socket:
        if message.type is aiohttp.WSMsgType.TEXT and (found := message.json())["op"] == "advertise":
            await asyncio.sleep(0.1)
            wanted = [{"id": c["id"], "channelId": c["id"]} for c in found["channels"]]
            await socket.send_json({"op": "subscribe", "subscriptions": wanted})


if __name__ == "__main__":
    asyncio.run(_listen(int(sys.argv[1])))
