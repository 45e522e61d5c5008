/* When each button is enabled, and the reason when not: one table, applied to the page.

`situation` is `{ state, stale, preview, form }`: the server's last state, why it is stale (text) or null, the loaded
plan, and what is selected on the page: `{ plan_file, scene_file, from_here }`. */

import { capital, mark, write } from "./elements.js";

const MOVING = ["enabling", "approaching", "moving", "holding", "stopping", "securing"];
const ACTIVE = ["preparing", ...MOVING];
const VERBS = { run: "A run is in progress", home: "Homing is in progress", reset: "A reset is in progress", release: "The drives are being released", plan: "Planning is in progress", jog: "Jogging is enabled: end it first", load: "A plan is being loaded" };

export const isActive = (motion) => motion !== null && ACTIVE.includes(motion.state);
/** STOP does not reach such a motion. */
export const isMovedByAnother = (state) => Number.isInteger(state.moved_by);
const isJogging = ({ busy, jog, cable }) => jog.ready || cable.ready || busy?.verb === "jog";

/** Each gives a reason, or null if fulfilled; `BUTTONS` orders them. */
const REQUIREMENTS = {
  fresh: ({ stale, state }) => stale ?? (state ? null : "Waiting for data"),
  writable: ({ state }) => (state.read_only ? "This console is read-only" : null),
  control: ({ state: { control } }) =>
    control.yours ? null : control.held_by ? `${control.held_by} has control` : "Take control first",
  not_mine: ({ state }) => (state.control.yours ? "You have control" : null),
  latched: ({ state }) => (state.latched === null ? "No fault is latched" : null),
  unlatched: ({ state }) => (state.latched === null ? null : "A fault is latched: reset it first"),
  homed: ({ state: { reference } }) => (reference.counts ? null : reference.why_not || "The drives are not homed"),
  idle: ({ state }) => {
    if (state.busy) return VERBS[state.busy.verb] ?? "A command is in progress";
    if (state.jog.ready || state.cable.ready) return VERBS.jog;
    if (isMovedByAnother(state)) return `Process ${state.moved_by} of another user moves or resets the robot`;
    if (state.motion?.state === "preparing") return "A motion is being prepared";
    return isActive(state.motion) ? "The platform is in motion" : null;
  },
  moves: ({ state: { motion } }) => (motion && MOVING.includes(motion.state) ? null : "No motion of this user is in progress"),
  path: ({ state }) => (isJogging(state) ? "A jog has no path: release the control to stop" : null),
  going: ({ state: { motion } }) => (motion.wished.stop || ["stopping", "securing"].includes(motion.state) ? "The run is stopping" : null),
  unheld: ({ state: { motion } }) => (motion.wished.hold ? "The run is already held" : null),
  held: ({ state: { motion } }) => (motion.wished.hold ? null : "The run is not held"),
  planned: ({ state }) => (state.preview ? null : "Load or make a plan first"),
  proved: ({ preview }) => (preview === undefined || !preview ? "The plan is loading" : preview.passed ? null : "The plan did not pass its check"),
  jogging: ({ state }) => (isJogging(state) ? null : "Jogging is not enabled"),
  jog_ready: ({ state: { jog } }) => (jog.ready ? null : jog.why_not || "Enable the drives for jogging first"),
  cable_ready: ({ state: { cable } }) => (cable.ready ? null : cable.why_not || "Enable the drives for single cables first"),
  service: ({ state: { control } }) => (control.mode === "service" ? null : "Enter service mode first"),
  not_service: ({ state: { control } }) => (control.mode === "service" ? "This page is in service mode" : null),
  idle_but_cables: (situation) => (situation.state.cable.ready ? null : REQUIREMENTS.idle(situation)),
  located: ({ state }) => (state.platform ? null : "The platform’s position is unknown"),
  plan_file: ({ form }) => (form.plan_file ? null : "Select a plan file first"),
  scene_file: ({ form }) => (form.scene_file ? null : "Select a scene file first"),
  poses: ({ state }) => (state.poses.length ? null : "No pose has been taught"),
  path_poses: (situation) => {
    if (situation.form.from_here) return REQUIREMENTS.poses(situation) ?? REQUIREMENTS.located(situation);
    return situation.state.poses.length > 1 ? null : "Teach two poses first";
  },
};

const OPERATOR = ["fresh", "writable", "control"];

/** Requirements of each button; STOP has none. */
export const BUTTONS = {
  stop: [],
  take_control: ["fresh", "writable", "not_mine"],
  give_control: OPERATOR,
  hold: [...OPERATOR, "path", "moves", "going", "unheld"],
  resume: [...OPERATOR, "path", "moves", "going", "held"],
  speed: [...OPERATOR, "path", "moves", "going"],
  home: [...OPERATOR, "idle", "unlatched"],
  reset: [...OPERATOR, "idle", "latched"],
  release: [...OPERATOR, "idle"],
  read_drives: [...OPERATOR, "idle"],
  plan_files: [...OPERATOR, "idle"],
  load_plan: [...OPERATOR, "idle", "plan_file"],
  compare: [...OPERATOR, "idle", "planned", "plan_file"],
  compare_end: [...OPERATOR, "idle"],
  scene_files: [...OPERATOR, "idle"],
  plan: [...OPERATOR, "idle", "scene_file"],
  plan_setting: ["fresh", "writable"],
  plan_poses: [...OPERATOR, "path_poses", "idle"],
  go_to: [...OPERATOR, "poses", "located", "idle"],
  run: [...OPERATOR, "idle", "unlatched", "homed", "planned", "proved"],
  jog_begin: [...OPERATOR, "idle", "unlatched", "homed"],
  jog_end: [...OPERATOR, "jogging"],
  jog: [...OPERATOR, "unlatched", "jog_ready"],
  jog_setting: ["fresh", "writable"],
  service_begin: [...OPERATOR, "not_service", "idle_but_cables"],
  service_end: [...OPERATOR, "service"],
  cable_begin: [...OPERATOR, "service", "idle", "unlatched"],
  cable: [...OPERATOR, "service", "unlatched", "cable_ready"],
  cable_setting: ["fresh", "writable"],
  teach: [...OPERATOR, "located"],
  teach_at: [...OPERATOR, "located"],
  edit_pose: [...OPERATOR, "poses"],
};

/** Why a button is disabled, or null. */
export function whyNot(button, situation) {
  for (const name of BUTTONS[button]) {
    const reason = REQUIREMENTS[name](situation);
    if (reason) return capital(reason);
  }
  return null;
}

/** Shows at the top of each panel why its controls are inactive, and offers to take control where that is the reason. */
function showReasons(root, { stale, state }, reasons) {
  for (const line of root.querySelectorAll(".why")) {
    const jogs = state && (state.jog.ready || state.busy?.verb === "jog");
    const button = { jog: jogs ? "jog" : "jog_begin", teach: "teach", service: "give_control" }[line.dataset.panel];
    const reason = reasons[button], isFree = !stale && state && !state.read_only && !state.control.yours;
    const text = isFree && !state.control.held_by ? "Control is free: take it to use these controls." : reason ? `${reason}.` : "You have control.";
    write(line.querySelector("span"), text);
    line.classList.toggle("quiet", !reason);
    line.querySelector("button").hidden = !isFree;
  }
}

/** Updates every element with `data-button`; disabled buttons stay focusable, so that the reason can be read. */
export function applyButtons(root, situation) {
  const reasons = Object.fromEntries(Object.keys(BUTTONS).map((name) => [name, whyNot(name, situation)]));
  for (const element of root.querySelectorAll("[data-button]")) {
    const reason = reasons[element.dataset.button];
    const button = element instanceof HTMLButtonElement;
    if (!button) element.disabled = reason !== null;
    mark(element, "aria-disabled", reason === null ? null : "true");
    mark(element, "aria-description", reason);
    mark(element, "title", reason ?? element.dataset.title ?? null);
  }
  showReasons(root, situation, reasons);
}

/** A press of a disabled button, or one that ends while data are stale, only shows the reason, by `say(text, failed)`. */
export function guardButtons(root, say) {
  const nameOf = (button) => button.dataset.name ?? button.textContent.trim();
  let pressed = null; // by the pointer that is down
  root.addEventListener("click", (event) => {
    const button = event.target instanceof Element && event.target.closest("button[aria-disabled=true]");
    if (!button) return;
    event.preventDefault();
    event.stopImmediatePropagation();
    say(`${nameOf(button)}: ${button.getAttribute("aria-description")}.`);
  }, { capture: true });
  window.addEventListener("pointerdown", ({ target, button, isPrimary }) => {
    if (isPrimary) pressed = button === 0 && target instanceof Element ? target.closest("button[data-button]:not([data-jog])") : null;
  }, { capture: true });
  window.addEventListener("pointerup", ({ isPrimary }) => {
    if (!isPrimary) return;
    // No click follows on a button that has become inert.
    if (pressed?.closest("[inert]") && pressed.getAttribute("aria-disabled")) say(`${nameOf(pressed)}: not done. ${pressed.getAttribute("aria-description")}.`, true);
    pressed = null;
  }, { capture: true });
}
