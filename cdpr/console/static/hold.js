/* Hold-to-run: one press, from its begin to its end, as messages; no page in here, and the clock is given.

A press has a source (a pointer, a key, a stick). While it lasts `held` goes out every 50 ms, and `let_go` at once when
it ends, by whatever. A press that ended never comes back: the source has to be released and pressed again. */

const EVERY_MS = 50;
/** The server has ended a jog after 150 ms without a word: a page that was held up longer must not go on. */
const LONGEST_GAP_MS = 150;

/** The page's clock: milliseconds that only rise, and something done again and again until it is cancelled. */
const CLOCK = {
  now: () => performance.now(),
  every: (milliseconds, act) => {
    const timer = setInterval(act, milliseconds);
    return () => clearInterval(timer);
  },
};

export class Hold {
  #options;
  #cancel = null;
  #press = null; // {number, source, direction, share}
  // Rises with each press, over a reload as well.
  #number = Date.now();
  #seq = 0;
  #last = 0;

  /**
   * `send(message)` is false when it could not be sent; `whyNot()` says why no jog is possible, or null;
   * `settings()` gives `{frame, step_mm, speed_mm_s}`; `changed(press, why)` hears of each begin (null) and end;
   * `clock` is for tests.
   */
  constructor(options) {
    this.#options = { clock: CLOCK, ...options };
  }

  get source() {
    return this.#press?.source ?? null;
  }

  get direction() {
    return this.#press?.direction ?? null;
  }

  /** Begins a press, or ends the one there is: two at once are a mistake. `share` is of the speed, 0 to 1. */
  press(source, direction, share = 1) {
    if (this.#press) return this.end(source === this.#press.source ? "pressed twice" : "a second control was pressed");
    const why = this.#options.whyNot();
    if (why) return this.#options.changed(null, why);
    this.#press = { number: ++this.#number, source, direction: unit(direction), share };
    this.#last = this.#options.clock.now();
    this.#cancel = this.#options.clock.every(EVERY_MS, () => this.#tick());
    this.#options.changed(this.#press, null);
    this.#say();
  }

  /** A stick that is held in another direction. */
  steer(source, direction, share) {
    if (this.#press?.source === source) Object.assign(this.#press, { direction: unit(direction), share });
  }

  /** The source is no longer pressed. */
  release(source) {
    if (this.#press?.source === source) this.end("released");
  }

  /** Ends the press, if there is one. */
  end(why) {
    if (!this.#press) return;
    const { number } = this.#press;
    this.#cancel();
    this.#press = this.#cancel = null;
    this.#options.send({ kind: "let_go", hold: number });
    this.#options.changed(null, why);
  }

  #tick() {
    const now = this.#options.clock.now(), gap = now - this.#last;
    if (gap > LONGEST_GAP_MS) return this.end(`this page was held up for ${Math.round(gap)} ms`);
    const why = this.#options.whyNot();
    if (why) return this.end(why);
    this.#last = now;
    this.#say();
  }

  #say() {
    const { number, direction, share } = this.#press, { frame, step_mm, speed_mm_s } = this.#options.settings();
    const message = { kind: "held", hold: number, direction, frame, step_mm, speed_mm_s: share * speed_mm_s, seq: ++this.#seq };
    if (!this.#options.send(message)) this.end("the connection was lost");
  }
}

function unit(direction) {
  const length = Math.hypot(...direction);
  return direction.map((v) => v / length);
}
