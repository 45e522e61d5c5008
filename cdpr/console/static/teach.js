/* Taught poses: store where the platform is, name, order and remove them, plan a path through them. */

import { at, chosen, freeName, known, make, write } from "./elements.js";

export class Teach {
  #page;
  #shown = "";

  /** `page` has `command(name, fields)`. */
  constructor(page) {
    this.#page = page;
    at("teach-form").addEventListener("submit", (event) => {
      event.preventDefault();
      at("teach").click();
    });
    at("teach").addEventListener("click", async () => {
      const name = at("teach-name").value.trim() || freeName("pose", JSON.parse(this.#shown || "[]"));
      const { ok } = await page.command("teach", { name });
      if (ok) at("teach-name").value = "";
    });
    at("plan-poses").addEventListener("click", () => page.command("plan", { scene: null, objective: chosen("poses-objective") }));
  }

  show({ poses, platform }) {
    write(at("teach-here"), platform ? `Now at ${platform.position_mm.map((v) => known(v, 1)).join(", ")} mm` : "The position is not known.");
    const text = JSON.stringify(poses);
    if (text === this.#shown) return;
    this.#shown = text;
    at("poses-none").hidden = poses.length > 0;
    // Whatever had the focus has it again, unless a name is being typed.
    const focused = document.activeElement?.dataset?.key;
    at("poses").replaceChildren(...poses.map((pose, k) => this.#row(pose, k, poses.length)));
    if (focused) at("poses").querySelector(`[data-key="${focused}"]`)?.focus();
  }

  #row({ name, position_mm: position }, index, count) {
    const { command } = this.#page;
    const field = make("input", { type: "text", value: name, maxlength: 60, "data-button": "edit_pose", "data-key": `name ${index}`, "aria-label": `Name of pose ${index + 1}` });
    field.addEventListener("change", () => field.value.trim() && command("rename", { index, name: field.value.trim() }));
    const button = (text, title, key, press) =>
      make("button", { type: "button", "data-button": "edit_pose", "data-title": title, "data-name": title, "data-key": `${key} ${index}`, "aria-label": title, onclick: press }, text);
    const move = (to) => () => command("move", { index, to });
    return make("li", {},
      make("span", { class: "number" }, String(index + 1)),
      make("div", { class: "pose" }, field, make("span", { class: "figure quiet" }, `${position.map((v) => known(v, 0)).join(", ")} mm`)),
      make("div", { class: "row" },
        ...(index > 0 ? [button("↑", `Move ${name} up`, "up", move(index - 1))] : []),
        ...(index < count - 1 ? [button("↓", `Move ${name} down`, "down", move(index + 1))] : []),
        button("✕", `Forget ${name}`, "forget", () => command("forget", { index }))));
  }
}
