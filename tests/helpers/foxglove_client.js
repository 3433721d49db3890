// The published client of Foxglove's WebSocket protocol, with Foxglove's own decoder of ROS 2 messages.
//
// node foxglove_client.js FOLDER URL SUBPROTOCOL '{"/tf": 10}': subscribes to these topics, prints "subscribed",
// and, once it has so many messages of each, all of them with the parameters as one line of JSON.
// The packages are in FOLDER/node_modules.
const [folder, url, subprotocol, text] = process.argv.slice(2);
const load = require("node:module").createRequire(`${folder}/package.json`);
const { FoxgloveClient } = load("@foxglove/ws-protocol");
const { parse } = load("@foxglove/rosmsg");
const { MessageReader } = load("@foxglove/rosmsg2-serialization");
const WebSocket = load("ws");

const counts = JSON.parse(text);
const missing = new Set(Object.keys(counts));
const received = Object.fromEntries([...missing].map((topic) => [topic, []]));
const subscriptions = new Map();
let parameters;

const client = new FoxgloveClient({ ws: new WebSocket(url, [subprotocol]) });
client.on("error", (error) => {
  throw error;
});
client.on("advertise", (channels) => {
  for (const { id, topic, schema } of channels.filter((channel) => missing.delete(channel.topic))) {
    const reader = new MessageReader(parse(schema, { ros2: true }));
    subscriptions.set(client.subscribe(id), { topic, reader });
  }
  if (missing.size === 0) client.getParameters([], "all");
});
client.on("parameterValues", (event) => {
  parameters = Object.fromEntries(event.parameters.map(({ name, value }) => [name, value]));
  console.log("subscribed");
});
client.on("message", ({ subscriptionId, data }) => {
  const { topic, reader } = subscriptions.get(subscriptionId);
  received[topic].push(reader.readMessage(data));
  if (parameters && Object.entries(counts).every(([one, count]) => received[one].length >= count)) {
    const plain = (_, value) => (ArrayBuffer.isView(value) ? Array.from(value) : value);
    console.log(JSON.stringify({ parameters, ...received }, plain));
    process.exit();
  }
});
