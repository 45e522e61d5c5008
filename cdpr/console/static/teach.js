/* Taught poses: store the current pose, name, order and remove poses, plan a path through them. */

import { whyNot } from "./buttons.js";
import { ask } from "./dialog.js";
import { at, chosen, known, make, mark, write } from "./elements.js";

const sent = new Set(); // names that no state lists yet

/**
 * Sends `command`, which stores a pose, with a name: the given one, or else the first of "pose 1", "pose 2" … that is not
 * in use, for the kind "pose". Resolves to whether it was stored.
 */
export async function storePose(page, command, kind, fields) {
  const name = fields.name || freeName(kind, page.situation().state.poses);
  sent.add(name);
  const { ok } = await page.command(command, { ...fields, name });
  if (!ok) sent.delete(name);
  return ok;
}

function freeName(kind, poses) {
  const taken = [...poses.map(({ name }) => name), ...sent];
  return taken.concat("").map((_, k) => `${kind} ${k + 1}`).find((name) => !taken.includes(name));
}

export class Teach {
  #page;
  #shown = "";
  #unsent = new Map(); // fields that stale data interrupted, with their poses' names: typing may go on afterwards

  /** `page` has `command(name, fields)`, `situation()` and `say(text)`. */
  constructor(page) {
    this.#page = page;
    at("teach-form").addEventListener("submit", (event) => {
      event.preventDefault();
      at("teach").click();
    });
    at("teach").addEventListener("click", async () => {
      const field = at("teach-name"), typed = field.value;
      const isStored = await storePose(page, "teach", "pose", { name: typed.trim() });
      if (isStored && field.value === typed) field.value = ""; // else it holds the name of the next pose
    });
    at("plan-poses").addEventListener("click", () => this.#plan({ from_here: at("plan-from-here").checked }));
    at("teach-jog-end").addEventListener("click", () => page.command("jog_end"));
  }

  #plan(fields) {
    this.#page.command("plan", { scene: null, objective: chosen("poses-objective"), ...fields });
  }

  async #forget(name) {
    const { say, situation } = this.#page;
    const lines = ["It cannot be restored with its orientation; teach it again if it is needed later."];
    const possible = () => whyNot("edit_pose", situation());
    if (await ask({ title: `Remove “${name}”?`, lines, confirm: "Remove", possible, say })) this.#page.command("forget", { pose: name });
  }

  show({ poses, platform, control, jog, busy }) {
    for (const { name } of poses) sent.delete(name);
    at("teach-jog-end").hidden = !jog.ready && busy?.verb !== "jog";
    const why = control.yours ? whyNot("plan_poses", this.#page.situation()) : null;
    write(at("plan-poses-why"), why ? `${why}.` : "");
    write(at("teach-here"), platform ? `Now at ${platform.position_mm.map((v) => known(v, 1)).join(", ")} mm` : "The position is unknown.");
    const text = JSON.stringify(poses);
    if (text === this.#shown) return;
    this.#shown = text;
    at("poses-none").hidden = poses.length > 0;
    this.#arrange(poses);
  }

  /** Puts back the names whose typing stale data interrupted, unless it goes on. */
  undoUnsent() {
    for (const [field, name] of this.#unsent) {
      if (field === document.activeElement) continue;
      this.#unsent.delete(field);
      field.value = name;
      this.#page.say(`“${name}” was not renamed: data were not current.`, true);
    }
  }

  /** A pose keeps its row, with any text being typed, as long as it keeps its name. */
  #arrange(poses) {
    const list = at("poses"), focused = document.activeElement;
    const index = [...list.children].findIndex((row) => row.contains(focused));
    const rows = new Map([...list.children].map((row) => [row.dataset.pose, row]));
    for (const [name, row] of rows) if (!poses.some((pose) => pose.name === name)) row.remove();
    poses.forEach(({ name, position_mm: position }, k) => {
      const row = rows.get(name) ?? this.#row(name);
      if (list.children[k] !== row) list.insertBefore(row, list.children[k] ?? null);
      const part = (key) => row.querySelector(`[data-key="${key}"]`);
      write(part("number"), String(k + 1));
      write(part("position"), `${position.map((v) => known(v, 0)).join(", ")} mm`);
      mark(part("name"), "aria-label", `Name of pose ${k + 1}`);
      part("up").hidden = k === 0;
      part("down").hidden = k === poses.length - 1;
    });
    // Restore the focus; if its row is gone, focus the row now at that index.
    if (focused.isConnected) focused.focus();
    else if (index >= 0) list.children[index]?.querySelector(`[data-key="${focused.dataset.key}"]`)?.focus();
  }

  #row(name) {
    const { command, situation } = this.#page;
    const field = make("input", { type: "text", value: name, maxlength: 60, "data-button": "edit_pose", "data-key": "name" });
    const isUnsent = () => this.#unsent.has(field);
    const rename = async () => {
      if (situation().stale !== null) return this.#unsent.set(field, name);
      this.#unsent.delete(field);
      const wanted = field.value.trim();
      if (!wanted || !(await command("rename", { pose: name, name: wanted })).ok) field.value = name;
    };
    field.addEventListener("change", rename);
    field.addEventListener("blur", () => isUnsent() && rename());
    field.addEventListener("keyup", ({ key }) => key === "Enter" && isUnsent() && rename());
    const button = (text, title, key, press) =>
      make("button", { type: "button", "data-button": "edit_pose", "data-title": title, "data-name": title, "data-key": key, "aria-label": title, onclick: press }, text);
    const goTo = button("Go to", `Plan a path to ${name}`, "go", () => this.#plan({ pose: name }));
    goTo.dataset.button = "go_to";
    const move = (by) => () => {
      const to = [...at("poses").children].indexOf(row) + by;
      command("move", { pose: name, to });
    };
    const row = make("li", { "data-pose": name },
      make("span", { class: "number", "data-key": "number" }),
      make("div", { class: "pose" }, field, make("span", { class: "figure quiet", "data-key": "position" })),
      make("div", { class: "side" },
        make("div", { class: "row" },
          button("↑", `Move ${name} up`, "up", move(-1)),
          button("↓", `Move ${name} down`, "down", move(1)),
          button("✕", `Remove ${name}`, "forget", () => this.#forget(name))),
        goTo));
    return row;
  }
}
