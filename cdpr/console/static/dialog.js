/* A confirmation before a command. STOP stays visible above it and usable. */

import { at, make } from "./elements.js";

let open = null; // {possible, close}

/**
 * Asks; resolves to true when confirmed. `lines` are plain texts or nodes. The question closes when `possible()` returns a
 * reason, which is passed to `say`.
 */
export function ask({ title, lines, confirm, possible, say }) {
  open?.close(false);
  return new Promise((resolve) => {
    const before = document.activeElement, shade = at("dialog");
    const close = (answer) => {
      open = null;
      shade.hidden = true;
      shade.replaceChildren();
      setInert(false);
      if (before instanceof HTMLElement && before.isConnected) before.focus();
      resolve(answer);
    };
    const cancel = make("button", { type: "button", onclick: () => close(false) }, "Cancel");
    const yes = make("button", { type: "button", class: "confirm", onclick: () => close(true) }, confirm);
    const box = make("div", { class: "box", role: "alertdialog", "aria-labelledby": "dialog-title", "aria-describedby": "dialog-text" },
      make("h2", { id: "dialog-title" }, title),
      make("div", { id: "dialog-text" }, ...lines.map((line) => (typeof line === "string" ? make("p", {}, line) : line))),
      make("div", { class: "row answers" }, cancel, yes));
    box.addEventListener("keydown", (event) => {
      if (event.key !== "Tab") return;
      event.preventDefault(); // between the two answers and STOP
      const round = [cancel, yes, at("stop")], index = round.indexOf(document.activeElement);
      round[(index + (event.shiftKey ? 2 : 1)) % 3].focus();
    });
    shade.replaceChildren(box);
    shade.hidden = false;
    setInert(true);
    open = { possible, close, say };
    cancel.focus();
  });
}

/** Closes a question that no longer applies; to be called with every state. */
export function checkDialog() {
  const why = open?.possible();
  if (!why) return;
  open.say(`The question was withdrawn: ${why}.`);
  open.close(false);
}

/** STOP and Escape answer no. */
export function cancelDialog() {
  open?.close(false);
}

function setInert(on) {
  for (const element of document.querySelectorAll("#top, #tabs, main")) element.inert = on;
}
