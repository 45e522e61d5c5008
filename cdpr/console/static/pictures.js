/* Camera images with their detections: at most five per second and camera, one request at a time. */

import { address } from "./connection.js";
import { at, make, write } from "./elements.js";

const EVERY_MS = 200, AGAIN_MS = 1000, SILENT_MS = 3000;

/** One camera's figure; the next image is requested once the last one arrived or failed. */
class Figure {
  #image = make("img", { width: 640, height: 480, hidden: true });
  #caption = make("figcaption", {}, "");
  #due = 0;

  constructor(name) {
    this.name = name;
    this.element = make("figure", {}, this.#image, this.#caption);
    this.#image.addEventListener("load", () => {
      this.#image.hidden = false;
      this.#due = Math.max(performance.now(), this.#asked + EVERY_MS);
    });
    this.#image.addEventListener("error", () => {
      this.#image.hidden = true;
      this.#due = performance.now() + AGAIN_MS;
    });
  }

  #asked = -Infinity;

  show(camera, now) {
    const seen = camera.trouble || (camera.tags.length ? `tags ${camera.tags.join(", ")}` : "no tag in the last image");
    write(this.#caption, `${camera.name}: ${seen}`);
    this.#image.alt = `Newest image of camera ${camera.name}, with outlines of the platform and its tags`;
    if (now < this.#due) return;
    this.#asked = now;
    this.#due = now + SILENT_MS;
    this.#image.src = address(`/camera/${encodeURIComponent(camera.name)}?at=${Math.round(now)}`);
  }
}

export class Pictures {
  #figures = [];

  show({ motion }) {
    const cameras = (motion?.cameras ?? []).filter((camera) => camera.live_image !== null);
    if (cameras.map(({ name }) => name).join("\n") !== this.#figures.map(({ name }) => name).join("\n")) {
      this.#figures = cameras.map(({ name }) => new Figure(name));
      at("pictures").replaceChildren(...this.#figures.map(({ element }) => element));
    }
    if (document.hidden || !at("pictures").checkVisibility()) return;
    cameras.forEach((camera, k) => this.#figures[k].show(camera, performance.now()));
  }
}
