/** The sessions of the gateway with their state, newest first. */

import { make, setText } from "./dom.js";
import { count, fixed, trackingState } from "./text.js";

export class SessionList {
  constructor(element) {
    this.element = element;
    this.rows = null;
    this.marked = "";
    this.items = new Map();
  }

  show(rows) {
    this.rows = rows;
    this.element.removeAttribute("aria-busy");
    const names = rows.map((row) => row.session);
    for (const [name, item] of this.items) {
      if (!names.includes(name)) { item.remove(); this.items.delete(name); }
    }
    this.element.querySelector(".note")?.remove();
    for (const row of rows) this.showRow(row);
    const isSorted = names.every((name, i) => this.element.children[i] === this.items.get(name));
    if (!isSorted) this.element.replaceChildren(...names.map((name) => this.items.get(name)));
    if (rows.length === 0) this.element.replaceChildren(make("li", { class: "note" }, "None yet"));
  }

  fail(reason) {
    this.element.removeAttribute("aria-busy");
    if (this.rows === null) this.element.replaceChildren(make("li", { class: "note bad" }, reason));
  }

  /** Mark the session that is shown. */
  mark(name) {
    this.marked = name;
    for (const [key, item] of this.items) {
      const link = item.firstElementChild;
      if (key === name) link.setAttribute("aria-current", "page");
      else link.removeAttribute("aria-current");
    }
  }

  showRow(row) {
    if (!this.items.has(row.session)) this.items.set(row.session, emptyItem(row.session));
    const item = this.items.get(row.session);
    const { word, tone, level } = trackingState(row.tracking);
    const rate = row.tracking?.frame_rate_hz;
    item.querySelector(".dot").dataset.tone = tone;
    setText(item.querySelector(".rate"), rate ? `${fixed(rate, 1)} fps` : "");
    setText(item.querySelector(".word"), row.is_open ? word : "on disk");
    setText(item.querySelector(".keyframes"), ` · ${count(row.keyframes)} keyframes`);
    showMeter(item.querySelector(".meter"), rate ? level : 0, tone);
  }
}

function emptyItem(name) {
  return make("li", {}, make("a", { href: `#${encodeURIComponent(name)}` },
    make("span", { class: "dot" }),
    make("span", { class: "name", title: name }, name),
    make("span", { class: "rate" }),
    make("span", { class: "state" },
      make("span", { class: "word" }), make("span", { class: "keyframes" }),
      make("span", { class: "meter", hidden: "" }, ...[1, 2, 3, 4].map(() => make("i"))))));
}

function showMeter(meter, level, tone) {
  meter.hidden = level === 0;
  meter.dataset.tone = tone;
  meter.title = `tracking quality ${level} of 4`;
  [...meter.children].forEach((bar, i) => bar.classList.toggle("on", i < level));
}
