/* Random sequences of presses, releases, refusals, lost connections and pauses, in simulated time, against hold.js.

Returns errors as texts, and how many messages were sent: `(Hold, rounds, seed) => {wrong, held, ended}`. */
(Hold, rounds, seed) => {
  const random = () => { // mulberry32
    seed = (seed + 0x6d2b79f5) | 0;
    let t = Math.imul(seed ^ (seed >>> 15), 1 | seed);
    t = (t + Math.imul(t ^ (t >>> 7), 61 | t)) ^ t;
    return ((t ^ (t >>> 14)) >>> 0) / 2 ** 32;
  };
  const one = (list) => list[Math.floor(random() * list.length)];
  const wrong = [], over = new Set(), letGo = new Map(), sources = ["pointer 1", "key ArrowUp", "gamepad"];
  let now = 0, act = null, due = Infinity, open = true, refusal = null;
  let said = "", press = null, newest = 0, last = 0, held = 0, ended = 0; // press: {source, number} as the page sees it

  const clock = {
    now: () => now,
    every: (milliseconds, then) => {
      [act, due] = [then, now + milliseconds];
      return () => ([act, due] = [null, Infinity]);
    },
  };
  const send = (message) => {
    if (message.kind === "let_go") {
      letGo.set(message.hold, (letGo.get(message.hold) ?? 0) + 1);
      over.add(message.hold);
      ended += 1;
      return open;
    }
    held += 1;
    if (over.has(message.hold)) wrong.push(`held ${message.hold} after its end`);
    if (message.hold < newest) wrong.push(`held ${message.hold} after ${newest}`);
    if (!press || !press.pressed) wrong.push(`held ${message.hold} though nothing is pressed`);
    if (refusal) wrong.push(`held although ${refusal}`);
    if (message.hold === newest && now - last > 150) wrong.push(`held after ${now - last} ms of silence`);
    if (message.cable ? message.direction || !message.sense : Math.abs(Math.hypot(...message.direction) - 1) > 1e-9) wrong.push("neither a direction of length 1 nor a cable");
    const motion = JSON.stringify([message.cable, message.sense, message.direction]);
    if (message.hold === newest && motion !== said) wrong.push(`the motion of ${message.hold} changed`);
    said = motion;
    [newest, last] = [message.hold, now];
    return open;
  };
  const hold = new Hold({
    send, clock, whyNot: () => refusal, settings: (motion) => ({ ...(motion.direction && { frame: "world" }), step_mm: null, speed_mm_s: 5 }),
    changed: (begun) => (press = begun ? { source: begun.source, pressed: true } : null),
  });
  const moves = [
    () => hold.press(one(sources), { direction: [random() - 0.5, random() - 0.5, random() + 0.1] }),
    () => hold.press(one(sources), { cable: one([1, 5]), sense: one(["wind_in", "pay_out"]) }, random()),
    () => hold.steer(one(sources), one([{ direction: [0, random() + 0.1, 0] }, { cable: 1, sense: "wind_in" }]), random()),
    () => {
      const source = one(sources);
      if (press?.source === source) press.pressed = false;
      hold.release(source);
    },
    () => {
      if (press) press.pressed = false;
      hold.end("blur");
    },
    () => (refusal = random() < 0.3 ? "stale" : null),
    () => (open = random() < 0.8),
    () => (now += random() < 0.1 ? 1000 * random() : 0), // the page is delayed: no tick came in time
    ...Array(4).fill(() => {
      for (const until = now + 120 * random(); due <= until; ) {
        now = Math.max(now, due);
        due = now + 50;
        act();
      }
    }),
  ];
  for (let round = 0; round < rounds; round++) one(moves)();
  hold.end("the test ended");
  for (const [number, count] of letGo) if (count !== 1) wrong.push(`${number} was let go ${count} times`);
  return { wrong: wrong.slice(0, 5), held, ended };
}
