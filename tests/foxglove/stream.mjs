// Decodes a stream with Foxglove's own packages, as it comes, with the topics and schemas of a manifest's source:
// `node stream.mjs SOURCE.json < STREAM` prints a line of JSON, `[topic, decoded messages, first time, last time]`, for each topic.
import { readFile } from "node:fs/promises";
import { McapStreamReader } from "@mcap/core";
import { loadDecompressHandlers } from "@mcap/support";
import { parse } from "@foxglove/rosmsg";
import { MessageReader } from "@foxglove/rosmsg2-serialization";

const source = JSON.parse(await readFile(process.argv[2]));
const schemas = new Map(source.schemas.map((schema) => [schema.id, schema]));
const readers = new Map();
for (const topic of source.topics) {
  const schema = schemas.get(topic.schemaId);
  if (topic.messageEncoding !== "cdr" || schema.encoding !== "ros2msg") throw new Error(`unexpected ${topic.name}`);
  const text = Buffer.from(schema.data, "base64").toString();
  readers.set(topic.name, new MessageReader(parse(text, { ros2: true })));
}

const reader = new McapStreamReader({ decompressHandlers: await loadDecompressHandlers() });
const topics = new Map();
const found = new Map();
for await (const piece of process.stdin) {
  reader.append(piece);
  for (let record; (record = reader.nextRecord()); ) {
    if (record.type === "Channel") topics.set(record.id, record.topic);
    if (record.type !== "Message") continue;
    const topic = topics.get(record.channelId);
    readers.get(topic).readMessage(record.data);
    const [count, first, last] = found.get(topic) ?? [0, record.logTime, record.logTime];
    found.set(topic, [count + 1, record.logTime < first ? record.logTime : first, record.logTime > last ? record.logTime : last]);
  }
}
if (!reader.done()) throw new Error("the stream ended early");
for (const [topic, [count, first, last]] of found) console.log(JSON.stringify([topic, count, String(first), String(last)]));
