/** The stage: splats drawn here, the exact view from the server, and lines over both. */

import { getJson, request, sessionPath } from "../api.js";
import { byId, choices, setText, toggle } from "../dom.js";
import { fixed, length } from "../text.js";
import { ExactView } from "./exact_view.js";
import { Legend } from "./legend.js";
import { Marks } from "./marks.js";
import { Split } from "./split.js";

const FIELD_OF_VIEW = (50 * Math.PI) / 180;
const MAX_WIDTH_PX = 640; // of an exact view; it is drawn on the server's processor
const FOLLOW_EVERY_MS = 400;
const PATIENCE_MS = 2000;
const PREVIEW_EVERY_MS = 8000;
const SLOW_MS = 130; // while the eye moves, views that take longer are drawn at half their size
const MODE_KEYS = { 1: "splats", 2: "split", 3: "exact" };
const LAYER_KEYS = { c: "colour", d: "depth", k: "confidence" };

export class Viewer {
  constructor() {
    this.stage = byId("stage");
    this.marks = new Marks(byId("marks"));
    this.legend = new Legend(byId("legend"));
    this.exact = new ExactView(byId("exact"), (about) => this.hearExact(about));
    this.split = new Split(this.stage, byId("divider"));
    this.mode = choices(byId("mode"), "split", () => this.showMode());
    this.layer = choices(byId("layer"), "colour", () => this.showLayer());
    this.follow = toggle(byId("follow"), (isOn) => { if (isOn) this.lookThroughLive(); });
    this.points = toggle(byId("points"), (asPoints) => this.splats?.show({ asPoints }));
    byId("overview").addEventListener("click", () => this.stepBack());
    this.stage.addEventListener("keydown", (event) => this.key(event));
    new ResizeObserver(() => this.resize()).observe(this.stage);
    this.loading = this.loadScene();
    this.showMode();
  }

  async loadScene() {
    const { Orbit } = await import("./orbit.js");
    this.orbit = new Orbit(byId("marks"), {
      moved: (isUser) => this.moved(isUser),
      settled: () => this.askExact(false),
    });
    if (this.pose) this.orbit.lookThrough(this.pose);
    await this.firstPicture();
    try {
      const { Splats } = await import("./splats.js");
      this.splats = new Splats(byId("scene"), this.orbit.camera);
      this.points.set(this.splats.isWeak);
    } catch {
      this.noSplats();
    }
    this.resize();
  }

  /** Starting WebGL may hold the page up for seconds: the server's first picture goes before it. */
  firstPicture() {
    return new Promise((done) => {
      if (this.stage.dataset.exact) done();
      this.pictureCame = done;
      setTimeout(done, PATIENCE_MS);
    });
  }

  /** Without WebGL the exact view is all there is, and enough. */
  noSplats() {
    for (const value of ["splats", "split"]) this.stage.parentElement.querySelector(`[data-value=${value}]`).disabled = true;
    byId("points").hidden = true;
    this.mode.choose("exact");
  }

  open(name, signal) {
    Object.assign(this, { name, signal, pose: null, live: null, revision: -1, previewOf: "", previewAt: 0, busy: false });
    this.marks.clear();
    this.splats?.clear();
    this.follow.set(true);
    this.note("Loading the map");
    setText(byId("stage-figures"), "");
    this.exact.open(sessionPath(name, "view"), signal);
    this.mapMoved();
    this.draw();
  }

  note(text) {
    setText(byId("stage-note"), text);
  }

  /** A frame was answered. */
  hearPose(pose) {
    this.isLost = pose.status === "LOST";
    if (this.isLost) { this.marks.breakPath(); return; }
    this.live = pose.T_map_camera;
    this.marks.addPose(this.live);
    const isDue = performance.now() - (this.followedAt ?? 0) > FOLLOW_EVERY_MS;
    if (this.follow.isOn && (isDue || !this.pose)) this.lookThroughLive();
    else this.draw();
  }

  lookThroughLive() {
    if (!this.live) return;
    this.followedAt = performance.now();
    this.look(this.live);
  }

  look(pose) {
    this.pose = pose;
    if (this.orbit) this.orbit.lookThrough(pose);
    else this.moved(false);
  }

  stepBack() {
    const from = this.live ?? this.marks.keyframes.at(-1);
    if (!from || !this.orbit) return;
    this.follow.set(false);
    this.orbit.uprightFor(this.marks.keyframes.length ? this.marks.keyframes : [from]);
    this.orbit.stepBack(from);
    this.askExact(false);
  }

  moved(isUser) {
    if (this.orbit) this.pose = this.orbit.pose;
    if (isUser) this.follow.set(false);
    this.draw();
    this.askExact(isUser);
  }

  /** Another revision of the map: its keyframes, and the splats when they are due. */
  hearMap(map) {
    if (map.map_revision === this.revision) return;
    this.revision = map.map_revision;
    this.fetchKeyframes(this.signal);
  }

  hearInfo(info) {
    this.fetchPreview(`${info.epoch}.${info.map_revision}.${info.iterations}`, info.keyframes, this.signal);
  }

  async fetchKeyframes(signal) {
    const { keyframes } = await this.quietly(() => getJson(sessionPath(this.name, "keyframes"), { signal })) ?? {};
    if (!keyframes || signal.aborted) return;
    this.marks.keyframes = keyframes.map((row) => row.T_map_camera);
    if (keyframes.length === 0) this.note("The map is empty: stream frames");
    else if (!this.pose) this.look(this.marks.keyframes.at(-1));
    if (!this.follow.isOn) return;
    this.orbit?.uprightFor(this.marks.keyframes);
    this.draw();
  }

  /** The whole path, in the map as it is now. */
  async mapMoved() {
    const { signal } = this;
    const path = await this.quietly(() => getJson(sessionPath(this.name, "path"), { signal }));
    if (!path || signal.aborted) return;
    this.marks.runs = path.runs;
    this.draw();
  }

  /** The splats as they are now, if they changed and it is not too soon. */
  async fetchPreview(state, keyframes, signal) {
    const isDue = performance.now() - this.previewAt > PREVIEW_EVERY_MS;
    if (state === this.previewOf || !isDue || this.busy || !keyframes || document.hidden) return;
    await this.loading;
    if (!this.splats || this.mode.value === "exact") return;
    this.busy = true;
    this.previewAt = performance.now();
    await this.quietly(async () => {
      const response = await request(sessionPath(this.name, "map?format=preview"), { signal });
      const bytes = await response.arrayBuffer();
      if (signal.aborted) return;
      await this.splats.load(bytes);
      this.previewOf = state;
      this.stage.dataset.splats = state;
    });
    if (signal === this.signal) this.busy = false;
  }

  /** Work whose failure is told on the stage and tried again by the next change. */
  async quietly(work) {
    const { signal } = this;
    try {
      return await work();
    } catch (error) {
      if (!signal.aborted) this.note(error.message);
      return null;
    }
  }

  /** Ask the server for what the eye sees; while it moves, small if that takes long. */
  askExact(isMoving) {
    if (!this.pose || this.mode.value === "splats") return;
    const { clientWidth, clientHeight } = this.stage;
    if (!clientWidth) return;
    const scale = isMoving && this.renderMs > SLOW_MS ? 0.5 : 1;
    const width = Math.max(16, Math.round(scale * Math.min(MAX_WIDTH_PX, clientWidth)));
    const height = Math.max(16, Math.round((width * clientHeight) / clientWidth));
    const focal = height / 2 / Math.tan(FIELD_OF_VIEW / 2);
    this.exact.ask({
      T_map_camera: this.pose,
      intrinsics: { fx: focal, fy: focal, cx: (width - 1) / 2, cy: (height - 1) / 2, width, height },
      layer: this.layer.value,
    });
  }

  hearExact(about) {
    if (about.error) { this.note(about.error.reason); return; }
    this.note("");
    this.pictureCame?.();
    this.renderMs = about.render_ms;
    this.stage.dataset.exact = about.state;
    this.stage.dataset.pictures = Number(this.stage.dataset.pictures ?? 0) + 1;
    setText(byId("stage-figures"), `exact ${fixed(about.render_ms)} ms · revision ${about.map_revision} · known ${Math.round(100 * about.confidence)} %`);
    this.legend.show(this.layer.value, about.range_m?.map(length));
  }

  showMode() {
    const mode = this.mode.value;
    this.stage.dataset.mode = mode;
    this.split.show(mode === "split");
    if (this.splats) { this.splats.isHidden = mode === "exact"; this.splats.redraw(); }
    if (mode === "splats") this.legend.hide();
    else this.askExact(false);
  }

  /** A layer is of the exact view: it is shown with it. */
  showLayer() {
    if (this.mode.value === "splats") this.mode.choose("split");
    else this.askExact(false);
  }

  draw() {
    this.marks.draw(this.pose, FIELD_OF_VIEW);
    this.splats?.redraw();
  }

  resize() {
    const { clientWidth, clientHeight } = this.stage;
    if (!clientWidth || !clientHeight) return;
    this.orbit?.resize(clientWidth, clientHeight);
    this.splats?.resize(clientWidth, clientHeight);
    this.draw();
    this.askExact(false);
  }

  key(event) {
    if (event.ctrlKey || event.metaKey || event.altKey) return;
    const { key } = event;
    if (MODE_KEYS[key]) this.mode.choose(MODE_KEYS[key]);
    else if (LAYER_KEYS[key]) this.layer.choose(LAYER_KEYS[key]);
    else if (key === "f") this.follow.set(!this.follow.isOn);
    else if (key === "o") this.stepBack();
    else if (key === "p") this.points.set(!this.points.isOn);
    else if (!this.orbit?.key(key)) return;
    event.preventDefault();
  }
}
