/* The 3-D scene: the viewer of reports (viewer.js, three.js) with the live platform, the path it drove, and a loaded plan. */

import { address } from "./connection.js";
import { at, duration, known, make, write } from "./elements.js";
import { isFresh } from "./live.js";

const LAYERS = {
  obstacles: "Obstacles", robot: "Platform", numbers: "Cable numbers", frame: "Frame", floor: "Floor", workspace: "Workspace",
  axes: "Axes", poses: "Taught poses", path: "Planned path", raw: "Raw path", tree: "Search tree", trail: "Driven path", other: "Compared path", nearest: "Closest pair", measured: "Measured position",
};
const COLOURS = { obstacles: "obstacle", robot: "platform", numbers: "ink", frame: "frame", floor: "line", workspace: "muted", axes: "ink", poses: "ink", path: "ink", raw: "raw", tree: "tree", trail: "encoder", other: "raw", nearest: "limit", measured: "tag" };
const HIDDEN_AT_FIRST = ["tree", "raw"];
const TRAIL_STEP_MM = 2, TRAIL_MOST = 600;
const SOFTWARE_MS = 200; // between pictures that the processor draws: they must not hold up STOP, or the run on this computer

const GRID_LINES = 8;

/** Lines of a grid over the workspace at a height, [mm]. */
function gridAt(height, [low, high]) {
  return Array.from({ length: GRID_LINES + 1 }, (_, k) => {
    const [x, y] = [0, 1].map((axis) => low[axis] + ((high[axis] - low[axis]) * k) / GRID_LINES);
    return [[x, low[1], height, x, high[1], height], [low[0], y, height, high[0], y, height]];
  }).flat();
}

const AXIS_SHARE = 0.14;
/** The axes of the world as short arrows with letters, at a corner of the floor. */
function worldAxes({ strokes, surfaces }) {
  const floor = strokes.find((one) => one.layer === "floor")?.segments.flatMap((one) => [one.slice(0, 3), one.slice(3)]);
  const points = floor ?? surfaces.flatMap((one) => one.vertices);
  if (!points.length) return { strokes: [], labels: [] };
  const [low, high] = [Math.min, Math.max].map((most) => [0, 1, 2].map((axis) => most(...points.map((point) => point[axis]))));
  const length = AXIS_SHARE * Math.max(...high.map((v, k) => v - low[k]));
  const along = (from, axis, share) => from.map((v, k) => (k === axis ? v + share * length : v));
  const segments = [0, 1, 2].flatMap((axis) => {
    const tip = along(low, axis, 1), side = axis === 0 ? 1 : 0;
    return [[...low, ...tip], ...[-0.1, 0.1].map((share) => [...tip, ...along(along(low, axis, 0.75), side, share)])];
  });
  return {
    strokes: [{ layer: "axes", role: "ink", segments, width: 2, opacity: 1, dash: [], ahead: true }],
    labels: ["x", "y", "z"].map((text, axis) => ({ layer: "axes", text, at: along(low, axis, 1.25), mark: "" })),
  };
}

const SAME_MM = 1;
const isSamePoint = (one, other) => Math.hypot(...one.at.map((v, k) => v - other.at[k])) < SAME_MM;

/** Labels of a plan and of taught poses, one a point: a taught pose's name instead of “start” or “goal” there. */
function namedPoints(planned, poses) {
  const taught = poses.map(({ name, position_mm: at }) => ({ layer: "poses", text: name, at, mark: "dot" }));
  const own = planned.filter((label, k) => planned.findIndex((one) => isSamePoint(one, label)) === k);
  const merged = own.map((label) => ({ ...label, text: [...new Set(planned.filter((one) => isSamePoint(one, label)).map((one) => one.text))].join(", ") }));
  for (const pose of taught) pose.mark = planned.find((one) => isSamePoint(one, pose))?.mark || "dot";
  return [...merged.filter((label) => !taught.some((pose) => isSamePoint(pose, label))), ...taught];
}

/** Strokes and labels of several parts, each `{strokes, labels}` or null. */
const drawn = (parts) => ({ strokes: parts.flatMap((part) => part?.strokes ?? []), labels: parts.flatMap((part) => part?.labels ?? []) });

/** A line between the two nearest points, with the distance at its middle. */
function closestPair(clearance) {
  if (!clearance) return null;
  const [from, to] = clearance.points_mm, middle = from.map((v, k) => (v + to[k]) / 2);
  return {
    strokes: [{ layer: "nearest", role: "limit", segments: [[...from, ...to]], width: 3, dash: null }],
    labels: [{ layer: "nearest", text: known(clearance.now, 1, "mm"), at: middle, mark: "" }],
  };
}

const POINTS = 24, LEAST_SHARE = 0.04;
/** The first of 1, 2, 5, 10, 20 … that is no less. */
const roundUp = (wanted) => {
  const power = 10 ** Math.floor(Math.log10(wanted));
  return [1, 2, 5, 10].find((one) => one * power >= wanted * (1 - 1e-9)) * power;
};

/** Three principal ellipses about the measured position, drawn large enough to be seen, and by how much larger they are. */
function ellipsoid(measured, size) {
  if (!measured) return null;
  const { position_mm: middle, half_axes_mm: axes, within_mm: within } = measured;
  const larger = roundUp(Math.max(1, (LEAST_SHARE * size) / Math.max(within, 1e-3)));
  const on = ([u, v], k) => {
    const angle = (2 * Math.PI * k) / POINTS;
    return middle.map((value, c) => value + larger * (Math.cos(angle) * u[c] + Math.sin(angle) * v[c]));
  };
  const rings = [[0, 1], [0, 2], [1, 2]].map((pair) => pair.map((k) => axes[k]));
  const segments = rings.flatMap((pair) => Array.from({ length: POINTS }, (_, k) => [...on(pair, k), ...on(pair, k + 1)]));
  const legend = `Measured to ±${known(within, within < 1 ? 2 : 1, "mm")} (95 %)${larger > 1 ? `, ellipsoid drawn ${larger}×` : ""}`;
  return { strokes: [{ layer: "measured", role: "tag", segments, width: 1.6, dash: null }], labels: [], legend };
}

export class Scene {
  #view = null;
  #base = null;
  #plan = null;
  #other = null; // the plan that is compared
  #pick = null; // {height, point}: where a goal is being picked
  #poses = []; // as taught
  #trail = [];
  #grown = false; // the trail, since it was drawn
  #drawn = 0; // when a state was, [ms]
  #shown = "";
  #moment = null; // of the plan, while it is looked through
  #hidden = new Set(HIDDEN_AT_FIRST);

  async start() {
    const response = await fetch(address("/scene"));
    if (!response.ok) return write(at("scene-note"), `The scene cannot be read (${response.status}).`);
    this.#base = { moments: [], ...(await response.json()) };
    // Loaded here, for STOP must not wait for it, and only where it can draw; else the viewer says what is missing.
    const canvas = at("scene-canvas");
    globalThis.THREE = webglOf(canvas) && (await import("./vendor/three/three.module.min.js").catch(() => null));
    this.#view = globalThis.sceneViewer(canvas, this.#base, (layer) => !this.#hidden.has(layer));
    at("scene-out").addEventListener("click", () => this.#view.zoom(0.8));
    at("scene-in").addEventListener("click", () => this.#view.zoom(1.25));
    at("scene-reset").addEventListener("click", () => this.#view.reset());
    this.#draw();
    this.#layers();
    if (this.#plan) this.load(this.#plan);
    if (this.#other) this.compare(this.#other);
  }

  /** The platform where it is now; a plan that is looked through is left for it as soon as something moves. */
  show({ platform, tensions_n: tensions, tension_limits_n: limits, clearance_mm: clearance, measured, motion, jog, poses }) {
    if (!this.#view) return;
    if (JSON.stringify(poses) !== JSON.stringify(this.#poses)) {
      this.#poses = poses;
      this.#draw();
      this.#layers();
    }
    if ((motion || jog.moving) && platform?.source === "drives") this.#drive(platform.position_mm);
    const now = performance.now();
    if (this.#view.isSoftware && now < this.#drawn + SOFTWARE_MS) return; // the next state does
    this.#drawn = now;
    if (this.#grown) this.#draw();
    this.#grown = false;
    if (this.#moment) return;
    const fresh = isFresh(measured) ? { ...measured, age_s: 0 } : null;
    const shown = JSON.stringify([platform, tensions?.map((tension) => Math.round(2 * tension)), clearance, fresh, this.#pick]);
    if (shown !== this.#shown) {
      const measure = ellipsoid(fresh, this.#view.size()), more = drawn([this.#goal(), closestPair(clearance), measure]);
      write(at("scene-legend"), measure && !this.#hidden.has("measured") ? measure.legend : "");
      this.#view.show(platform && { p: platform.position_mm, r: platform.rotation, exits: platform.exits_mm, tensions, ...more });
    }
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

  /** Another plan's path beside the loaded one's, or null. */
  compare(plan) {
    this.#other = plan;
    if (!this.#view) return;
    this.#draw();
    this.#layers();
  }

  /** The point [mm] at a height that is drawn where a pointer is, or null. */
  pointAt({ clientX, clientY }, height) {
    const box = at("scene-canvas").getBoundingClientRect();
    return this.#view?.pick(clientX - box.left, clientY - box.top, height) ?? null;
  }

  /** The lowest and the highest corner of where the platform may go, [mm]. */
  get workspace() {
    return this.#base.workspace_mm;
  }

  /** Shows a plane at a height, and a goal on it: `{height, point}`; null ends it. */
  showPick(pick) {
    const moved = pick?.height !== this.#pick?.height;
    this.#pick = pick;
    if (this.#view && moved) this.#draw();
  }

  #goal() {
    if (!this.#pick?.point) return null;
    const { point } = this.#pick, below = [point[0], point[1], 0];
    return {
      strokes: [{ layer: "pick", role: "encoder", segments: [[...point, ...below]], width: 2, dash: [4, 4] }],
      labels: [{ layer: "pick", text: "picked", at: point, mark: "ring" }],
    };
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
    this.#grown = true;
  }

  #parts() {
    const parts = { tension_limits: this.#base.tension_limits };
    for (const kind of ["surfaces", "strokes", "labels"]) {
      const more = this.#plan?.[kind] ?? [], replaced = new Set(more.map((one) => one.layer));
      parts[kind] = [...this.#base[kind].filter((one) => !replaced.has(one.layer)), ...more];
    }
    const axes = worldAxes(parts);
    parts.strokes.push(...axes.strokes);
    parts.labels = [...namedPoints(parts.labels, this.#hidden.has("poses") ? [] : this.#poses), ...axes.labels];
    if (this.#other) {
      const path = this.#other.strokes.filter((one) => one.layer === "path");
      parts.strokes.push(...path.map((one) => ({ ...one, layer: "other", role: "raw", width: 3, ahead: true })));
    }
    if (this.#pick) {
      parts.strokes.push({ layer: "pick", role: "encoder", width: 1, opacity: 0.6, dash: [], segments: gridAt(this.#pick.height, this.workspace) });
    }
    const segments = this.#trail.slice(1).map((point, k) => [...this.#trail[k], ...point]);
    parts.strokes.push({ layer: "trail", role: "encoder", segments, width: 2.5, opacity: 1, dash: [], ahead: true });
    return parts;
  }

  #draw() {
    this.#view.update(this.#parts());
  }

  #layers() {
    const { surfaces, strokes, labels } = this.#parts();
    const drawn = new Set([...surfaces, ...strokes, ...labels].map((one) => one.layer)).add("robot").add("numbers").add("nearest").add("measured");
    if (this.#poses.length) drawn.add("poses");
    const boxes = Object.keys(LAYERS).filter((layer) => drawn.has(layer)).map((layer) => {
      const box = make("input", { type: "checkbox", checked: !this.#hidden.has(layer) });
      box.addEventListener("change", () => {
        if (box.checked) this.#hidden.delete(layer);
        else this.#hidden.add(layer);
        this.#draw(); // a hidden name gives way to “start” or “goal”
      });
      return make("label", {}, box, make("span", { class: `swatch role-${COLOURS[layer]}` }), LAYERS[layer]);
    });
    at("layers").replaceChildren(...boxes);
  }
}
