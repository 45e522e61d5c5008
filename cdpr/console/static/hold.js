/* Hold-to-run: one press, from its begin to its end, as messages; no page in here, and the clock is given.

A press has a source (a pointer, a key, a stick) and a motion: `{direction}` of the platform, or `{cable, sense}` of one
cable. While it lasts `held` goes out every 50 ms, and `let_go` at once when
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
  #press = null; // {number, source, motion, share}
  // Rises with each press, over a reload as well.
  #number = Date.now();
  #seq = 0;
  #last = 0;

  /**
   * `send(message)` is false when it could not be sent; `whyNot(motion)` says why it is not possible, or null;
   * `settings(motion)` gives `{step_mm, speed_mm_s}` and of the platform `frame`; `changed(press, why)` hears of each
   * begin (null) and end; `clock` is for tests.
   */
  constructor(options) {
    this.#options = { clock: CLOCK, ...options };
  }

  get source() {
    return this.#press?.source ?? null;
  }

  /** Begins a press, or ends the one there is: two at once are a mistake. `share` is of the speed, 0 to 1. */
  press(source, motion, share = 1) {
    if (this.#press) return this.end(source === this.#press.source ? "pressed twice" : "a second control was pressed");
    const why = this.#options.whyNot(motion);
    if (why) return this.#options.changed(null, why);
    this.#press = { number: ++this.#number, source, motion: normed(motion), share };
    this.#last = this.#options.clock.now();
    this.#cancel = this.#options.clock.every(EVERY_MS, () => this.#tick());
    this.#options.changed(this.#press, null);
    this.#say();
  }

  /** A stick that is held farther, or less far; one that points elsewhere ends the press: its motion is fixed. */
  steer(source, motion, share) {
    if (this.#press?.source !== source) return;
    if (isSame(this.#press.motion, normed(motion))) this.#press.share = share;
    else this.end("the stick was turned");
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
    const why = this.#options.whyNot(this.#press.motion);
    if (why) return this.end(why);
    this.#last = now;
    this.#say();
  }

  #say() {
    const { number, motion, share } = this.#press, { speed_mm_s, ...settings } = this.#options.settings(motion);
    const message = { kind: "held", hold: number, ...motion, ...settings, speed_mm_s: share * speed_mm_s, seq: ++this.#seq };
    if (!this.#options.send(message)) this.end("the connection was lost");
  }
}

/** Of its directions, the longest angle apart that still is one: 45°. */
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
