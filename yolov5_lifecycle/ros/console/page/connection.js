/** The connection to the console: messages, requests with answers, and a new attempt whenever it is lost. */

const FIRST_PAUSE_MS = 500;
const MAX_PAUSE_MS = 5000;
const SILENCE_MS = 5000;
const PATIENCE_MS = 4000;

/** Fires "message" with each object from the server as `detail`, "open" and "lost". */
export class Connection extends EventTarget {
  #socket = null;
  #pauseMs = FIRST_PAUSE_MS;
  #lastId = 0;
  #waiting = new Map();
  #heardMs = 0;

  start() {
    this.#connect();
    setInterval(() => this.#checkSilence(), SILENCE_MS);
    window.addEventListener("offline", () => this.#socket?.close());
    window.addEventListener("pagehide", () => this.#socket?.close());
  }

  /** The answer of the console: `{ok, reason, result}`; never rejects. */
  request(message) {
    if (this.#socket?.readyState !== WebSocket.OPEN) {
      return Promise.resolve({ ok: false, reason: "not sent: the connection to the console is lost" });
    }
    this.#lastId += 1;
    const id = this.#lastId;
    this.#socket.send(JSON.stringify({ ...message, id }));
    return new Promise((resolve) => this.#waiting.set(id, resolve));
  }

  #connect() {
    const socket = new WebSocket(socketAddress("/ws"));
    this.#socket = socket;
    socket.addEventListener("message", (event) => this.#receive(event.data));
    socket.addEventListener("close", () => this.#lose());
  }

  #receive(text) {
    this.#heardMs = performance.now();
    const message = JSON.parse(text);
    if (message.type === "welcome") {
      this.#pauseMs = FIRST_PAUSE_MS;
      this.dispatchEvent(new Event("open"));
    }
    if (message.type === "answer") {
      this.#waiting.get(message.id)?.({ ok: message.ok, reason: message.reason, result: message.result });
      this.#waiting.delete(message.id);
    } else {
      this.dispatchEvent(new CustomEvent("message", { detail: message }));
    }
  }

  #lose() {
    for (const resolve of this.#waiting.values()) {
      resolve({ ok: false, reason: "no answer: the connection to the console was lost meanwhile" });
    }
    this.#waiting.clear();
    this.dispatchEvent(new Event("lost"));
    setTimeout(() => this.#tryAgain(), this.#pauseMs);
    this.#pauseMs = Math.min(2 * this.#pauseMs, MAX_PAUSE_MS);
  }

  async #tryAgain() {
    if (await isLoggedOut()) {
      location.assign("/login");
    } else {
      this.#connect();
    }
  }

  /** A phone that has left the network is not notified of it: request a small file. */
  async #checkSilence() {
    const isOpen = this.#socket?.readyState === WebSocket.OPEN;
    if (!isOpen || performance.now() - this.#heardMs < SILENCE_MS) {
      return;
    }
    const asked = this.#socket;
    if ((await answerOf("/page/icon.svg")) === null && this.#socket === asked) {
      asked.close();
    }
  }
}

/** Address of a WebSocket of the server that sent this page. */
export function socketAddress(path) {
  return `${location.protocol === "https:" ? "wss" : "ws"}://${location.host}${path}`;
}

/** The server redirects the page to the login if the cookie is missing or from another token. */
async function isLoggedOut() {
  return (await answerOf("/"))?.type === "opaqueredirect";
}

async function answerOf(path) {
  try {
    return await fetch(path, { redirect: "manual", cache: "no-store", signal: AbortSignal.timeout(PATIENCE_MS) });
  } catch {
    return null;
  }
}
