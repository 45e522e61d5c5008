/* Hold-to-run: one press from begin to end, as messages; independent of the page and its clock.

A press has a source (a pointer, a key, a stick) and a motion: `{direction}` of the platform, or `{cable, sense}` of one
cable. `held` is sent every 50 ms while it lasts, and `let_go` immediately when it ends, for any reason. An ended press
never continues: the source has to be released and pressed again. */

const EVERY_MS = 50;
/** The run ends a jog after 150 ms without a message: a page delayed for longer must not continue. */
const LONGEST_GAP_MS = 150;

/** The page's clock: monotonic milliseconds, and a repeated call that can be cancelled. */
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
  #press = null; // {number, source, motion, share}
  // Rises with each press, also across a reload.
  #number = Date.now();
  #seq = 0;
  #last = 0;

  /**
   * `send(message)` returns false if not sent; `whyNot(motion)` returns a reason or null; `settings(motion)` returns
   * `{step_mm, speed_mm_s}`, and `frame` for the platform; `changed(press, why)` is called at each begin (null) and end;
   * `clock` is for tests.
   */
  constructor(options) {
    this.#options = { clock: CLOCK, ...options };
  }

  get source() {
    return this.#press?.source ?? null;
  }

  /** Begins a press, or ends the present one: two at once are an error. `share` is a fraction of the speed, 0 to 1. */
  press(source, motion, share = 1) {
    if (this.#press) return this.end(source === this.#press.source ? "pressed twice" : "a second control was pressed");
    const why = this.#options.whyNot(motion);
    if (why) return this.#options.changed(null, why);
    this.#press = { number: ++this.#number, source, motion: normed(motion), share };
    this.#last = this.#options.clock.now();
    this.#cancel = this.#options.clock.every(EVERY_MS, () => this.#tick());
    this.#options.changed(this.#press, null);
    this.#sendHeld();
  }

  /** A stick's deflection changes the speed; a new direction ends the press, as its motion is fixed. */
  steer(source, motion, share) {
    if (this.#press?.source !== source) return;
    if (isSame(this.#press.motion, normed(motion))) this.#press.share = share;
    else this.end("the stick changed direction");
  }

  /** The source was released. */
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
    if (gap > LONGEST_GAP_MS) return this.end(`this page was delayed by ${Math.round(gap)} ms`);
    const why = this.#options.whyNot(this.#press.motion);
    if (why) return this.end(why);
    this.#last = now;
    this.#sendHeld();
  }

  #sendHeld() {
    const { number, motion, share } = this.#press, { speed_mm_s, ...settings } = this.#options.settings(motion);
    const message = { kind: "held", hold: number, ...motion, ...settings, speed_mm_s: share * speed_mm_s, seq: ++this.#seq };
    if (!this.#options.send(message)) this.end("the connection was lost");
  }
}

/** Cosine of the largest angle between directions of one press, 45°. */
const SAME = Math.SQRT1_2;

function isSame(one, other) {
  if (one.direction && other.direction) return one.direction.reduce((sum, v, k) => sum + v * other.direction[k], 0) > SAME;
  return one.cable === other.cable && one.sense === other.sense;
}

function normed(motion) {
  if (!motion.direction) return motion;
  const length = Math.hypot(...motion.direction);
  return { direction: motion.direction.map((v) => v / length) };
}
