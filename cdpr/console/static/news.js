/* Messages in the strip above STOP: the latched fault, the verb in progress, and how the last one ended.

The strip always has its space, so no message moves or covers a control. */

import { isActive } from "./buttons.js";
import { address } from "./connection.js";
import { at, capital, link, write } from "./elements.js";
import { STATES } from "./live.js";

const VERBS = { run: "Run", home: "Homing", reset: "Reset", release: "Release", plan: "Planning", jog: "Jogging", load: "Loading" };
const DISMISSED = "cdpr dismissed outcome";

/** The line of a verb's output with the result: the last that is neither indented nor a report. */
function headline({ text, stopped }) {
  const lines = text.trim().split("\n");
  const found = lines.findLast((line) => /^\S/.test(line) && !line.startsWith("report:")) ?? lines.at(-1);
  const verdict = stopped ? /^(STOPPED|PASSED|FAILED|error:) +(?=\S)/ : /^(STOPPED|PASSED|FAILED) +(?=\S)/;
  const sentence = found.replace(verdict, "").trim();
  return sentence === found.trim() ? sentence : capital(sentence);
}

/** The verb in progress. Of a run that moves, its state: the last line of its output may be long past. */
export function busyText({ busy, motion, jog, cable }) {
  if (!busy) return "";
  const verb = VERBS[busy.verb] ?? busy.verb;
  if (jog.ready || cable.ready) return `${verb} is enabled`;
  if (busy.verb !== "run" || !isActive(motion)) return `${verb}: ${busy.text || "…"}`;
  const state = (STATES[motion.state] ?? motion.state).toLowerCase();
  const rests = ["moving", "holding"].includes(motion.state) && motion.feed_percent === 0; // such as at a stop
  return `${verb}: ${state}${rests && busy.text ? `, ${busy.text}` : ""}`;
}

function titleOf({ verb, ok, stopped }, preview) {
  if (verb === "plan" && ok && preview !== null) return "Path planned: it is loaded under Operate";
  return `${VERBS[verb] ?? verb}: ${stopped ? "stopped" : ok ? "done" : "not completed"}`;
}

/** What this tab remembers; a browser may refuse both. */
const memory = {
  read: () => {
    try {
      return sessionStorage.getItem(DISMISSED);
    } catch {
      return null;
    }
  },
  write: (text) => {
    try {
      if (text === null) sessionStorage.removeItem(DISMISSED);
      else sessionStorage.setItem(DISMISSED, text);
    } catch { /* then it comes back after a reload */ }
  },
};

export class News {
  #outcome = ""; // the one that was shown last, as text
  #dismissed = memory.read();

  /** `page` has `view(name)`. */
  constructor(page) {
    at("outcome-seen").addEventListener("click", () => {
      memory.write((this.#dismissed = this.#outcome));
      at("news-more").open = false;
      this.#arrange();
    });
    at("outcome-show").addEventListener("click", () => {
      page.view("operate");
      at("plan-box").scrollIntoView({ block: "nearest" });
    });
    at("news-more").addEventListener("toggle", () => (at("outcome-text").scrollTop = at("outcome-text").scrollHeight)); // the result is at the end
  }

  show(state) {
    const { latched, outcome, busy, preview } = state;
    at("latched").hidden = latched === null;
    write(at("latched-cause"), latched ?? "");
    write(at("latched-full").querySelector("p"), latched ?? "");
    at("busy").hidden = !busy;
    write(at("busy"), busyText(state));
    this.#showOutcome(outcome, preview);
    this.#arrange();
  }

  #showOutcome(outcome, preview) {
    const text = outcome ? JSON.stringify(outcome) : "";
    const isNew = text !== this.#outcome;
    if (isNew) at("news-more").open = false;
    if (!outcome) memory.write((this.#dismissed = null));
    this.#outcome = text;
    if (!outcome) return;
    const title = titleOf(outcome, preview), head = headline(outcome);
    write(at("outcome-title"), title);
    write(at("outcome-full").querySelector("h2"), title);
    write(at("outcome-headline"), head);
    write(at("outcome-full").querySelector(".sentence"), head);
    at("outcome-show").hidden = !(outcome.verb === "plan" && outcome.ok && preview !== null);
    if (!isNew) return;
    const kind = outcome.stopped ? "" : outcome.ok ? "pass" : "fail";
    at("outcome").className = kind;
    at("outcome-full").className = `verdict ${kind}`;
    write(at("outcome-text"), outcome.text);
    for (const place of document.querySelectorAll("#news .links")) {
      const links = [[outcome.report, "Report"], [outcome.fault_page, "What this fault means"]].map(([where, name]) => where && link(address(where), name));
      place.replaceChildren(...links.filter(Boolean));
    }
  }

  #arrange() {
    const isLatched = !at("latched").hidden, isShown = this.#outcome !== "" && this.#outcome !== this.#dismissed;
    at("outcome").hidden = at("outcome-full").hidden = !isShown;
    at("latched-full").hidden = !isLatched;
    at("news-more").hidden = !isLatched && !isShown;
    at("news-none").hidden = isLatched || isShown || !at("busy").hidden;
  }
}
