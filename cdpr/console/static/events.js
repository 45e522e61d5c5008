/* Events, state of cameras and drives, and error counts of the bus. */

import { address } from "./connection.js";
import { at, known, make, write } from "./elements.js";

const MOST = 200;
/** Codes with a help page `/help/CODE`; the files of docs/faults. */
export const HELP = new Set([
  "broken", "bus_down", "bus_errors", "bus_failed", "bus_gone", "bus_lost", "bus_off", "bus_passive", "cable_loose", "camera",
  "camera_sees_nothing", "clearance_low", "drive_fault", "drive_silent", "drive_stuck", "drive_warning", "following_error",
  "foreign_master", "gate_denied", "hold_timeout", "jog_not_begun", "late", "no_real_time", "not_held", "not_taut", "over_tension",
  "pictures_dropped", "pose_differs", "real_time_lost", "receive_overflow", "recorder", "reply_lost", "set_point_missed",
  "slack", "stop_not_sent", "supervisor_lost", "transmit_queue_full", "went_slack",
]);

/** Keeps the events of all motions since the page was opened, newest first. */
export class Events {
  #seen = new Set();
  #rows = [];

  take({ motion }) {
    for (const event of motion?.events ?? []) {
      const key = `${motion.process} ${event.time_s} ${event.code} ${event.text}`;
      if (this.#seen.has(key)) continue;
      this.#seen.add(key);
      this.#rows.unshift(row(event));
    }
    if (this.#rows.length > MOST) this.#rows.length = MOST;
  }

  show({ motion }) {
    if (at("events").firstChild !== (this.#rows[0] ?? null)) at("events").replaceChildren(...this.#rows);
    at("events-none").hidden = this.#rows.length > 0;
    const shown = at("panel-events").checkVisibility();
    if (!shown) return;
    fill("cameras", (motion?.cameras ?? []).map(cameraCells));
    fill("drives", (motion?.drives ?? []).map((drive, k) => driveCells(drive, k + 1)));
    for (const key of ["lost_replies", "rejected_frames", "error_frames"]) write(at(`count-${key}`), known(motion?.[key], 0));
  }
}

function row({ time_s: time, code, text }) {
  const help = HELP.has(code)
    ? make("a", { href: address(`/help/${code}`), target: "_blank", rel: "noopener", title: "Meaning and next step" }, code)
    : code;
  return make("li", {}, make("span", { class: "time figure" }, known(time, 2, "s")), make("b", {}, help), make("span", {}, text));
}

function cameraCells(camera) {
  return [
    camera.name, known(camera.pictures_per_second, 1, "/s"), `${known(camera.poses, 0)} of ${known(camera.pictures, 0)}`,
    known(camera.dropped, 0), known(camera.measuring_ms, 0, "ms"), camera.trouble || "–",
  ];
}

function driveCells(drive, cable) {
  return [`${cable} (drive ${drive.node})`, known(drive.torque === "none" ? null : drive.tension_n, 1, "N"), drive.state, known(drive.position_counts, 0), known(drive.set_counts, 0)];
}

/** Updates the rows of a table in place; an empty table is hidden. */
function fill(name, rows) {
  const body = at(name);
  at(`${name}-table`).hidden = rows.length === 0;
  at(`${name}-none`).hidden = rows.length > 0;
  while (body.rows.length > rows.length) body.deleteRow(-1);
  rows.forEach((cells, k) => {
    const row = body.rows[k] ?? body.insertRow();
    cells.forEach((text, c) => write(row.cells[c] ?? row.insertCell(), text));
  });
}
