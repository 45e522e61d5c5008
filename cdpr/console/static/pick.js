/* Picking a goal in the scene: a click on a plane at a chosen height gives a position, kept among the taught poses. */

import { at, known, write } from "./elements.js";
import { storePose } from "./teach.js";

const MOVED_PX = 6; // a pointer that went farther turned the view

export class Pick {
  #page;
  #point = null;
  #sent = null; // the point that is being stored
  #down = null;

  /** `page` has `command(name, fields)`, `situation()`, `say(text)`, `scene`, `view(name)`, and `showScene()`. */
  constructor(page) {
    this.#page = page;
    at("pick").addEventListener("click", () => this.#begin());
    at("pick-cancel").addEventListener("click", () => this.end());
    at("pick-height").addEventListener("input", () => {
      if (this.#point) this.#point = [...this.#point.slice(0, 2), this.#height];
      this.#show();
    });
    at("pick-keep").addEventListener("click", () => this.#keep());
    const canvas = at("scene-canvas");
    canvas.addEventListener("pointerdown", (event) => (this.#down = event.isPrimary ? [event.clientX, event.clientY] : null));
    canvas.addEventListener("pointerup", (event) => {
      const down = this.#down;
      if (!this.on || !down || Math.hypot(event.clientX - down[0], event.clientY - down[1]) > MOVED_PX) return;
      const point = this.#page.scene.pointAt(event, this.#height);
      if (point) this.#point = point.map((v) => Math.round(10 * v) / 10);
      this.#show();
    });
  }

  get on() {
    return !at("pick-bar").hidden;
  }

  get #height() {
    return Number(at("pick-height").value);
  }

  get #isInside() {
    const [low, high] = this.#page.scene.workspace;
    return this.#point.every((v, k) => low[k] <= v && v <= high[k]);
  }

  #begin() {
    const { state } = this.#page.situation();
    const slider = at("pick-height");
    const [low, high] = this.#page.scene.workspace;
    Object.assign(slider, { min: String(Math.ceil(low[2])), max: String(Math.floor(high[2])) });
    slider.value = String(Math.round(state.platform.position_mm[2]));
    at("pick-bar").hidden = false;
    this.#point = null;
    this.#page.showScene();
    this.#show();
    at("pick-height").focus();
  }

  /** Ends picking; nothing is kept. */
  end() {
    at("pick-bar").hidden = true;
    this.#page.scene.showPick(null);
  }

  async #keep() {
    const point = this.#point;
    if (!point) return this.#page.say("Click in the scene first.");
    if (!this.#isInside) return this.#page.say("The platform may not go there: click on the grid.", true);
    if (point === this.#sent) return; // pressed twice
    this.#sent = point;
    const isStored = await storePose(this.#page, "teach_at", "goal", { position_mm: point });
    if (this.#sent === point) this.#sent = null;
    if (!isStored || this.#point !== point) return; // another one was picked meanwhile
    this.end();
    this.#page.view("teach");
  }

  #show() {
    const point = this.#point;
    write(at("pick-height-shown"), known(this.#height, 0, "mm"));
    const place = point && `${point.map((v) => known(v, 0)).join(", ")} mm${this.#isInside ? "" : ": outside the workspace"}`;
    write(at("pick-text"), place ?? "Click on the grid where the platform is to go.");
    this.#page.scene.showPick({ height: this.#height, point });
  }

  /** Where control is lost, picking ends; stale data do not end it. */
  show({ control }) {
    if (this.on && !control.yours) this.end();
  }
}
