/* DOM elements: finding and creating them, writing texts and numbers. */

export const at = (id) => document.getElementById(id);

/** A new element with attributes, listeners (`onclick: …`) and children, which are nodes or plain texts. */
export function make(tag, attributes = {}, ...children) {
  const element = document.createElement(tag);
  for (const [name, value] of Object.entries(attributes)) {
    if (name.startsWith("on")) element.addEventListener(name.slice(2), value);
    else if (value === true) element.setAttribute(name, "");
    else if (value !== null && value !== false) element.setAttribute(name, value);
  }
  element.append(...children);
  return element;
}

/** The value of the checked radio button of a group, or null. */
export function chosen(name) {
  return document.querySelector(`input[name="${name}"]:checked`)?.value ?? null;
}

/** Writes a text only if it differs: a screen reader would repeat it otherwise. */
export function write(element, text) {
  if (element.textContent !== text) element.textContent = text;
}

/** A reason as a line of its own, which begins with a capital letter. */
export const capital = (text) => text.charAt(0).toUpperCase() + text.slice(1);

/** Sets an attribute only if it differs; null removes it. */
export function mark(element, name, value) {
  if (value === null) element.removeAttribute(name);
  else if (element.getAttribute(name) !== value) element.setAttribute(name, value);
}

/** A number with its unit, or a dash if unknown. */
export function known(value, digits, unit = "") {
  const rounded = value?.toFixed(digits) ?? "–";
  const number = Number(rounded) === 0 ? rounded.replace("-", "") : rounded.replace("-", "\u2212"); // no negative zero
  return unit && number !== "–" ? `${number}\u00a0${unit}` : number;
}

/** A limit or a set value: rounded, it could be on the other side of a measured value. */
export function exact(value, unit = "") {
  const [, decimals = ""] = String(Number(value.toPrecision(6))).split(".");
  return known(value, decimals.length, unit);
}

/** Local date, empty if it is today, and time of a moment. */
export function dateAndTime(iso) {
  const moment = new Date(iso), isToday = moment.toDateString() === new Date().toDateString();
  const date = isToday ? "" : moment.toLocaleDateString("en-GB", { day: "numeric", month: "short" });
  return [date, moment.toLocaleTimeString("en-GB")];
}

/** A duration as text. */
export function duration(seconds) {
  if (seconds === null || seconds === undefined) return "–";
  const whole = Math.round(seconds);
  return whole < 60 ? `${seconds.toFixed(1)}\u00a0s` : `${Math.floor(whole / 60)}\u00a0min ${whole % 60}\u00a0s`;
}

/** Whether keys typed there are text, including the space. */
export function isTextField(target) {
  if (!(target instanceof Element)) return false;
  if (target.closest("textarea, [contenteditable='true']")) return true;
  const other = ["button", "checkbox", "color", "file", "image", "radio", "range", "reset", "submit"];
  return target instanceof HTMLInputElement && !other.includes(target.type);
}

/** A link to this server that opens a new tab; null for any other address. */
export function link(address, text) {
  if (typeof address !== "string" || !address.startsWith("/") || address.startsWith("//")) return null;
  return make("a", { href: address, target: "_blank", rel: "noopener" }, text);
}
