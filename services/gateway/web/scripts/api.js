/** Requests to the gateway. The API key goes along where there is one; refusals become errors. */

const KEY = "pointslam.key";

/** A refusal of the gateway: a problem document (RFC 9457), or no answer at all (status 0). */
export class Problem extends Error {
  constructor(status, reason) {
    super(reason);
    this.status = status;
  }
}

export const hasKey = () => Boolean(sessionStorage.getItem(KEY));
export const setKey = (key) => sessionStorage.setItem(KEY, key);
export const forgetKey = () => sessionStorage.removeItem(KEY);

/** Path of something of a session. */
export const sessionPath = (name, what = "") =>
  `/v1/sessions/${encodeURIComponent(name)}${what ? `/${what}` : ""}`;

/** A response that is fine or 304; throws Problem otherwise. */
export async function request(path, { method = "GET", json, body, headers = {}, signal } = {}) {
  const sent = { ...headers };
  const key = sessionStorage.getItem(KEY);
  if (key) sent.Authorization = `Bearer ${key}`;
  if (json !== undefined) sent["Content-Type"] = "application/json";
  const content = json === undefined ? body : JSON.stringify(json);
  let response;
  try {
    response = await fetch(path, { method, headers: sent, body: content, signal });
  } catch (error) {
    if (error.name === "AbortError") throw error;
    throw new Problem(0, "The gateway does not answer.");
  }
  if (response.ok || response.status === 304) return response;
  throw new Problem(response.status, await reasonOf(response));
}

async function reasonOf(response) {
  try {
    const problem = await response.json();
    return problem.detail ?? problem.title ?? response.statusText;
  } catch {
    return `${response.status} ${response.statusText}`;
  }
}

export const getJson = async (path, options) => (await request(path, options)).json();
export const postJson = async (path, json) => (await request(path, { method: "POST", json })).json();

/** Sockets and event streams cannot send headers: with a key, a single-use ticket goes along. */
async function ticketed(path) {
  if (!hasKey()) return path;
  const { ticket } = await postJson("/v1/tickets");
  return `${path}${path.includes("?") ? "&" : "?"}ticket=${encodeURIComponent(ticket)}`;
}

export async function openSocket(path) {
  const url = new URL(await ticketed(path), location.href);
  url.protocol = url.protocol === "https:" ? "wss:" : "ws:";
  const socket = new WebSocket(url);
  socket.binaryType = "arraybuffer";
  return socket;
}

/**
 * Server-sent events until `signal` aborts, opened again when the connection breaks.
 * `handlers` has a function of (data, id) for each kind, and `connected(isConnected)`.
 */
export async function listen(path, handlers, signal) {
  for (let pause = 1000; !signal.aborted; pause = Math.min(2 * pause, 8000)) {
    try {
      await listenOnce(await ticketed(path), handlers, signal, () => { pause = 500; });
    } catch (error) {
      if (error instanceof Problem && error.status === 404) return;
    }
    if (!signal.aborted) {
      handlers.connected?.(false);
      await new Promise((resume) => setTimeout(resume, pause));
    }
  }
}

function listenOnce(url, handlers, signal, opened) {
  return new Promise((done) => {
    const source = new EventSource(url);
    const end = () => { source.close(); done(); };
    signal.addEventListener("abort", end, { once: true });
    source.onerror = end;
    source.onopen = () => { opened(); handlers.connected?.(true); };
    for (const [kind, handle] of Object.entries(handlers)) {
      if (kind !== "connected") {
        source.addEventListener(kind, (event) => handle(JSON.parse(event.data), event.lastEventId));
      }
    }
  });
}
