/* The jog panels of the platform and of one cable: buttons, keys and a gamepad hold the single press of hold.js. */

import { at, capital, chosen, exact, known, make, mark, write } from "./elements.js";
import { Hold } from "./hold.js";
import { whyNot } from "./buttons.js";

/** Axes of the standard gamepad: left stick x and y, right stick z, each beyond the dead zone. */
const DEAD_ZONE = 0.25, POLL_MS = 50, SHOULDERS = [4, 5];

function beyond(v) {
  return Math.abs(v) < DEAD_ZONE ? 0 : v;
}

function stepOf(group) {
  const step = chosen(group);
  return step === "null" ? null : Number(step);
}

/** Differences between the two panels, by panel name. */
const PADS = {
  jog: {
    view: "jog",
    keys: { ArrowRight: "+x", ArrowLeft: "-x", ArrowUp: "+y", ArrowDown: "-y", PageUp: "+z", PageDown: "-z" },
    motion: (name) => ({ direction: ["x", "y", "z"].map((axis) => (axis === name[1] ? (name[0] === "+" ? 1 : -1) : 0)) }),
    settings: () => ({ frame: chosen("jog-frame") }),
    stick: ([x, y, , up]) => {
      const direction = [x, -y, -up].map(beyond);
      return { share: Math.hypot(...direction), motion: { direction } };
    },
  },
  cable: {
    view: "service",
    keys: { ArrowUp: "wind_in", PageUp: "wind_in", ArrowDown: "pay_out", PageDown: "pay_out" },
    motion: (name) => ({ cable: Number(chosen("cable")), sense: name }),
    settings: () => ({}),
    stick: ([, left, , right]) => {
      const v = beyond(Math.abs(left) > Math.abs(right) ? left : right);
      return { share: Math.abs(v), motion: PADS.cable.motion(v < 0 ? "wind_in" : "pay_out") };
    },
  },
};
const motionOf = (button) => PADS[button.closest("#jog-pad") ? "jog" : "cable"].motion(button.dataset.jog);
const panelOf = (motion) => (motion.direction ? "jog" : "cable");

/**
 * Binds both panels. `situation()` as in buttons.js; `command(name)` sends a command. Returns `end(why)`, to be called
 * when the page changes during a press, and `show(state)`.
 */
export function bindJog(connection, situation, command) {
  const hold = new Hold({
    send: (message) => connection.send(message.kind === "held" ? { ...message, state: connection.state.seq } : message),
    whyNot: (motion) => (document.hasFocus() && !document.hidden ? whyNot(panelOf(motion), situation()) : "this page does not have the focus"),
    settings: (motion) => {
      const panel = panelOf(motion);
      return { ...PADS[panel].settings(), step_mm: stepOf(`${panel}-step`), speed_mm_s: Number(at(`${panel}-speed`).value) };
    },
    changed: (press, why) => {
      const isOn = press !== null && !press.source.startsWith("gamepad"), held = isOn && JSON.stringify(press.motion);
      for (const button of document.querySelectorAll("[data-jog]")) button.classList.toggle("held", isOn && JSON.stringify(motionOf(button)) === held);
      const text = press ? "Held" : why === "released" ? "Released" : `Ended: ${why}`;
      for (const panel of Object.keys(PADS)) write(at(`${panel}-said`), text);
    },
  });

  for (const panel of Object.keys(PADS)) {
    bindKeys(at(`${panel}-pad`), hold, PADS[panel]);
    bindGamepad(panel, hold, PADS[panel]);
    at(`${panel}-speed`).addEventListener("input", () => showSpeed(panel));
    at(`${panel}-end`).addEventListener("click", () => {
      hold.end("jogging ended");
      command("jog_end");
    });
    showSpeed(panel);
  }
  at("jog-begin").addEventListener("click", () => command("jog_begin"));
  bindPointers(hold);
  bindEnds(hold);
  at("cables").addEventListener("change", () => hold.end("another cable was selected"));
  for (const event of ["stale", "closed"]) connection.addEventListener(event, () => hold.end("data are too old"));

  return {
    end: (why) => hold.end(why),
    show: (state) => {
      showPlatform(state, hold.source !== null);
      showCable(state, hold.source !== null);
    },
  };
}

/** The limit of a jog in words: its values are predicted beyond it, not the present ones. */
function ahead({ limit, room_mm: room, moving }) {
  if (!limit || room === undefined) return limit ?? ""; // single cables: a limit that is reached
  return `${moving ? `Limit ahead: comes to rest within ${room.toFixed(1)} mm.` : "Limit reached."} Farther on: ${limit}`;
}

/** What a pad says: moving only if the position changes. */
function stateText(jog, isHeld, moving, ready) {
  if (!jog.ready) return null;
  if (jog.moving) return moving;
  return isHeld ? "At rest: release, then press again" : ready;
}

function showPad(panel, jog, text, isHeld) {
  at(`${panel}-pad`).classList.toggle("ready", jog.ready);
  write(at(`${panel}-state`), capital(text));
  if (jog.speed_mm_s) mark(at(`${panel}-speed`), "max", String(jog.speed_mm_s)); // the limit of the session
  showSpeed(panel);
  const limit = jog.not_begun ? `Not begun: ${jog.not_begun}. End jogging, then enable it again.` : jog.moving || isHeld ? ahead(jog) : "";
  write(at(`${panel}-limit`), limit);
  at(`${panel}-limit`).hidden = !limit;
}

function showPlatform({ jog, platform, clearance_mm: clearance }, isHeld) {
  const here = ["x", "y", "z"].map((axis, k) => `${axis}\u00a0${known(platform?.position_mm[k], 1)}`).join("  ");
  write(at("jog-here"), `${here}\u00a0mm · clearance ${known(clearance?.now, 0, "mm")}`);
  showPad("jog", jog, stateText(jog, isHeld, "Moving", "Ready: hold a button to move") ?? (jog.why_not || "The drives are not enabled for jogging"), isHeld);
}

function showCable({ cable: jog, tensions_n: tensions, tension_limits_n: [low, high] }, isHeld) {
  const list = at("cables"), count = tensions?.length ?? 0;
  if (count && list.querySelectorAll("input").length !== count) makeCables(list, count);
  const number = Number(chosen("cable")), tension = tensions?.[number - 1] ?? null, limit = jog.limit_n ?? high, full = 1.1 * limit;
  const track = at("cable-track");
  track.style.setProperty("--low", `${(100 * low) / 2 / full}%`);
  track.style.setProperty("--high", `${(100 * limit) / full}%`);
  at("cable-bar").style.width = `${tension === null ? 0 : Math.min(100, Math.max(0, (100 * tension) / full))}%`;
  at("cable-bar").style.background = tension === null ? "" : globalThis.tensionColour((tension - low / 2) / (limit - low / 2));
  write(at("cable-tension"), number ? `Cable ${number}: ${known(tension, 1, "N")}` : "No cable data yet");
  write(at("cable-range"), `slack below ${exact(low / 2, "N")}, limit ${exact(limit, "N")}`);
  const sense = (mm) => (Math.abs(mm) < 0.0005 ? "not moved" : `${known(Math.abs(mm), 3, "mm")} ${mm > 0 ? "paid out" : "wound in"}`);
  const own = jog.cable === number ? `This press: ${sense(jog.press_mm)} · since` : "Since";
  write(at("cable-travel"), jog.ready && number ? `${own} the session began ${sense(jog.session_mm[number - 1])}` : "");
  showPad("cable", jog, stateText(jog, isHeld, `Cable ${jog.cable} moves`, "Ready: hold a button to move the cable") ?? (jog.why_not || "The drives are not enabled"), isHeld);
}

/** Cable numbers as in the scene; the first is selected. */
function makeCables(list, count) {
  const choices = Array.from({ length: count }, (_, k) =>
    make("label", {}, make("input", { type: "radio", name: "cable", value: String(k + 1), "data-button": "cable_setting", checked: k === 0, "aria-label": `Cable ${k + 1}` }), make("span", {}, String(k + 1))));
  list.replaceChildren(list.querySelector("legend"), ...choices);
}

function showSpeed(panel) {
  const slider = at(`${panel}-speed`);
  write(at(`${panel}-speed-shown`), known(Number(slider.value), 0, "mm/s"));
  mark(slider, "aria-valuetext", `${slider.value} millimetres per second`);
}

function bindPointers(hold) {
  const down = new Set(); // pointers down anywhere on the page
  let refused = null; // a pointer that ended a press must not begin the next
  window.addEventListener("pointerdown", (event) => {
    down.add(event.pointerId);
    refused = hold.source === null ? null : event.pointerId;
    hold.end("a second pointer");
  }, { capture: true });
  for (const name of ["pointerup", "pointercancel"]) window.addEventListener(name, (event) => {
    down.delete(event.pointerId);
    hold.release(`pointer ${event.pointerId}`);
  }, { capture: true });
  window.addEventListener("pointermove", (event) => {
    if (hold.source === `pointer ${event.pointerId}` && event.buttons !== 1) hold.end("another mouse button");
  }, { capture: true });
  for (const button of document.querySelectorAll("[data-jog]")) {
    button.addEventListener("pointerdown", (event) => {
      if (event.button !== 0 || down.size > 1 || refused === event.pointerId || button.getAttribute("aria-disabled")) return;
      button.setPointerCapture(event.pointerId);
      hold.press(`pointer ${event.pointerId}`, motionOf(button));
    });
    button.addEventListener("lostpointercapture", (event) => hold.release(`pointer ${event.pointerId}`));
    // A long touch is a press, not the browser's menu.
    button.addEventListener("touchstart", (event) => event.preventDefault(), { passive: false });
  }
}

/** Arrow and page keys while the pad has the focus; Enter presses the focused button. */
function bindKeys(pad, hold, { keys, motion }) {
  pad.addEventListener("keydown", (event) => {
    const name = event.key === "Enter" ? event.target.dataset.jog : keys[event.key];
    if (name) event.preventDefault();
    if (event.repeat) return;
    if (hold.source !== null) return hold.end("a second key");
    if (!name || event.ctrlKey || event.altKey || event.metaKey || event.shiftKey) return;
    hold.press(`key ${event.code}`, motion(name));
  });
  window.addEventListener("keyup", (event) => hold.release(`key ${event.code}`), { capture: true });
  pad.addEventListener("focusout", (event) => {
    if (!pad.contains(event.relatedTarget)) hold.end("the focus left the pad");
  });
}

function bindEnds(hold) {
  window.addEventListener("blur", () => hold.end("the window lost the focus"));
  window.addEventListener("pagehide", () => hold.end("the page was left"));
  document.addEventListener("visibilitychange", () => document.hidden && hold.end("the page is hidden"));
  window.addEventListener("contextmenu", (event) => {
    if (hold.source !== null || (event.target instanceof Element && event.target.closest("#jog-pad, #cable-pad"))) event.preventDefault();
    hold.end("a menu was opened");
  }, { capture: true });
}

/** Needs a shoulder button held first, then a deflected stick: a stick alone moves nothing. */
function bindGamepad(panel, hold, { view, stick }) {
  const box = at(`${panel}-gamepad`), text = at(`${panel}-gamepad-state`), source = `gamepad ${panel}`;
  let centred = false; // since the last press: a stick still deflected after its press ended must not begin another

  function poll() {
    const pad = box.checked ? [...navigator.getGamepads()].find((one) => one?.connected && one.mapping === "standard") : null;
    write(text, !box.checked ? "" : pad ? "Connected: hold a shoulder button and move a stick" : "No gamepad found: press any of its buttons");
    if (!pad) {
      centred = false;
      return hold.release(source);
    }
    const { share, motion } = stick(pad.axes);
    const enabled = SHOULDERS.some((k) => pad.buttons[k]?.pressed);
    if (share === 0 || !enabled) {
      centred = share === 0;
      return hold.release(source);
    }
    if (hold.source === source) hold.steer(source, motion, Math.min(1, share));
    else if (centred && at(`panel-${view}`).checkVisibility()) {
      centred = false;
      hold.press(source, motion, Math.min(1, share));
    }
  }

  setInterval(poll, POLL_MS);
  window.addEventListener("gamepaddisconnected", () => {
    centred = false;
    hold.release(source);
  });
  box.addEventListener("change", () => hold.end("the gamepad was switched on or off"));
}
