/** Save, refine, export: what the buttons do, and how far it is. */

import { Problem, postJson, request, sessionPath } from "./api.js";
import { byId, setText } from "./dom.js";
import { save } from "./files.js";
import { bytes, fixed } from "./text.js";

export class Actions {
  constructor() {
    byId("save").addEventListener("click", (event) => this.run(event.currentTarget, () => this.save()));
    byId("refine").addEventListener("click", (event) => this.run(event.currentTarget, () => this.refine()));
    byId("job-stop").addEventListener("click", (event) => this.run(event.currentTarget, () => this.stop()));
    for (const button of document.querySelectorAll("[data-download]")) {
      button.addEventListener("click", () => this.run(button, () => this.download(button)));
    }
  }

  open(name, signal) {
    this.name = name;
    this.signal = signal;
    byId("job").hidden = true;
    this.say("");
  }

  say(text, isBad = false) {
    const note = byId("action-note");
    setText(note, text);
    note.classList.toggle("bad", isBad);
  }

  /** A button is disabled while its work is under way; a refusal is told below. */
  async run(button, work) {
    button.disabled = true;
    try {
      await work();
    } catch (error) {
      if (!(error instanceof Problem)) throw error;
      this.say(error.message, true);
    } finally {
      button.disabled = false;
    }
  }

  async save() {
    this.say("Saving");
    const saved = await postJson(sessionPath(this.name, "save"));
    this.say(`Saved, ${bytes(saved.bytes)}.`);
  }

  async refine() {
    const iterations = byId("refine-iterations").valueAsNumber;
    this.hearJob(await postJson(sessionPath(this.name, "refine"), { iterations }));
    this.say("");
  }

  async stop() {
    const response = await request(sessionPath(this.name, "refine"), { method: "DELETE" });
    this.hearJob(await response.json());
  }

  /** How far the present or the last refinement is. */
  hearJob(job) {
    if (!job || job.state === "none") return;
    const isRunning = job.state === "running";
    byId("job").hidden = false;
    byId("job").dataset.state = job.state;
    byId("job-stop").hidden = !isRunning;
    byId("refine").disabled = isRunning;
    byId("job-progress").value = job.iterations_done / Math.max(job.iterations_total, 1);
    const figures = `${job.iterations_done} of ${job.iterations_total}`;
    const psnr = job.psnr_db === null ? "" : `, ${fixed(job.psnr_db, 1)} dB`;
    const words = { running: "Refining", done: "Refined", interrupted: "Stopped", failed: "Failed" };
    setText(byId("job-text"), `${words[job.state]}: ${figures}${psnr}${job.error ? `, ${job.error}` : ""}`);
  }

  async download(button) {
    const what = button.textContent;
    this.say(`${what}: asking`);
    const response = await request(sessionPath(this.name, button.dataset.download), { signal: this.signal });
    const file = await this.received(response, what);
    save(file, `${this.name}.${button.dataset.file}`);
    this.say(`${what}: ${bytes(file.size)}.`);
  }

  async received(response, what) {
    const total = Number(response.headers.get("Content-Length")) || 0;
    const parts = [];
    let size = 0;
    for (const reader = response.body.getReader(); ;) {
      const { done, value } = await reader.read();
      if (done) return new Blob(parts);
      parts.push(value);
      size += value.length;
      this.say(`${what}: ${bytes(size)}${total ? ` of ${bytes(total)}` : ""}`);
    }
  }
}
