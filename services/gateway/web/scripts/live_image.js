/** The newest image of the camera, one request at a time. */

import { request, sessionPath } from "./api.js";
import { byId, setText, showBlob } from "./dom.js";

export class LiveImage {
  constructor() {
    this.box = byId("live");
    this.image = byId("live-image");
  }

  open(name, signal) {
    this.path = sessionPath(name, "image");
    this.signal = signal;
    this.newest = -1;
    this.shown = -1;
    this.isAsking = false;
    this.box.dataset.state = "empty";
    setText(byId("live-note"), "No frame has come");
    setText(byId("live-facts"), "");
  }

  /** A frame was answered: fetch its image, or that of a newer one. */
  hearFrame(seq) {
    this.newest = seq;
    if (!this.isAsking && !document.hidden) this.catchUp(this.signal);
  }

  async catchUp(signal) {
    this.isAsking = true;
    try {
      while (this.shown < this.newest && !signal.aborted) {
        const asked = this.newest;
        const response = await request(this.path, { signal });
        this.shown = asked;
        // A session taken up from disk has a pose before it has an image.
        if (response.status === 204) continue;
        await showBlob(this.image, await response.blob());
        this.box.dataset.state = "shown";
        setText(byId("live-facts"), `frame ${asked}`);
      }
    } catch (error) {
      if (!signal.aborted) setText(byId("live-note"), error.message);
    } finally {
      if (signal === this.signal) this.isAsking = false;
    }
  }
}
