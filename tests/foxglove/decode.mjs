// Decodes recordings with Foxglove's own packages: `node decode.mjs FILE...` prints a line of JSON for each message.
// Numbers that JSON cannot hold are {"bits": …}: bytes of typed arrays, decimal digits of 64-bit integers.
import { open } from "node:fs/promises";
import { McapIndexedReader } from "@mcap/core";
import { loadDecompressHandlers } from "@mcap/support";
import { parse } from "@foxglove/rosmsg";
import { MessageReader } from "@foxglove/rosmsg2-serialization";

const decompressHandlers = await loadDecompressHandlers();

function plain(value) {
  if (typeof value === "bigint") return { integer: value.toString() };
  if (typeof value === "number") return Number.isFinite(value) && !Object.is(value, -0) ? value : { float: Object.is(value, -0) ? "-0.0" : String(value) };
  if (ArrayBuffer.isView(value)) {
    const bytes = Buffer.from(value.buffer, value.byteOffset, value.byteLength);
    return { array: value.constructor.name, bytes: bytes.toString("base64") };
  }
  if (Array.isArray(value)) return value.map(plain);
  if (value !== null && typeof value === "object") {
    return { fields: Object.fromEntries(Object.entries(value).map(([key, item]) => [key, plain(item)])) };
  }
  return value;
}

for (const path of process.argv.slice(2)) {
  const file = await open(path);
  const size = BigInt((await file.stat()).size);
  const readable = {
    size: async () => size,
    read: async (offset, length) => {
      const buffer = Buffer.alloc(Number(length));
      await file.read(buffer, 0, Number(length), Number(offset));
      return new Uint8Array(buffer);
    },
  };
  const mcap = await McapIndexedReader.Initialize({ readable, decompressHandlers });
  const readers = new Map();
  for await (const message of mcap.readMessages()) {
    const channel = mcap.channelsById.get(message.channelId);
    if (!readers.has(channel.id)) {
      const schema = mcap.schemasById.get(channel.schemaId);
      const text = new TextDecoder().decode(schema.data);
      readers.set(channel.id, new MessageReader(parse(text, { ros2: true })));
    }
    const decoded = readers.get(channel.id).readMessage(message.data);
    const line = { path, topic: channel.topic, sequence: message.sequence, time: message.logTime.toString(), message: plain(decoded) };
    console.log(JSON.stringify(line));
  }
  await file.close();
}
