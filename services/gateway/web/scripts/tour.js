/** A video along a path through the map, drawn by the server, saved here. */

import { Problem, getJson, postJson, request, sessionPath } from "./api.js";
import { byId, setText } from "./dom.js";
import { save } from "./files.js";
import { bytes } from "./text.js";

const LOOK_EVERY_MS = 500;
const SIZE = { width: 640, frames: 150, fps: 30 };

export class Tour {
  /** `view()` is what the viewer shows: { pose, layer }. */
  constructor(view) {
    this.view = view;
    byId("tour").addEventListener("click", () => this.run());
    byId("tour-stop").addEventListener("click", () => this.stop());
  }

  open(name, signal) {
    this.name = name;
    this.signal = signal;
    this.job = null;
    this.show(null, "");
  }

  async run() {
    const { signal } = this;
    byId("tour").disabled = true;
    try {
      await this.draw(signal);
    } catch (error) {
      if (!(error instanceof Problem)) throw error;
      this.show(null, error.message, true);
    } finally {
      byId("tour").disabled = false;
    }
  }

  async draw(signal) {
    this.show(null, "Video: asking");
    let status = await postJson(sessionPath(this.name, "renders"), this.wanted());
    this.job = sessionPath(this.name, `renders/${status.job}`);
    while (status.state === "running") {
      this.show(status, `Video: ${status.frames_done} of ${status.frames_total} pictures`);
      await new Promise((resume) => setTimeout(resume, LOOK_EVERY_MS));
      if (signal.aborted || !this.job) return;
      status = await getJson(this.job);
    }
    if (status.state !== "done") throw new Problem(0, `Video: ${status.error || status.state}`);
    this.show(null, "Video: fetching");
    const file = await (await request(`${this.job}/file`, { signal })).blob();
    save(file, `${this.name}.webm`);
    this.show(null, `Video: ${bytes(file.size)}.`);
  }

  wanted() {
    const { pose, layer } = this.view();
    const path = byId("tour-path").value;
    return { ...SIZE, path, layer, poses: path === "orbit" && pose ? [pose] : [] };
  }

  async stop() {
    const { job } = this;
    this.job = null;
    if (job) await request(job, { method: "DELETE" });
    this.show(null, "Video: stopped");
  }

  show(status, text, isBad = false) {
    byId("tour-job").hidden = !text;
    byId("tour-progress").hidden = byId("tour-stop").hidden = !status;
    if (status) byId("tour-progress").value = status.frames_done / status.frames_total;
    setText(byId("tour-text"), text);
    byId("tour-text").classList.toggle("bad", isBad);
  }
}
