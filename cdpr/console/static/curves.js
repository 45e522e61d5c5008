/* Curves over time (uPlot): the last minute of tensions, clearance and following error, and the curves of a plan. */

import { STALE_S } from "./connection.js";
import { at, known, make, write } from "./elements.js";

const SECONDS = 60, REDRAW_MS = 250, HEIGHT = 140, SERIES = 8;
const DASHES = ["", "dashed", "dash-dotted"]; // of each eight cables, as `series_style` of charts.py
const variable = (name) => getComputedStyle(document.documentElement).getPropertyValue(`--${name}`).trim();

/** Options of one plot: its lines are `{label, role, dash, limit}`, colour and dashes by their names in base.css; a limit
 * does not set the range. */
function options(lines, { x, zero = false, least = 0 }) {
  const axis = (more) => ({ stroke: () => variable("muted"), grid: { stroke: () => variable("grid"), width: 1 }, ticks: { show: false }, values: (_, all) => all.map((v) => String(v).replace("-", "\u2212")), font: "11px system-ui, sans-serif", ...more });
  return {
    width: 300, height: HEIGHT, legend: { show: false }, cursor: { drag: { x: false, y: false } }, padding: [8, 10, 0, 0],
    scales: { x: { time: false, range: x }, y: { range: (_, low, high) => range(low, Math.max(high, least), zero) } },
    axes: [axis({ size: 20, gap: 4, label: "Time [s]", labelSize: 16, labelGap: 0, labelFont: "11px system-ui, sans-serif" }), axis({ size: 42, gap: 4 })],
    series: [{}, ...lines.map(({ label, role, dash, limit }) => ({
      label, stroke: () => variable(role), width: 1.5, dash: dash ? variable(dash).split(" ").map(Number) : [], auto: !limit, points: { show: false }, spanGaps: false,
    }))],
  };
}

function range(low, high, zero) {
  if (low === null || high === null) return [0, 1];
  const room = Math.max(0.08 * (high - low), 0.02 * Math.abs(high), 1e-3);
  return [zero && low >= 0 ? 0 : low - room, high + room];
}

const tensionLines = (count) => [
  ...Array.from({ length: count }, (_, k) => ({ label: `cable ${k + 1}`, role: `series${(k % SERIES) + 1}`, dash: DASHES[Math.floor(k / SERIES) % DASHES.length] })),
  ...Array(2).fill({ label: "limit", role: "limit", dash: "dotted", limit: true }),
];
const CLEARANCE = [{ label: "clearance", role: "encoder" }, { label: "required", role: "limit", dash: "dotted" }];

/** A short piece of a line, as in the plot. */
function sample({ role, dash }) {
  const [svg, path] = ["svg", "path"].map((tag) => document.createElementNS("http://www.w3.org/2000/svg", tag));
  path.setAttribute("d", "M0 5H16");
  path.style.strokeDasharray = dash ? `var(--${dash})` : "none";
  svg.setAttribute("class", `role-${role}`);
  svg.append(path);
  return svg;
}

/** A plot that fills the width of its figure. */
class Plot {
  #plot;

  constructor(figure, lines, more, data) {
    this.#plot = new globalThis.uPlot(options(lines, more), data, figure.querySelector(".plotted"));
    new ResizeObserver(([entry]) => {
      const width = Math.floor(entry.contentRect.width);
      if (width > 0 && width !== this.#plot.width) this.#plot.setSize({ width, height: HEIGHT });
    }).observe(figure.querySelector(".plotted"));
    matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => this.#plot.redraw());
    const key = figure.querySelector(".keys");
    const shown = lines.length > 1 ? lines.filter((line, k) => lines.findIndex((other) => other.label === line.label) === k) : [];
    key.replaceChildren(...shown.map((line) => make("span", { class: "key" }, sample(line), line.label.replace("cable ", ""))));
  }

  draw(data) {
    this.#plot.setData(data);
  }

  destroy() {
    this.#plot.destroy();
  }
}

/** The last minute. */
export class Curves {
  #rows = []; // {at, tensions, clearance, required, following}
  #plots = null;
  #drawn = 0;
  #limits = [0, 0];

  /** Takes a state received at `now`, [ms]; the curves have a gap where none was. */
  take(state, now) {
    const { tensions_n: tensions, clearance_mm: clearance, motion } = state;
    this.#limits = state.tension_limits_n;
    const last = this.#rows.at(-1)?.at ?? Infinity;
    if (now / 1000 - last > STALE_S) this.#rows.push({ at: last, tensions: null, clearance: null, required: null, following: null });
    this.#rows.push({ at: now / 1000, tensions, clearance: clearance?.now ?? null, required: clearance?.required ?? null, following: motion?.following_error_mm ?? null });
    while (this.#rows[0].at < now / 1000 - SECONDS) this.#rows.shift();
  }

  show(now) {
    if (now - this.#drawn < REDRAW_MS || document.hidden || !at("live").checkVisibility()) return;
    this.#drawn = now;
    this.#draw(now / 1000);
  }

  #draw(now) {
    const count = this.#rows.find((row) => row.tensions)?.tensions.length ?? 0;
    if (!this.#plots) {
      if (!count && !this.#rows.some((row) => row.clearance !== null)) return;
      this.#make(count || SERIES);
    }
    const x = this.#rows.map((row) => row.at - now), of = (read) => this.#rows.map(read);
    const { cables } = this.#plots;
    const tensions = Array.from({ length: cables }, (_, k) => of((row) => row.tensions?.[k] ?? null));
    this.#plots.tensions.draw([x, ...tensions, ...this.#limits.map((limit) => of(() => limit))]);
    this.#plots.clearance.draw([x, of((row) => row.clearance), of((row) => row.required)]);
    this.#plots.following.draw([x, of((row) => row.following)]);
  }

  #make(cables) {
    const more = { x: [-SECONDS, 0] };
    this.#plots = {
      cables,
      tensions: new Plot(at("curve-tensions"), tensionLines(cables), more, [[]]),
      clearance: new Plot(at("curve-clearance"), CLEARANCE, { ...more, zero: true }, [[]]),
      following: new Plot(at("curve-following"), [{ label: "following error", role: "encoder" }], { ...more, zero: true, least: 0.1 }, [[]]),
    };
  }
}

/** The curves of the loaded plan. */
export class PlanCurves {
  #plots = [];

  show(plan, limits) {
    for (const plot of this.#plots) plot.destroy();
    this.#plots = [];
    at("plan-curves").hidden = !plan?.curves;
    if (!plan?.curves) return;
    const { time_s: time, clearance_mm: clearance, required_mm: required, tensions_n: tensions } = plan.curves;
    const x = { x: [time[0] ?? 0, time.at(-1) ?? 1] };
    this.#plots.push(new Plot(at("plan-tensions"), tensionLines(tensions.length), x, [time, ...tensions, ...limits.map((limit) => time.map(() => limit))]));
    at("plan-clearance").hidden = clearance === null;
    if (clearance === null) return;
    this.#plots.push(new Plot(at("plan-clearance"), CLEARANCE, { ...x, zero: true }, [time, clearance, time.map(() => required)]));
    const values = clearance.filter((v) => v !== null);
    write(at("plan-clearance-least"), values.length ? `least ${known(Math.min(...values), 1, "mm")}` : "");
  }
}
