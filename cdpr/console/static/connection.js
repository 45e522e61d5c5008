/* The connection to the server and the age of its data, on the page's monotonic clock.

Each state is acknowledged with the time on this clock, and names when it was made and when the newest acknowledgement
arrived, on the server's. That was after it was sent: so a state's age on arrival is known, at most.

No message waits here: one that cannot be sent now is never sent, and no motion continues after a reconnection. The
server ends the press of a page whose connection is slow, by the newest state that its reports name.
Events: "state" (a new one), "age" (every 50 ms), "stale" (data became too old), "closed", "refused" (a message that
the server rejected; `detail` gives the reason). */

/** The page must report stale data within 0.5 s: less one frame and one state. */
export const STALE_S = 0.45;
const TICK_MS = 50, ANSWER_MS = 5000, RECONNECT_MS = [250, 500, 1000, 2000];
/** Commands that load files or read drives once they are begun: their answers are awaited. */
const LONG = ["load_plan", "compare", "run", "plan", "teach", "teach_at"];
/** Largest difference in rate of two computers' clocks. */
const DRIFT = 2e-4;
/** States of a run whose own status must be fresh; in all others nothing moves. */
const REPORTING = ["enabling", "approaching", "moving", "holding", "stopping", "securing"];

/** The token from the page's address or head. */
export function pageToken() {
  return new URLSearchParams(location.search).get("token") || document.querySelector("meta[name=token]")?.content || "";
}

/** A path on this server, with the token. */
export function address(path) {
  return `${path}${path.includes("?") ? "&" : "?"}token=${encodeURIComponent(pageToken())}`;
}

export class Connection extends EventTarget {
  state = null;
  #socket = null;
  #received = null; // performance.now() of the last state
  #opened = 0; // performance.now() when the connection was begun
  #ahead = -Infinity; // of this clock before the server's, at least, [ms]
  #delay = 0; // largest possible age of the last state when it was received, [s]
  #answers = new Map(); // id → callback
  #id = 0;
  #tries = 0;
  #wasFresh = false;
  #due = 0; // timer for the time at which the last state becomes stale

  start() {
    this.#connect();
    setInterval(() => this.#tick(), TICK_MS);
  }

  get open() {
    return this.#socket?.readyState === WebSocket.OPEN;
  }

  /** Why the data are stale, or null; the age of the data, [s]. */
  freshness() {
    if (this.#received === null) return { why: this.open ? "Waiting for data" : "Not connected to the console’s server", age: null };
    const here = (performance.now() - this.#received) / 1000 + this.#delay;
    const { motion } = this.state;
    const there = motion && REPORTING.includes(motion.state) && motion.age_s !== null ? motion.age_s + here : 0;
    const age = Math.max(here, there);
    if (!this.open) return { why: `Connection lost: data are ${age.toFixed(1)} s old`, age };
    if (age <= STALE_S) return { why: null, age };
    if (this.#delay > STALE_S) return { why: `The connection is slow: data are ${age.toFixed(1)} s old`, age };
    const who = here > STALE_S ? "the console’s server" : "the run";
    return { why: `No data from ${who} for ${age.toFixed(1)} s`, age };
  }

  /** Whether the message was sent. */
  send(message) {
    if (!this.open) return false;
    this.#socket.send(JSON.stringify(message));
    return true;
  }

  /** Sends a command; resolves to `{ok, what}`, also without an answer; the server begins none that is older. */
  command(command, fields = {}) {
    const id = ++this.#id;
    return new Promise((resolve) => {
      if (!this.send({ kind: "command", id, command, ...fields })) return resolve({ ok: false, what: "Not connected: the command was not sent." });
      const give = (answer) => {
        clearTimeout(timer);
        this.#answers.delete(id);
        resolve(answer);
      };
      const timer = LONG.includes(command) ? 0 : setTimeout(() => give({ ok: false, what: `No answer to “${command}” within ${ANSWER_MS / 1000} s.` }), ANSWER_MS);
      this.#answers.set(id, give);
    });
  }

  /** Requests a path stop by every available route; resolves to the first success, or else a failure. */
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
    this.#opened = performance.now();
    this.#ahead = -Infinity; // the server may be another one
    socket.addEventListener("open", () => (this.#tries = 0));
    socket.addEventListener("message", (event) => this.#take(JSON.parse(event.data)));
    socket.addEventListener("close", () => this.#closed());
  }

  #closed() {
    for (const give of [...this.#answers.values()]) give({ ok: false, what: "The connection was lost before an answer arrived." });
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
    const now = performance.now(), { seq, made_ms: made, echo } = message;
    this.send({ kind: "seen", seq, at_ms: now });
    this.state = message;
    if (echo) this.#ahead = Math.max(this.#ahead - DRIFT * (now - this.#received), echo.at_ms - echo.received_ms);
    this.#received = now;
    this.#delay = Math.max(0, echo ? now - made - this.#ahead : now - this.#opened) / 1000;
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
