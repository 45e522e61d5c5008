/* The 3-D scene: the viewer of the report (viewer.js) with the live platform, the path it drove, and a loaded plan. */

import { address } from "./connection.js";
import { at, duration, known, make, write } from "./elements.js";

const LAYERS = {
  obstacles: "Obstacles", robot: "Platform", numbers: "Cable numbers", frame: "Frame", floor: "Floor", workspace: "Workspace",
  path: "Planned path", raw: "Raw path", tree: "Search tree", trail: "Driven path",
};
const COLOURS = { obstacles: "obstacle", robot: "platform", numbers: "ink", frame: "frame", floor: "line", workspace: "muted", path: "ink", raw: "raw", tree: "tree", trail: "encoder" };
const HIDDEN_AT_FIRST = ["tree", "raw"];
const TRAIL_STEP_MM = 2, TRAIL_MOST = 600;

export class Scene {
  #view = null;
  #base = null;
  #plan = null;
  #trail = [];
  #shown = "";
  #moment = null; // of the plan, while it is looked through
  #hidden = new Set(HIDDEN_AT_FIRST);

  async start() {
    const response = await fetch(address("/scene"));
    if (!response.ok) return write(at("scene-note"), `The scene cannot be read (${response.status}).`);
    this.#base = { moments: [], ...(await response.json()) };
    this.#view = globalThis.sceneViewer(at("scene-canvas"), this.#base, (layer) => !this.#hidden.has(layer));
    at("scene-out").addEventListener("click", () => this.#view.zoom(0.8));
    at("scene-in").addEventListener("click", () => this.#view.zoom(1.25));
    at("scene-reset").addEventListener("click", () => this.#view.reset());
    this.#layers();
    if (this.#plan) this.load(this.#plan);
  }

  /** The platform where it is now; a plan that is looked through is left for it as soon as something moves. */
  show({ platform, tensions_n: tensions, tension_limits_n: limits, motion, jog }) {
    if (!this.#view) return;
    if ((motion || jog.moving) && platform?.source === "drives") this.#drive(platform.position_mm);
    if (this.#moment) return;
    const shown = JSON.stringify([platform, tensions?.map((tension) => Math.round(2 * tension))]);
    if (shown !== this.#shown) this.#view.show(platform && { p: platform.position_mm, r: platform.rotation, exits: platform.exits_mm, tensions });
    this.#shown = shown; // at rest nothing is drawn again
    if (limits.join() !== this.#base.tension_limits?.join()) {
      this.#base.tension_limits = limits;
      this.#draw();
    }
  }

  /** A loaded plan, or null: what it draws takes the place of the rig's own layers of the same names. */
  load(plan) {
    this.#plan = plan;
    this.look(null);
    if (!this.#view) return;
    this.#draw();
    this.#layers();
  }

  /** A moment of the plan, shown instead of the platform; null goes back to it. */
  look(moment) {
    this.#moment = moment;
    this.#shown = "";
    at("scene-preview").hidden = moment === null;
    if (moment) {
      write(at("scene-preview-text"), `Plan at ${duration(moment.t)}: ${moment.p.map((v) => known(v, 0)).join(", ")} mm`);
      this.#view?.show({ ...moment, tensions: null });
    }
  }

  #drive(position) {
    const last = this.#trail.at(-1);
    if (last && Math.hypot(...position.map((v, k) => v - last[k])) < TRAIL_STEP_MM) return;
    this.#trail.push(position);
    if (this.#trail.length > TRAIL_MOST) this.#trail.shift();
    this.#draw();
  }

  #parts() {
    const parts = { tension_limits: this.#base.tension_limits };
    for (const kind of ["surfaces", "strokes", "labels"]) {
      const more = this.#plan?.[kind] ?? [], replaced = new Set(more.map((one) => one.layer));
      parts[kind] = [...this.#base[kind].filter((one) => !replaced.has(one.layer)), ...more];
    }
    const segments = this.#trail.slice(1).map((point, k) => [...this.#trail[k], ...point]);
    parts.strokes.push({ layer: "trail", role: "encoder", segments, width: 2.5, opacity: 1, dash: [], ahead: true });
    return parts;
  }

  #draw() {
    this.#view.update(this.#parts());
  }

  #layers() {
    const { surfaces, strokes } = this.#parts();
    const drawn = new Set([...surfaces, ...strokes].map((one) => one.layer)).add("robot").add("numbers");
    const boxes = Object.keys(LAYERS).filter((layer) => drawn.has(layer)).map((layer) => {
      const box = make("input", { type: "checkbox", checked: !this.#hidden.has(layer) });
      box.addEventListener("change", () => {
        if (box.checked) this.#hidden.delete(layer);
        else this.#hidden.add(layer);
        this.#view.redraw();
      });
      return make("label", {}, box, make("span", { class: `swatch role-${COLOURS[layer]}` }), LAYERS[layer]);
    });
    at("layers").replaceChildren(...boxes);
  }
}
