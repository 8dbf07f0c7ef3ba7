/** One session: what the gateway tells of it goes to the parts of the page that show it. */

import { Actions } from "./actions.js";
import { getJson, listen, sessionPath } from "./api.js";
import { Compare } from "./compare.js";
import { byId, setText } from "./dom.js";
import { Events } from "./events.js";
import { LiveImage } from "./live_image.js";
import { count, trackingState } from "./text.js";
import { showFigures } from "./figures.js";
import { Tour } from "./tour.js";
import { Viewer } from "./viewer/viewer.js";

const INFO_EVERY_MS = 2000;

export class SessionPage {
  constructor() {
    this.name = "";
    this.viewer = new Viewer();
    this.compare = new Compare();
    this.live = new LiveImage();
    this.events = new Events();
    this.actions = new Actions();
    this.tour = new Tour(() => ({ pose: this.viewer.pose, layer: this.viewer.layer.value }));
    this.closing = new AbortController();
  }

  open(name) {
    if (name === this.name) return;
    this.close();
    this.name = name;
    this.closing = new AbortController();
    this.setHidden(false);
    document.title = `${name} · PointSLAM++`;
    setText(byId("session-name"), name);
    setText(byId("session-facts"), "");
    this.tracking = null;
    this.info = null;
    const { signal } = this.closing;
    for (const part of [this.viewer, this.compare, this.live, this.events, this.actions, this.tour]) part.open(name, signal);
    this.follow(signal);
    this.keepInformed(signal);
  }

  close() {
    this.closing.abort();
    this.name = "";
    this.setHidden(true);
    document.title = "PointSLAM++";
  }

  setHidden(isHidden) {
    byId("session-view").hidden = isHidden;
    byId("side").hidden = isHidden;
  }

  /** Poses and events as they come. */
  follow(signal) {
    const tell = (kind) => (what, id) => {
      this.events.add(kind, what, id);
      if (kind === "loop_closed" || kind === "owner_changed") this.viewer.mapMoved();
    };
    listen(sessionPath(this.name, "events"), {
      pose: (pose) => this.hearPose(pose),
      map: (map) => { this.viewer.hearMap(map); this.compare.hearMap(map); },
      lost: tell("lost"),
      relocalized: tell("relocalized"),
      loop_closed: tell("loop_closed"),
      owner_changed: tell("owner_changed"),
      saved: tell("saved"),
      connected: (isConnected) => { byId("session-view").dataset.connected = String(isConnected); },
    }, signal);
  }

  hearPose(pose) {
    this.tracking = pose.tracking;
    this.viewer.hearPose(pose);
    this.live.hearFrame(pose.seq);
    this.show();
  }

  /** The slower figures: the map's size, its quality, a refinement. */
  async keepInformed(signal) {
    while (!signal.aborted) {
      try {
        if (!document.hidden) this.hearInfo(await getJson(sessionPath(this.name), { signal }));
      } catch (error) {
        if (signal.aborted) return;
        setText(byId("session-facts"), error.message);
      }
      await new Promise((resume) => setTimeout(resume, INFO_EVERY_MS));
    }
  }

  hearInfo(info) {
    this.info = info;
    this.tracking = info.tracking;
    this.actions.hearJob(info.refinement);
    this.viewer.hearInfo(info);
    this.show();
  }

  show() {
    const { word, tone } = trackingState(this.tracking);
    const chip = byId("session-status");
    setText(chip, word);
    chip.dataset.tone = tone;
    showFigures(byId("figures"), this.tracking, this.info);
    if (this.info) {
      const { frames, keyframes, mode, mapper } = this.info;
      setText(byId("session-facts"), `${mode} · ${count(frames)} frames · ${count(keyframes)} keyframes · ${mapper}`);
    }
  }
}
