/* Live figures: lamps, position, clearance, next stop, tensions and their limits, timing of the loop. */

import { isActive, isMovedByAnother } from "./buttons.js";
import { at, capital, dateAndTime, duration, exact, known, make, mark, write } from "./elements.js";

/** Lamps: text, and level: good (pass), bad (fail), attention (stop) or neutral (quiet). */
const LAMPS = {
  control: ({ control, read_only: readOnly }) =>
    readOnly ? ["Read-only", "quiet"] : control.mode === "service" ? ["Service mode", "stop"] : control.yours ? ["You have control", "pass"] : [control.held_by ? `Control: ${control.held_by}` : "Control is free", "quiet"],
  drives: ({ motion, jog, cable, drives_read: read, tensions_n: tensions }) => {
    const drives = motion?.drives ?? [], on = drives.filter((d) => d.torque === "enabled").length;
    const ready = jog.ready || cable.ready, holding = drives.filter((d) => d.torque === "holding").length;
    if (!drives.length && read?.at) {
      const [date, time] = dateAndTime(read.at);
      return tensions ? [`Read ${date || time}`, "quiet"] : ["Drives not read", "stop"];
    }
    if (!drives.length) return [ready ? "Drives on" : "No drive data", ready ? "pass" : "quiet"];
    // After a quick stop drives hold by themselves, with torque.
    const text = !on && holding ? `${holding} of ${drives.length} drives hold` : `${on} of ${drives.length} drives on`;
    return [text, drives.some((d) => d.in_fault) ? "fail" : on === drives.length ? "pass" : on ? "stop" : "quiet"];
  },
  homed: ({ reference: { counts, known: isKnown } }) => [counts ? "Homed" : isKnown ? "Not homed" : "Homed: unknown", counts ? "pass" : "stop"],
  latch: ({ latched }) => (latched === null ? ["No fault", "pass"] : ["Fault latched", "fail"]),
};

export const STATES = {
  preparing: "Preparing", enabling: "Enabling drives", approaching: "Approaching the start", moving: "Moving", holding: "Held",
  stopping: "Stopping", securing: "Securing", finished: "Finished", stopped: "Stopped", latched: "Stopped by a fault", releasing: "Releasing",
};

const BEFORE = { run: "Preparing the run", home: "Preparing to home", plan: "Planning", jog: "Preparing to jog", reset: "Resetting", release: "Releasing", load: "Loading a plan" };

/** Where values at rest come from: no run reports the drives, and they may be moved or lose power unnoticed. */
function readText({ drives_read: read, tensions_n: tensions }) {
  if (!read) return "";
  const why = read.why_not ? ` ${capital(read.why_not)}.` : "";
  return `${read.at && tensions ? `Read at ${dateAndTime(read.at).join(" ").trim()}, not watched.` : ""}${why}`.trim();
}

/** When another program was found to command the drives, if they are not read again since. */
function foundText({ drives_read: read, tensions_n: tensions }) {
  return read.at && !tensions ? ` at ${dateAndTime(read.at).join(" ").trim()}` : "";
}

/** More than two cables in the same trouble are counted: a list would be longer than its space. */
function troubleText(tensions, [low, high]) {
  const words = (name, limit, values) => {
    const found = tensions.flatMap((t, k) => (t !== null && values(t) ? [k] : []));
    if (found.length > 2) return [`${found.length} cables are ${name}: ${limit}`];
    return found.map((k) => `Cable ${k + 1} is ${name}: ${known(tensions[k], 1, "N")}, ${limit}`);
  };
  return [
    ...words("slack", `at least ${exact(low, "N")}`, (t) => t < low),
    ...words("too tight", `at most ${exact(high, "N")}`, (t) => t > high),
  ].join(". ");
}

/** The present motion, in a few words. */
export function motionText(state) {
  const { motion, busy, jog, cable, latched, drives_read: read } = state;
  if (jog.ready) return jog.moving ? "Jogging" : "Ready to jog";
  if (cable.ready) return cable.moving ? `Jogging cable ${cable.cable}` : "Ready to jog a cable";
  if (motion) {
    const share = motion.path_length_mm ? ` · ${Math.round((100 * motion.path_mm) / motion.path_length_mm)} %` : "";
    return (STATES[motion.state] ?? motion.state) + (isActive(motion) ? share : "");
  }
  if (busy) return BEFORE[busy.verb] ?? busy.verb;
  if (isMovedByAnother(state)) return "Moved by another user";
  if (read?.in_use) return `Used by another program${foundText(state)}`;
  return latched === null ? "At rest" : "Fault latched";
}

/** What is known of the robot without a motion of this user: STOP reaches no other. */
export function restText(state) {
  const { busy, simulated, drives_read: read } = state;
  if (busy) return "";
  if (isMovedByAnother(state)) return `Process ${state.moved_by} of another user is not stopped from here.`;
  if (read?.in_use) return `As last read${foundText(state)}, ${read.why_not}.`;
  return simulated ? "Nothing is moving." : "No motion of this user is in progress.";
}

/** Largest age of a measured pose that is shown as current, [s]. */
const FRESH_S = 1;
export const isFresh = (measured) => measured !== null && measured.age_s <= FRESH_S;

function measuredClearance(measured) {
  if (measured === null) return "";
  if (!isFresh(measured)) return `no measured pose for ${known(measured.age_s, 0, "s")}`;
  const { clearance, within_mm: within, stated } = measured;
  if (clearance) return `measured ${known(clearance.distance_mm, 1)} (${known(clearance.low_mm, 1)}–${known(clearance.high_mm, 1)})`;
  return `pose measured to ±${known(within, 2, "mm")}${stated ? "" : " from scatter only"}`;
}

export class Live {
  #bars = []; // per cable {bar, value, row}

  show(state) {
    write(at("rig"), state.rig);
    mark(at("rig"), "title", state.rig);
    write(at("bus"), state.bus);
    write(at("simulated"), state.simulated ? "simulated drives" : "");
    for (const [name, read] of Object.entries(LAMPS)) {
      const [text, kind] = read(state), lamp = at(`lamp-${name}`);
      write(lamp, text);
      lamp.className = kind;
    }
    write(at("motion-text"), motionText(state));
    write(at("drives-read"), readText(state));
    document.body.classList.toggle("resting", Boolean(state.drives_read?.at));
    at("read-drives").hidden = state.simulated;
    this.#pose(state);
    this.#motion(state);
    this.#tensions(state);
  }

  #pose({ platform, measured }) {
    ["x", "y", "z"].forEach((axis, k) => {
      tile(axis, known(platform?.position_mm[k], 1));
      write(at(`measured-${axis}`), measured ? `measured ${isFresh(measured) ? known(measured.position_mm[k], 2) : "–"}` : "");
    });
    tile("tilt", known(platform?.tilt_deg, 2));
    const note = platform === null ? "unknown" : platform.source === "plan" ? "from the plan" : `turn ${known(platform.turn_deg, 2)}°`;
    write(at("note-tilt"), note);
  }

  #motion({ clearance_mm: clearance, measured, next_stop: stop, motion }) {
    tile("clearance", known(clearance?.now, 1));
    const low = Boolean(clearance) && clearance.now < clearance.required;
    at("tile-clearance").classList.toggle("bad", low);
    write(at("note-clearance"), clearance ? `${low ? "below" : "of"} ${exact(clearance.required, "mm")} · ${clearance.pair.join(" – ")}` : "no obstacle near, or unknown");
    write(at("note-measured"), measuredClearance(measured));
    tile("stop", stop ? known(stop.distance_mm, 0) : "–");
    write(at("note-stop"), stop ? `${stop.name} in ${duration(stop.seconds)}` : "none ahead");
    tile("following", known(motion?.following_error_mm, 2));
    tile("lateness", known(motion?.lateness_ms, 2));
    write(at("note-lateness"), `worst ${known(motion?.worst_lateness_ms, 2)}`);
    tile("lost", known(motion?.lost_replies, 0));
    at("tile-lost").classList.toggle("bad", (motion?.lost_replies ?? 0) > 0);
  }

  /** Bars range from zero to 110 % of the upper limit, with the limits marked. */
  #tensions({ tensions_n: tensions, tension_limits_n: limits, drives_read: read }) {
    const [low, high] = limits;
    const list = at("tensions"), full = 1.1 * high;
    if (tensions && this.#bars.length !== tensions.length) this.#make(tensions.length, list);
    list.style.setProperty("--low", `${(100 * low) / full}%`);
    list.style.setProperty("--high", `${(100 * high) / full}%`);
    write(at("tension-limits"), `limits ${exact(low)} to ${exact(high, "N")}`);
    this.#bars.forEach(({ bar, value, row }, k) => {
      const tension = tensions?.[k] ?? null, trouble = tension === null ? null : tension < low ? "slack" : tension > high ? "too tight" : null;
      bar.style.width = `${tension === null ? 0 : Math.min(100, Math.max(0, (100 * tension) / full))}%`;
      bar.style.background = tension === null ? "" : globalThis.tensionColour((tension - low) / (high - low));
      write(value, known(tension, 1, "N"));
      row.classList.toggle("bad", trouble !== null);
    });
    const words = tensions?.every((t) => t === null) ? "Unknown: the drives have no torque." : tensions ? troubleText(tensions, limits) : read?.at ? "Unknown." : "Unknown: tensions are measured while the drives are enabled.";
    write(at("tension-trouble"), words);
    mark(at("tension-trouble"), "class", tensions?.some((t) => t !== null) && words ? "trouble" : "quiet");
    at("tension-trouble").hidden = !words;
  }

  #make(count, list) {
    this.#bars = Array.from({ length: count }, (_, k) => {
      const bar = make("span", { class: "bar" }), value = make("span", { class: "value figure" });
      return { bar, value, row: make("li", {}, make("span", { class: "cable" }, make("span", { class: "unseen" }, "Cable "), String(k + 1)), make("span", { class: "track", "aria-hidden": "true" }, bar), value) };
    });
    list.classList.toggle("dense", count > 8);
    list.classList.toggle("many", count > 12);
    list.replaceChildren(...this.#bars.map(({ row }) => row));
  }
}

function tile(name, text) {
  const value = at(`value-${name}`);
  write(value, text);
  value.closest("dd").classList.toggle("unknown", text === "–");
}
