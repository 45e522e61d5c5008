/* The connection to the server and the age of what it sent, by the page's own monotonic clock.

Nothing is kept for later: a message that cannot be sent now is never sent. After a reconnection nothing goes on
by itself. Events: "state" (a new one), "age" (every 50 ms), "stale" (data became too old), "closed", "refused" (a
message that the server did not understand; `detail` says why). */

/** One frame of the page and one state less than the 0.5 s within which it must say so. */
export const STALE_S = 0.45;
const TICK_MS = 50, ANSWER_MS = 5000, RECONNECT_MS = [250, 500, 1000, 2000];
/** States of a run whose own report must be young; before and after them nothing moves. */
const REPORTING = ["enabling", "approaching", "moving", "holding", "stopping", "securing"];

/** The token of the page's address, or of its head. */
export function pageToken() {
  return new URLSearchParams(location.search).get("token") || document.querySelector("meta[name=token]")?.content || "";
}

/** An address of this server with the token. */
export function address(path) {
  return `${path}${path.includes("?") ? "&" : "?"}token=${encodeURIComponent(pageToken())}`;
}

export class Connection extends EventTarget {
  state = null;
  #socket = null;
  #received = null; // performance.now() of the last state
  #answers = new Map(); // id → what to do with the answer
  #id = 0;
  #tries = 0;
  #wasFresh = false;
  #due = 0; // timer of the moment at which the last state becomes too old

  start() {
    this.#connect();
    setInterval(() => this.#tick(), TICK_MS);
  }

  get open() {
    return this.#socket?.readyState === WebSocket.OPEN;
  }

  /** Why the data do not count, or null; the age of the data, [s]. */
  freshness() {
    if (this.#received === null) return { why: this.open ? "Waiting for data" : "Not connected to the console’s server", age: null };
    const here = (performance.now() - this.#received) / 1000;
    const { motion } = this.state;
    const there = motion && REPORTING.includes(motion.state) && motion.age_s !== null ? motion.age_s + here : 0;
    const age = Math.max(here, there);
    if (!this.open) return { why: `Connection lost: data are ${age.toFixed(1)} s old`, age };
    if (age <= STALE_S) return { why: null, age };
    const who = here > STALE_S ? "the console’s server" : "the run";
    return { why: `No data from ${who} for ${age.toFixed(1)} s`, age };
  }

  /** Whether it went out. */
  send(message) {
    if (!this.open) return false;
    this.#socket.send(JSON.stringify(message));
    return true;
  }

  /** Sends a command; its answer `{ok, what}`, also where there is none. */
  command(command, fields = {}) {
    const id = ++this.#id;
    return new Promise((resolve) => {
      if (!this.send({ kind: "command", id, command, ...fields })) return resolve({ ok: false, what: "Not connected: the command was not sent." });
      const give = (answer) => {
        clearTimeout(timer);
        this.#answers.delete(id);
        resolve(answer);
      };
      const timer = setTimeout(() => give({ ok: false, what: `No answer to “${command}” within ${ANSWER_MS / 1000} s.` }), ANSWER_MS);
      this.#answers.set(id, give);
    });
  }

  /** Asks for a stop along the path by every route that is there; the first good answer, or else why not. */
  async stop() {
    const routes = [];
    if (this.open) routes.push(this.command("stop"));
    if (!this.open || this.freshness().why) routes.push(posted("/stop"));
    const done = routes.map((route) => route.then((answer) => (answer.ok ? answer : Promise.reject(answer))));
    return Promise.any(done).catch(({ errors }) => errors[0]);
  }

  #connect() {
    const scheme = location.protocol === "https:" ? "wss" : "ws";
    const socket = new WebSocket(`${scheme}://${location.host}${address("/ws")}`);
    this.#socket = socket;
    socket.addEventListener("open", () => (this.#tries = 0));
    socket.addEventListener("message", (event) => this.#take(JSON.parse(event.data)));
    socket.addEventListener("close", () => this.#closed());
  }

  #closed() {
    for (const give of [...this.#answers.values()]) give({ ok: false, what: "The connection was lost before the answer." });
    this.#wasFresh = false;
    this.dispatchEvent(new Event("closed"));
    setTimeout(() => this.#connect(), RECONNECT_MS[Math.min(this.#tries++, RECONNECT_MS.length - 1)]);
  }

  #take(message) {
    if (message.kind === "answer") {
      const give = this.#answers.get(message.to);
      if (give) give(message);
      else if (!message.ok) this.dispatchEvent(new CustomEvent("refused", { detail: message.what }));
      return;
    }
    if (message.kind !== "state") return;
    this.state = message;
    this.#received = performance.now();
    clearTimeout(this.#due);
    this.#due = setTimeout(() => this.#tick(), 1 + 1000 * Math.max(0, STALE_S - this.freshness().age));
    this.dispatchEvent(new Event("state"));
  }

  #tick() {
    const fresh = !this.freshness().why;
    if (this.#wasFresh && !fresh) this.dispatchEvent(new Event("stale"));
    this.#wasFresh = fresh;
    this.dispatchEvent(new Event("age"));
  }
}

async function posted(path) {
  try {
    const response = await fetch(path, { method: "POST", keepalive: true, cache: "no-store" });
    return response.ok ? await response.json() : { ok: false, what: `The server refused the stop (${response.status}).` };
  } catch {
    return { ok: false, what: "STOP did not reach the server: use the emergency-stop button." };
  }
}
