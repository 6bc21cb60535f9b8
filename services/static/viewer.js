// The viewer page: draws the newest composite, acknowledges it, and shows where its time went.
// One binary WebSocket message is: uint32 little-endian length of a JSON header, the header, a JPEG.

const VIEWS = ["composite", "effects", "delta", "volume", "rsm"];
const OPERATORS = ["exact", "paper"];
const STALE_MS = 1500;
const RECONNECT_MS = 1000;
const FALLBACK_AFTER_FAILURES = 3;

const element = (id) => document.getElementById(id);
const picture = element("picture");
const context = picture.getContext("2d");
let lastArrival = 0;
let failures = 0;

function connect() {
  const address = new URL("api/v1/live", location.href);
  address.protocol = location.protocol === "https:" ? "wss:" : "ws:";
  const socket = new WebSocket(address);
  socket.binaryType = "arraybuffer";
  socket.onmessage = async (event) => {
    failures = 0;
    try {
      await show(event.data);
    } finally {
      if (socket.readyState === WebSocket.OPEN) socket.send("ack");
    }
  };
  socket.onclose = () => {
    failures += 1;
    setState("lost", "connection lost");
    if (failures === FALLBACK_AFTER_FAILURES) showFallback();
    setTimeout(connect, RECONNECT_MS);
  };
}

async function show(message) {
  const headerLength = new DataView(message).getUint32(0, true);
  const header = JSON.parse(new TextDecoder().decode(new Uint8Array(message, 4, headerLength)));
  const jpeg = new Blob([new Uint8Array(message, 4 + headerLength)], { type: "image/jpeg" });
  const bitmap = await createImageBitmap(jpeg);
  picture.width = bitmap.width;
  picture.height = bitmap.height;
  context.drawImage(bitmap, 0, 0);
  bitmap.close();
  lastArrival = performance.now();
  picture.hidden = false;
  element("fallback").hidden = true;
  element("message").hidden = true;
  showFigures(header);
}

function showFigures(header) {
  setState(header.status === "ok" ? "live" : "stale", header.status === "ok" ? "live" : "no marker in view");
  element("rate").textContent = header.frames_per_s === null ? "–" : `${header.frames_per_s.toFixed(1)} / s`;
  element("age").textContent = header.age_ms === null ? "–" : `${header.age_ms.toFixed(0)} ms`;
  element("frame").textContent = header.frame_id;
  showDrops(header.drops);
  element("renderer").textContent = header.renderer;
  showPasses(header.pass_times_ms);
}

// Depth and pose are dropped together with their colour frame, so only the others count as frames.
function showDrops(drops) {
  const entries = Object.entries(drops).filter(([, count]) => count > 0);
  const frames = entries.filter(([name]) => !/^(clean_depth|pose)\./.test(name));
  element("drops").textContent = frames.reduce((sum, [, count]) => sum + count, 0);
  element("drops").title = entries.map(([name, count]) => `${name}: ${count}`).join("\n");
}

function showPasses(times) {
  const entries = Object.entries(times);
  const total = entries.reduce((sum, [, milliseconds]) => sum + milliseconds, 0);
  element("total").textContent = `${total.toFixed(1)} ms`;
  element("passes").replaceChildren(...entries.map(([name, milliseconds]) => passRow(name, milliseconds, total)));
}

function passRow(name, milliseconds, total) {
  const row = document.createElement("tr");
  const bar = document.createElement("div");
  bar.className = "bar";
  bar.style.width = `${total > 0 ? (100 * milliseconds) / total : 0}%`;
  for (const content of [name.replaceAll("_", " "), milliseconds.toFixed(1), bar]) {
    row.insertCell().append(content);
  }
  return row;
}

function setState(kind, text) {
  element("state").className = `badge ${kind}`;
  element("state").textContent = text;
}

function showFallback() {
  const image = element("fallback");
  image.src = `stream.mjpg?${Date.now()}`;
  image.onload = () => {
    image.hidden = false;
    picture.hidden = true;
    element("message").hidden = true;
  };
}

async function request(path, options) {
  const answer = await fetch(path, options);
  const body = await answer.json();
  if (!answer.ok) throw new Error(body.detail);
  return body;
}

async function choose(key, value) {
  const fault = element("fault");
  fault.hidden = true;
  try {
    const headers = { "Content-Type": "application/json" };
    showChoices(await request("api/v1/scene/choice", {
      method: "PUT", headers, body: JSON.stringify({ [key]: value }),
    }));
  } catch (error) {
    fault.textContent = error.message;
    fault.hidden = false;
  }
}

function makeButtons(group, key, names) {
  element(group).replaceChildren(...names.map((name) => {
    const button = document.createElement("button");
    button.type = "button";
    button.textContent = name;
    button.dataset.name = name;
    button.onclick = () => choose(key, name);
    return button;
  }));
}

function showChoices(choices) {
  element("scene").textContent = choices.name;
  for (const [group, chosen] of [["views", choices.view], ["operators", choices.operator]]) {
    for (const button of element(group).children) {
      button.setAttribute("aria-pressed", String(button.dataset.name === chosen));
    }
  }
}

async function followChoices() {
  try {
    showChoices(await request("api/v1/scene/choice"));
  } catch {
    // the render server is still starting; the picture shows that, and the next turn asks again
  }
  setTimeout(followChoices, 3000);
}

setInterval(() => {
  if (lastArrival && performance.now() - lastArrival > STALE_MS) setState("stale", "stale");
}, 500);

makeButtons("views", "view", VIEWS);
makeButtons("operators", "operator", OPERATORS);
connect();
followChoices();
