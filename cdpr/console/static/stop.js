/* STOP: a path stop for every page, in every view, also with stale data.

It acts on pointerdown, and on the space bar and Escape outside text fields, before any other handler. It is an
operational stop, in black as IEC 60204-1 prefers, not an emergency stop. */

import { isActive } from "./buttons.js";
import { at, isTextField, write } from "./elements.js";

const ANSWER_MS = 6000; // an answer is shown for this time
const SILENT_MS = 1000; // without an answer by then, the operator is warned
const STOPPING = "Stopping along the path";

/** Binds STOP; `pressed()` is called before each is sent; `atRest()` is true while nothing can move. */
export function bindStop(connection, pressed, atRest) {
  const button = at("stop"), answer = at("stop-answer");
  let presses = 0, moved = false;

  function fail(text) {
    write(answer, text);
    answer.classList.add("failed");
  }

  async function stop() {
    const press = ++presses;
    pressed();
    button.classList.add("pressed");
    write(answer, "STOP sent");
    answer.classList.remove("failed");
    const silence = setTimeout(() => press === presses && fail(`No answer to STOP for ${SILENT_MS / 1000} s: use the emergency-stop button.`), SILENT_MS);
    const { ok, what } = await connection.stop();
    clearTimeout(silence);
    if (press !== presses) return;
    button.classList.remove("pressed");
    const harmless = ok || atRest();
    write(answer, what || "Stop requested");
    answer.classList.toggle("failed", !harmless);
    // Any other answer stays, until the next press, a press on it, or a motion of this user.
    if (harmless) setTimeout(() => press === presses && write(answer, ""), ANSWER_MS);
  }

  button.addEventListener("pointerdown", (event) => {
    event.preventDefault();
    stop();
  });
  button.addEventListener("click", (event) => {
    if (event.detail === 0) stop(); // Enter or a screen reader: no pointerdown came before
  });
  answer.addEventListener("click", () => {
    write(answer, "");
    answer.classList.remove("failed");
  });
  const isStop = (event) => [" ", "Escape"].includes(event.key) && !event.isComposing && !isTextField(event.target);
  window.addEventListener("keydown", (event) => {
    if (event.key === "Enter" && event.repeat) {
      // Held, it presses once: it must not press a button that gets the focus meanwhile.
      event.preventDefault();
      event.stopImmediatePropagation();
    }
    if (!isStop(event)) return;
    event.preventDefault(); // no press of the focused button, no scrolling
    if (event.key === " ") event.stopImmediatePropagation();
    if (!event.repeat) stop();
  }, { capture: true });
  window.addEventListener("keyup", (event) => {
    if (isStop(event) && event.key === " ") event.preventDefault(); // buttons act on it
  }, { capture: true });
  // The space bar is STOP, so Enter toggles boxes.
  document.addEventListener("keydown", (event) => {
    if (event.key === "Enter" && event.target instanceof HTMLInputElement && ["checkbox", "radio"].includes(event.target.type)) event.target.click();
  });
  return {
    /** Shows the run's response, unless STOP failed; a run that begins supersedes any answer. */
    show: (motion) => {
      const begins = isActive(motion) && !moved;
      moved = isActive(motion);
      const asked = motion?.wished.stop && !["finished", "stopped", "latched"].includes(motion.state);
      button.classList.toggle("asked", Boolean(asked));
      if (button.classList.contains("pressed")) return;
      if (begins) answer.classList.remove("failed");
      if (asked && !answer.classList.contains("failed")) write(answer, STOPPING);
      else if (begins || answer.textContent === STOPPING) write(answer, "");
    },
  };
}
