/* The jog panel: buttons, keys and a gamepad, each of which holds the one press of hold.js. */

import { at, chosen, known, mark, write } from "./elements.js";
import { Hold } from "./hold.js";
import { whyNot } from "./buttons.js";

const KEYS = { ArrowRight: "+x", ArrowLeft: "-x", ArrowUp: "+y", ArrowDown: "-y", PageUp: "+z", PageDown: "-z" };
/** Axes of the standard gamepad: left stick x and y, right stick up and down; a stick counts beyond the dead zone. */
const DEAD_ZONE = 0.25, POLL_MS = 50, SHOULDERS = [4, 5];

function vectorOf(name) {
  const sign = name[0] === "+" ? 1 : -1;
  return ["x", "y", "z"].map((axis) => (axis === name[1] ? sign : 0));
}

/**
 * Binds the panel. `situation()` as in buttons.js; `command(name)` sends one. The answer has `end(why)`, to be called
 * when the page changes under the operator's hands, and `show(state)`.
 */
export function bindJog(connection, situation, command) {
  const pad = at("jog-pad"), said = at("jog-said");
  const hold = new Hold({
    send: (message) => connection.send(message),
    whyNot: () => (document.hasFocus() && !document.hidden ? whyNot("jog", situation()) : "this page does not have the focus"),
    settings: () => ({
      frame: chosen("jog-frame"),
      step_mm: chosen("jog-step") === "null" ? null : Number(chosen("jog-step")),
      speed_mm_s: Number(at("jog-speed").value),
    }),
    changed: (press, why) => {
      for (const button of pad.querySelectorAll("[data-jog]"))
        button.classList.toggle("held", press !== null && !String(press.source).startsWith("gamepad") && vectorOf(button.dataset.jog).join() === press.direction.join());
      write(said, press ? "Held" : why === "released" ? "Released" : `Ended: ${why}`);
    },
  });

  bindPointers(pad, hold);
  bindKeys(pad, hold);
  bindEnds(hold);
  bindGamepad(hold);
  at("jog-speed").addEventListener("input", showSpeed);
  at("jog-begin").addEventListener("click", () => command("jog_begin"));
  at("jog-end").addEventListener("click", () => {
    hold.end("jogging ended");
    command("jog_end");
  });
  for (const event of ["stale", "closed"]) connection.addEventListener(event, () => hold.end("data are too old"));
  showSpeed();

  return {
    end: (why) => hold.end(why),
    show: ({ jog, platform, clearance_mm: clearance }) => {
      const here = ["x", "y", "z"].map((axis, k) => `${axis}\u00a0${known(platform?.position_mm[k], 1)}`).join("  ");
      write(at("jog-here"), `${here}\u00a0mm · clearance ${known(clearance?.now, 0, "mm")}`);
      pad.classList.toggle("ready", jog.ready);
      const text = jog.ready ? (jog.moving ? "Moving" : "Ready: hold a button to move") : jog.why_not || "The drives are not enabled for jogging";
      write(at("jog-state"), text);
      if (jog.speed_mm_s) mark(at("jog-speed"), "max", String(jog.speed_mm_s)); // the fastest that it may be
      showSpeed();
      write(at("jog-limit"), jog.limit ?? "");
      at("jog-limit").hidden = !jog.limit;
    },
  };
}

function showSpeed() {
  write(at("jog-speed-shown"), known(Number(at("jog-speed").value), 0, "mm/s"));
  mark(at("jog-speed"), "aria-valuetext", `${at("jog-speed").value} millimetres per second`);
}

function bindPointers(pad, hold) {
  const down = new Set(); // pointers that are down anywhere on the page
  let refused = null; // the pointer that ended a press must not begin the next
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
    if (hold.source === `pointer ${event.pointerId}` && event.buttons !== 1) hold.end("another button of the mouse");
  }, { capture: true });
  for (const button of pad.querySelectorAll("[data-jog]")) {
    button.addEventListener("pointerdown", (event) => {
      if (event.button !== 0 || down.size > 1 || refused === event.pointerId || button.getAttribute("aria-disabled")) return;
      button.setPointerCapture(event.pointerId);
      hold.press(`pointer ${event.pointerId}`, vectorOf(button.dataset.jog));
    });
    button.addEventListener("lostpointercapture", (event) => hold.release(`pointer ${event.pointerId}`));
    // A long touch is a press, not the menu of the browser.
    button.addEventListener("touchstart", (event) => event.preventDefault(), { passive: false });
  }
}

/** Arrows and page keys while the pad has the focus; Enter presses the button that has it. */
function bindKeys(pad, hold) {
  pad.addEventListener("keydown", (event) => {
    const name = event.key === "Enter" ? event.target.dataset.jog : KEYS[event.key];
    if (name) event.preventDefault();
    if (event.repeat) return;
    if (hold.source !== null) return hold.end("a second key");
    if (!name || event.ctrlKey || event.altKey || event.metaKey || event.shiftKey) return;
    hold.press(`key ${event.code}`, vectorOf(name));
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
    if (hold.source !== null || (event.target instanceof Element && event.target.closest("#jog-pad"))) event.preventDefault();
    hold.end("a menu was opened");
  }, { capture: true });
}

/** A shoulder button held and a stick away from its centre, in that order: a stick alone moves nothing. */
function bindGamepad(hold) {
  const box = at("jog-gamepad"), text = at("jog-gamepad-state");
  let centred = false; // since the last press: a stick that is still held after its press ended must not begin another

  function poll() {
    const pad = box.checked ? [...navigator.getGamepads()].find((one) => one?.connected && one.mapping === "standard") : null;
    write(text, !box.checked ? "" : pad ? "Connected: hold a shoulder button and move a stick" : "No gamepad found: press one of its buttons");
    if (!pad) {
      centred = false;
      return hold.release("gamepad");
    }
    const [x, y, , up] = pad.axes, direction = [x, -y, -up].map((v) => (Math.abs(v) < DEAD_ZONE ? 0 : v));
    const share = Math.min(1, Math.hypot(...direction));
    const enabled = SHOULDERS.some((k) => pad.buttons[k]?.pressed);
    if (share === 0 || !enabled) {
      centred = share === 0;
      return hold.release("gamepad");
    }
    if (hold.source === "gamepad") hold.steer("gamepad", direction, share);
    else if (centred && at("panel-jog").checkVisibility()) {
      centred = false;
      hold.press("gamepad", direction, share);
    }
  }

  setInterval(poll, POLL_MS);
  window.addEventListener("gamepaddisconnected", () => {
    centred = false;
    hold.release("gamepad");
  });
  box.addEventListener("change", () => hold.end("the gamepad was switched"));
}
