/* The console's page: creates its parts and passes each state to them. */

import { applyButtons, guardButtons, isActive } from "./buttons.js";
import { Connection } from "./connection.js";
import { Curves } from "./curves.js";
import { cancelDialog, checkDialog } from "./dialog.js";
import { at, chosen, known, mark, write } from "./elements.js";
import { Events } from "./events.js";
import { bindJog } from "./jog.js";
import { Live, motionText } from "./live.js";
import { News } from "./news.js";
import { Operate } from "./operate.js";
import { Pick } from "./pick.js";
import { Pictures } from "./pictures.js";
import { Scene } from "./scene.js";
import { bindStop } from "./stop.js";
import { Teach } from "./teach.js";

const NOTICE_MS = { done: 4000, failed: 10000 };
const connection = new Connection();
const scene = new Scene();
const form = () => ({ plan_file: chosen("plan-file"), scene_file: chosen("scene-file"), from_here: at("plan-from-here").checked });
const situation = () => ({ state: connection.state, stale: connection.freshness().why, preview: operate.plan, form: form() });
let noticed = 0; // timer of the last notice

/** Shows a text below the panels for a while: the server's answer, or why a command was not executed. */
function say(text, failed = false) {
  write(at("notice"), text);
  at("notice-box").classList.toggle("failed", failed);
  at("notice-box").hidden = !text;
  clearTimeout(noticed);
  noticed = setTimeout(() => (at("notice-box").hidden = true), failed ? NOTICE_MS.failed : NOTICE_MS.done);
}
at("notice-seen").addEventListener("click", () => (at("notice-box").hidden = true));

async function command(name, fields) {
  const earlier = noticed, answer = await connection.command(name, fields);
  if (answer.what || !answer.ok) say(answer.what || `“${name}” was refused.`, !answer.ok);
  else if (noticed === earlier) at("notice-box").hidden = true; // about what was before
  return answer;
}

/** Shows the scene on a narrow screen, where it is a separate view. */
const showScene = () => wide.matches || view("live");
const page = { command, situation, say, scene, view, showScene };
const stopBar = bindStop(connection, () => {
  leaveControl();
  cancelDialog();
  jog.end("STOP");
}, () => {
  const { state, stale } = situation();
  return !stale && state.simulated && !state.jog.ready && !state.cable.ready && !isActive(state.motion);
});
const live = new Live(), curves = new Curves(), events = new Events(), pictures = new Pictures(), teach = new Teach(page), pick = new Pick(page), operate = new Operate(page), news = new News(page);
const jog = bindJog(connection, situation, command);

// Views: beside the live view on a wide screen, one of six on a narrow one.
const tabs = [...document.querySelectorAll("[role=tab]")];
const wide = matchMedia("(min-width: 900px)");

function view(name) {
  const chosen = wide.matches && name === "live" ? "operate" : name;
  if (document.body.dataset.view !== chosen) {
    jog.end("another view was selected");
    document.body.dataset.view = chosen;
    at("panels").scrollTop = 0;
    if (!wide.matches) window.scrollTo(0, 0);
  }
  for (const tab of tabs) {
    const on = tab.dataset.view === chosen;
    mark(tab, "aria-selected", String(on));
    tab.tabIndex = on ? 0 : -1;
  }
}

for (const tab of tabs) {
  tab.addEventListener("click", () => view(tab.dataset.view));
  tab.addEventListener("keydown", (event) => {
    const step = { ArrowRight: 1, ArrowLeft: -1 }[event.key];
    if (!step) return;
    const there = tabs.filter((one) => one.checkVisibility()), next = there[(there.indexOf(tab) + step + there.length) % there.length];
    next.focus();
    view(next.dataset.view);
  });
}
wide.addEventListener("change", () => view(document.body.dataset.view));
view("live");

guardButtons(document.body, say);

/** Of a hidden tab, the title is all that is seen. */
function showTitle() {
  const { state } = connection;
  if (state) write(document.querySelector("title"), `${connection.freshness().why ? "No current data" : motionText(state)} – ${state.rig}`);
}

let focusedBefore = null; // when data became stale; gets the focus back unless STOP or a pointer is pressed meanwhile
const sayLost = () => say("Not done: data were not current.", true);
window.addEventListener("pointerdown", ({ target, button, isPrimary }) => {
  leaveControl();
  if (isPrimary && button === 0 && at("stale").contains(target)) sayLost();
}, { capture: true });
window.addEventListener("keydown", ({ key, target }) => {
  if (key === "Enter" && focusedBefore && target === document.body) sayLost();
}, { capture: true });

function showAge() {
  const { why, age } = connection.freshness();
  showTitle();
  document.body.classList.toggle("stale", why !== null);
  at("stale").hidden = why === null;
  if (why) write(at("stale-text"), why);
  at("stale-hint").hidden = connection.open;
  // Without the age, which a screen reader would read twenty times a second.
  write(at("stale-said"), why ? "Figures are not current. Only STOP works." : "");
  write(at("lamp-data"), age === null ? "No data" : `Data ${known(age, 1)}\u00a0s old`);
  at("lamp-data").className = why ? "fail" : "pass";
  // Stale controls cannot be used, not even by keyboard; an open question is withdrawn.
  if (why) checkDialog();
  at("notice-box").inert = why !== null;
  if (why && !at("main").inert) focusedBefore = takeFocus();
  if (at("dialog").hidden) at("main").inert = at("tabs").inert = why !== null;
  applyButtons(document.body, situation());
  if (why) return;
  if (document.activeElement === document.body) focusedBefore?.focus({ preventScroll: true });
  leaveControl();
}

/** No control gets the focus back. */
function leaveControl() {
  focusedBefore = null;
  teach.undoUnsent();
}

/**
 * Takes the focus from a control at once: a browser does so with the next frame, and a space before it would not stop.
 * Returns the control that is to get it back; none of a jog pad, whose keys move the robot.
 */
function takeFocus() {
  const { activeElement: focused } = document;
  if (!focused?.closest("main, #tabs")) return null;
  focused.blur();
  return focused.closest("#jog-pad, #cable-pad") ? null : focused;
}

let waiting = false;
connection.addEventListener("refused", ({ detail }) => {
  jog.end(detail);
  say(detail, true);
});
connection.addEventListener("age", showAge);
connection.addEventListener("state", () => {
  // Of every state: a hidden tab has no frames.
  events.take(connection.state);
  curves.take(connection.state, performance.now());
  showTitle();
  if (waiting) return;
  waiting = true;
  requestAnimationFrame(() => {
    waiting = false;
    const { state } = connection;
    live.show(state);
    scene.show(state);
    curves.show(performance.now());
    events.show(state);
    pictures.show(state);
    operate.show(state);
    news.show(state);
    teach.show(state);
    pick.show(state);
    jog.show(state);
    stopBar.show(state.motion);
    checkDialog();
    showAge();
  });
});

scene.start().catch(() => write(at("scene-note"), "The scene cannot be read from the server."));
connection.start();
