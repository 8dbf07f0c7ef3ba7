/** What happened: newest first. */

import { byId, make } from "./dom.js";
import { bytes, clock, length } from "./text.js";

const KEPT = 100;
const TEXTS = {
  lost: (what) => [`Lost at frame ${what.seq}`, "bad"],
  relocalized: (what) => [`Found again at frame ${what.seq} after ${what.lost_frames}`, "good"],
  loop_closed: (what) => [`Loop closed, map moved ${length(what.max_shift_m)}`, "good"],
  owner_changed: (what) => [`Map now with ${what.mapper}, epoch ${what.epoch}`, "warn"],
  saved: (what) => [`Saved, ${bytes(what.bytes)}`, "good"],
};

export class Events {
  constructor() {
    this.list = byId("events");
  }

  open() {
    this.known = new Set();
    this.list.replaceChildren();
    byId("events-empty").hidden = false;
  }

  /** Events come again when the connection was lost; each is shown once. */
  add(kind, what, id) {
    const name = `${id} ${what.time_s}`;
    if (this.known.has(name)) return;
    this.known.add(name);
    const [text, tone] = TEXTS[kind](what);
    const time = new Date(1000 * what.time_s).toISOString();
    this.list.prepend(make("li", { "data-kind": kind },
      make("span", { class: "dot", "data-tone": tone }), make("span", {}, text),
      make("time", { datetime: time }, clock(what.time_s))));
    while (this.list.children.length > KEPT) this.list.lastElementChild.remove();
    byId("events-empty").hidden = true;
  }
}
