/* The operator's panel: control, motion, drives, and plans. */

import { isActive, whyNot } from "./buttons.js";
import { address } from "./connection.js";
import { PlanCurves } from "./curves.js";
import { ask } from "./dialog.js";
import { at, chosen, duration, exact, known, make, mark, write } from "./elements.js";
import { motionText, restText } from "./live.js";

export class Operate {
  plan = null; // the loaded plan, from /api/preview
  #page;
  #compared = null; // id of the plan to compare
  #other = null; // that plan, from /api/compared
  #preview = null; // id of the plan loaded or being loaded
  #curves = new PlanCurves();
  #files = {}; // names listed so far, by group
  #busy = null;
  #sliding = false; // the operator moves the slider: the run's status must not
  #sending = 0; // nor while a new speed is on its way

  /** `page` has `command(name, fields)`, `situation()`, `say(text, failed)` and `scene`. */
  constructor(page) {
    this.#page = page;
    for (const button of document.querySelectorAll(".take")) button.addEventListener("click", () => this.#takeControl());
    for (const [id, command] of [["give-control", "give_control"], ["hold", "hold"], ["resume", "resume"]])
      at(id).addEventListener("click", () => page.command(command));
    at("speed").addEventListener("input", () => {
      this.#sliding = true;
      write(at("speed-shown"), `${at("speed").value} %`);
    });
    at("speed").addEventListener("change", async () => {
      this.#sending += 1;
      await page.command("speed", { percent: Number(at("speed").value) });
      this.#sending -= 1;
    });
    // After "change", which does not come if the slider was put back.
    for (const end of ["change", "pointerup", "pointercancel", "blur"]) at("speed").addEventListener(end, () => setTimeout(() => (this.#sliding = false)));
    at("service-begin").addEventListener("click", () => this.#service());
    at("service-end").addEventListener("click", () => page.command("service_end"));
    at("cable-begin").addEventListener("click", () => this.#cables());
    at("home").addEventListener("click", () => this.#home());
    at("reset").addEventListener("click", () => this.#reset());
    at("release").addEventListener("click", () => this.#release());
    at("read-drives").addEventListener("click", () => page.command("read_drives"));
    at("run").addEventListener("click", () => this.#run());
    at("load-plan").addEventListener("click", () => page.command("load_plan", { file: chosen("plan-file") }));
    at("compare-plan").addEventListener("click", () => page.command("compare", { file: chosen("plan-file") }));
    at("compare-end").addEventListener("click", () => page.command("compare", { file: null }));
    at("make-plan").addEventListener("click", () => page.command("plan", { scene: chosen("scene-file"), objective: chosen("objective") }));
    at("plan-time").addEventListener("input", () => this.#look());
    at("scene-live").addEventListener("click", () => this.#leave());
    this.readFiles();
  }

  /** Lists the files that can be loaded. A new file is selected, and so is a single one; otherwise the selection stays. */
  async readFiles() {
    const response = await fetch(address("/api/files")).catch(() => null);
    if (!response?.ok) return noteFiles(`The files could not be listed${response ? ` (error ${response.status})` : ""}: this list may be old.`);
    const { scenes, plans, left_out: leftOut } = await response.json();
    noteFiles(leftOut.length ? `Left out, as the name is not UTF-8: ${leftOut.join(", ")}. Rename it to use it.` : "");
    for (const [group, button, names] of [["scene-file", "scene_files", scenes], ["plan-file", "plan_files", plans]]) {
      const known = this.#files[group], added = known ? names.filter((name) => !known.includes(name)) : [];
      const selected = names.length === 1 ? names[0] : added.at(-1) ?? chosen(group);
      this.#files[group] = names;
      // Not a <select>: its open list would take the space bar, and cover STOP on a phone.
      const rows = names.map((name) => make("label", {}, make("input", { type: "radio", name: group, value: name, "data-button": button, checked: name === selected }), make("span", {}, name)));
      at(`${group}s`).replaceChildren(...(rows.length ? rows : [make("p", { class: "quiet" }, "No file found in the console’s working folder.")]));
    }
  }

  show(state) {
    const { control, motion, busy, preview, compared } = state;
    write(at("control-text"), state.read_only ? "This console is read-only: you see everything, and STOP works." : control.yours ? "You have control." : control.held_by ? `${control.held_by} has control. You see everything, and STOP works.` : "Control is free. Take it to command the robot.");
    at("take-control").hidden = control.yours;
    at("give-control").hidden = !control.yours;
    const isService = control.mode === "service";
    write(at("service-text"), isService ? "In service mode." : "For commissioning, with the robot in sight.");
    at("service-begin").hidden = isService;
    at("service-end").hidden = !isService;
    this.#motion(state);
    if (preview !== this.#preview) this.#read(preview);
    if (compared !== this.#compared) this.#readCompared(compared);
    if (isActive(motion)) this.#leave();
    at("plan-look").hidden = !(this.plan?.moments.length > 1) || isActive(motion);
    if (this.#busy && !busy) this.readFiles();
    this.#busy = busy?.verb ?? null;
    const { counts, known: isKnown, why_not: why } = state.reference;
    write(at("homed-text"), counts ? "The drives are homed." : `${isKnown ? "Not homed" : "Homed: unknown"}: ${why || "reason unknown"}.`);
  }

  #motion(state) {
    const { motion } = state, along = motion?.path_length_mm ? motion.path_mm / motion.path_length_mm : null;
    write(at("motion-state"), motionText(state));
    at("progress").classList.toggle("absent", along === null); // its space stays
    if (along !== null) {
      at("progress").value = along;
      write(at("progress-text"), `${known(motion.path_mm, 0)} of ${known(motion.path_length_mm, 0, "mm")} · ${duration(motion.elapsed_s)} · feed ${known(motion.feed_percent, 0)} %`);
    } else write(at("progress-text"), motion ? duration(motion.elapsed_s) : restText(state));
    write(at("motion-cause"), motion?.cause ?? "");
    const asked = motion?.wished.speed_percent;
    if (asked !== undefined && !this.#sliding && !this.#sending) {
      at("speed").value = asked;
      write(at("speed-shown"), `${Math.round(asked)} %`);
    }
  }

  // The plan.

  async #read(id) {
    this.#preview = id;
    this.plan = null;
    this.#leave();
    if (id !== null) {
      const response = await fetch(address("/api/preview")).catch(() => null);
      if (id !== this.#preview) return; // superseded meanwhile
      if (response?.ok) this.plan = await response.json();
      else this.#page.say("The plan cannot be read from the server.", true);
    }
    this.#showPlan();
    this.#showComparison();
  }

  async #readCompared(id) {
    this.#compared = id;
    this.#other = null;
    if (id !== null) {
      const response = await fetch(address("/api/compared")).catch(() => null);
      if (id !== this.#compared) return; // superseded meanwhile
      if (response?.ok) this.#other = await response.json();
      else this.#page.say("The plan to compare cannot be read from the server.", true);
    }
    this.#page.scene.compare(this.#other);
    this.#showComparison();
  }

  #showComparison() {
    const { plan } = this, other = this.#other;
    at("comparison").hidden = !plan || !other;
    if (!plan || !other) return;
    write(at("comparison-this"), plan.name);
    write(at("comparison-other"), other.name);
    const rows = [
      ["Check", (one) => (one.passed ? "passed" : "failed")],
      ["Length", (one) => known(one.length_mm, 0, "mm")],
      ["Duration", (one) => duration(one.duration_s)],
      ["Least clearance", (one) => known(one.least_clearance_mm, 1, "mm")],
      ["Largest tension", (one) => known(one.largest_tension_n, 1, "N")],
    ];
    at("comparison-rows").replaceChildren(...rows.map(([title, text]) =>
      make("tr", {}, make("th", { scope: "row" }, title), make("td", {}, text(plan)), make("td", {}, text(other)))));
  }

  #showPlan() {
    const { plan } = this;
    at("plan").hidden = at("plan-box").hidden = plan === null;
    this.#page.scene.load(plan);
    this.#curves.show(plan, this.#page.situation().state.tension_limits_n);
    if (!plan) return;
    write(at("plan-name"), plan.name);
    write(at("plan-verdict"), plan.verdict);
    at("plan-box").className = `verdict ${plan.passed ? "pass" : "fail"}`;
    write(at("plan-size"), `${known(plan.length_mm, 0, "mm")} in ${duration(plan.duration_s)}`);
    at("plan-checks").replaceChildren(...plan.checks.map((text) => make("li", {}, text)));
    const slider = at("plan-time");
    slider.max = Math.max(plan.moments.length - 1, 0);
    slider.value = 0;
  }

  #look() {
    const moment = this.plan?.moments[Number(at("plan-time").value)];
    if (!moment || isActive(this.#page.situation().state.motion)) return;
    mark(at("plan-time"), "aria-valuetext", `${moment.t.toFixed(1)} seconds`);
    this.#page.scene.look(moment);
  }

  #leave() {
    if (at("scene-preview").hidden) return;
    at("plan-time").value = 0;
    this.#page.scene.look(null);
  }

  // Confirmations.

  /** `seen` returns what the question is about: it is withdrawn when that changes. */
  async #confirmed(button, question, seen = () => null) {
    const { say, situation } = this.#page, asked = seen();
    return ask({ ...question, say, possible: () => whyNot(button, situation()) ?? (seen() === asked ? null : "What it showed has changed") });
  }

  async #takeControl() {
    const holder = this.#page.situation().state.control.held_by;
    if (holder === null) return this.#page.command("take_control");
    const lines = [`${holder} has control, and loses it immediately. Talk to its operator first.`, "Control cannot be taken while the robot moves."];
    if (await this.#confirmed("take_control", { title: "Take control away?", lines, confirm: "Take control" }, () => this.#page.situation().state.control.held_by)) this.#page.command("take_control", { force: true, held_by: holder });
  }

  async #service() {
    const lines = ["In service mode single winches can be moved. Obstacles, workspace and the platform’s pose are not checked.", "Enter it only with the robot in sight. It ends when you release control."];
    if (await this.#confirmed("service_begin", { title: "Enter service mode?", lines, confirm: "Enter service mode" })) this.#page.command("service_begin");
  }

  async #cables() {
    const { reference } = this.#page.situation().state;
    const lines = [
      "The drives are enabled at their present positions. One winch moves while you hold a button, a key or a stick.",
      "Only tensions and speed are checked; obstacles, workspace and pose are not. The platform may move, tilt or drop.",
      make("p", { class: "cause" }, make("b", {}, "Homing: "), reference.counts
        ? "the reference stays valid, as the drives keep counting. No run starts while their positions match no pose; wind back, or home again."
        : reference.known ? "the drives are not homed. Home them afterwards." : "unknown, as the drives could not be read."),
    ];
    if (await this.#confirmed("cable_begin", { title: "Enable the drives for single cables?", lines, confirm: "Enable the drives" })) this.#page.command("cable_begin");
  }

  async #home() {
    const { homes_by: camera, home_mm: home } = this.#page.situation().state;
    const onJig = `The platform must be held by the jig at the rig’s home pose, ${home.map((v) => exact(v)).join(", ")} mm. It is not measured: this position is stored, wherever the platform is.`;
    const lines = [
      make("p", { class: "cause" }, camera === null ? onJig : `Camera ${camera} measures where the platform is.`),
      "All winches wind in slowly until every cable is taut; the platform may move a little.",
      "The present homing reference is deleted first.",
    ];
    const confirm = camera === null ? "On the jig: winches move" : "Home: winches move";
    if (await this.#confirmed("home", { title: "Home the drives?", lines, confirm })) this.#page.command("home");
  }

  async #reset() {
    const { latched } = this.#page.situation().state;
    const lines = [make("p", { class: "cause" }, make("b", {}, "Cause: "), latched), "Remove the cause first.", "Reset releases the fault latch and resets drives in fault. Nothing moves; drives that hold keep holding."];
    if (await this.#confirmed("reset", { title: "Reset the latched fault?", lines, confirm: "Cause removed: reset" }, () => this.#page.situation().state.latched)) this.#page.command("reset", { cause: latched });
  }

  async #release() {
    const { platform, tensions_n: tensions } = this.#page.situation().state;
    const measured = (tensions ?? []).filter((t) => t !== null);
    const load = measured.length ? ` The tightest cable carries ${known(Math.max(...measured), 0, "N")}.` : "";
    const height = platform ? ` It is at z = ${known(platform.position_mm[2], 0, "mm")} now.` : " Its position is unknown.";
    const lines = [
      make("p", { class: "cause" }, "The platform drops unless it rests on a support or every winch has a brake."),
      `Brakes close, then the torque of all drives is removed together.${height}${load}`,
      "Winches without brakes pay out their cables, and the drives have to be homed again.",
    ];
    if (await this.#confirmed("release", { title: "Remove the torque of all drives?", lines, confirm: "Supported: release" })) this.#page.command("release");
  }

  async #run() {
    const { plan } = this, { plan_start_off_mm: off, simulated } = this.#page.situation().state;
    const rows = [["Plan", plan.name], ["Check", plan.verdict], ["Duration", duration(plan.duration_s)], ["Length", known(plan.length_mm, 0, "mm")]];
    const facts = make("dl", { class: "facts" }, ...rows.flatMap(([name, text]) => [make("dt", {}, name), make("dd", {}, text)]));
    // Drives on a bus have to be at the start; simulated ones are put there.
    const elsewhere = simulated && off > 1 ? [`The simulated platform is put at the plan’s start, ${known(off, 0, "mm")} from where it is shown.`] : [];
    const lines = [facts, ...elsewhere, "The drives are enabled and the platform moves. Keep clear of the platform and of its cables."];
    if (await this.#confirmed("run", { title: "Run this plan?", lines, confirm: "Run: the platform moves" }, () => this.plan)) {
      this.#page.command("run", { plan: plan.hash });
      at("motion").scrollIntoView({ block: "nearest" });
    }
  }
}

function noteFiles(text) {
  write(at("files-note"), text);
  at("files-note").hidden = !text;
}
