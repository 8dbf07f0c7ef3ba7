/** A keyframe's recorded image beside the map's render of the same view, under one slider. */

import { getJson, request, sessionPath } from "./api.js";
import { byId, setText, showBlob } from "./dom.js";
import { length } from "./text.js";

const WIDTH_PX = 640;
const SETTLE_MS = 120;

export class Compare {
  constructor() {
    this.pair = byId("pair");
    this.slider = byId("compare-keyframe");
    this.slider.addEventListener("input", () => { this.isTouched = true; this.chooseSoon(); });
    byId("compare-divider").addEventListener("input", (event) => {
      this.pair.style.setProperty("--share", `${event.target.value}%`);
    });
  }

  open(name, signal) {
    this.name = name;
    this.signal = signal;
    this.keyframes = [];
    this.isTouched = false;
    this.shown = -1;
    this.state("empty", "No keyframe yet");
    setText(byId("compare-facts"), "");
    setText(byId("compare-seq"), "");
    this.slider.max = 0;
  }

  state(state, note = "") {
    this.pair.dataset.state = state;
    setText(byId("compare-note"), note);
  }

  /** The map has changed: know the new keyframes; show the first pair as soon as there is one. */
  async hearMap(map) {
    if (map.keyframes === 0 || document.hidden) return;
    const { signal } = this;
    try {
      const { keyframes } = await getJson(sessionPath(this.name, "keyframes"), { signal });
      this.keyframes = keyframes;
    } catch (error) {
      if (!signal.aborted) this.state("error", error.message);
      return;
    }
    this.slider.max = this.keyframes.length - 1;
    if (this.shown < 0 && this.keyframes.length > 0) {
      this.slider.value = Math.floor((this.keyframes.length - 1) / 2);
      this.chooseSoon();
    }
  }

  chooseSoon() {
    const keyframe = this.keyframes[this.slider.valueAsNumber];
    if (!keyframe) return;
    setText(byId("compare-seq"), `frame ${keyframe.seq}`);
    clearTimeout(this.timer);
    this.timer = setTimeout(() => this.choose(keyframe, this.signal), SETTLE_MS);
  }

  async choose(keyframe, signal) {
    if (this.pair.dataset.state !== "shown") this.state("loading", "Drawing");
    this.wanted = keyframe.seq;
    try {
      const image = await request(sessionPath(this.name, `keyframes/${keyframe.seq}/image`), { signal });
      const render = await this.render(keyframe, image.headers.get("X-Time-Ns"), signal);
      if (signal.aborted || this.wanted !== keyframe.seq) return;
      await Promise.all([
        showBlob(byId("compare-image"), await image.blob()),
        showBlob(byId("compare-render"), await render.blob()),
      ]);
      this.shown = keyframe.seq;
      this.state("shown");
      const { x, y, z } = keyframe.T_map_camera.position;
      setText(byId("compare-facts"), `${length(Math.hypot(x, y, z))} from the origin`);
    } catch (error) {
      // The newest keyframes are known before the map has them; the next change asks again.
      if (signal.aborted) return;
      this.shown = -1;
      this.state("error", error.status === 404 ? "The map does not have this keyframe yet" : error.message);
    }
  }

  render(keyframe, time, signal) {
    const query = new URLSearchParams({
      T_map_camera: JSON.stringify(keyframe.T_map_camera), width: WIDTH_PX, appearance_t_ns: time,
    });
    return request(sessionPath(this.name, `render?${query}`), { signal });
  }
}
