/** The map's own view over a WebSocket: cameras go out, the newest is drawn, pictures come back. */

import { openSocket } from "../api.js";
import { showBlob } from "../dom.js";

const RETRY_MS = 2000;

export class ExactView {
  /** `told(about)` hears of each picture and of each refusal. */
  constructor(image, told) {
    this.image = image;
    this.told = told;
    this.socket = null;
    this.wanted = null;
    this.id = 0;
  }

  /** Connect, and again whenever the connection breaks, until `signal` aborts. */
  async open(path, signal) {
    this.image.hidden = true;
    this.wanted = null;
    while (!signal.aborted) {
      try {
        await this.serve(await openSocket(path), signal);
      } catch (error) {
        this.told({ error: { reason: error.message } });
      }
      await new Promise((resume) => setTimeout(resume, RETRY_MS));
    }
  }

  /** Ask for a view; one that waits is forgotten. */
  ask(camera) {
    this.id += 1;
    this.wanted = { ...camera, id: this.id };
    if (this.socket?.readyState === WebSocket.OPEN) this.send();
  }

  send() {
    if (this.wanted) this.socket.send(JSON.stringify(this.wanted));
    this.wanted = null;
  }

  serve(socket, signal) {
    this.socket = socket;
    let about = null;
    return new Promise((done) => {
      const end = () => { socket.close(); done(); };
      signal.addEventListener("abort", end, { once: true });
      socket.onopen = () => this.send();
      socket.onclose = end;
      socket.onmessage = ({ data }) => {
        if (signal.aborted) return;
        if (typeof data === "string") {
          about = JSON.parse(data);
          if (about.error) this.told(about);
        } else {
          this.show(new Blob([data], { type: "image/jpeg" }), about, signal);
        }
      };
    });
  }

  async show(blob, about, signal) {
    await showBlob(this.image, blob);
    if (signal.aborted) return;
    this.image.hidden = false;
    this.told({ ...about, bytes: blob.size });
  }
}
