/** A new map of what a camera with depth sees: one frame at a time, the newest there is. */

import { Problem, postJson, request, sessionPath } from "../api.js";
import { pack } from "./msgpack.js";

const DEPTH_SCALE = 1000; // units of depth per metre
const PASSING = [0, 429, 503]; // the next frame may find the gateway well again
const PAUSE_MS = 500;
const MAX_DEPTH_M = 8; // what phones measure farther away is a guess

export class Mapping {
  constructor(camera) {
    this.camera = camera;
    this.seq = 0;
  }

  /** Begin a session and send frames until the camera ends; `told(reply, name, jpeg)` hears of each. */
  async run(told) {
    for (let seen = await this.camera.next(); seen; seen = await this.camera.next()) {
      if (!this.name) await this.begin(seen.intrinsics);
      const reply = await this.tried(seen);
      if (reply) told(reply, this.name, seen.jpeg);
    }
  }

  async tried(seen) {
    try {
      return await this.send(seen);
    } catch (error) {
      if (!(error instanceof Problem) || !PASSING.includes(error.status)) throw error;
      await new Promise((resume) => setTimeout(resume, PAUSE_MS));
      return null;
    }
  }

  async begin(intrinsics) {
    const calibration = { colour: { intrinsics }, depth_scale: DEPTH_SCALE, max_depth_m: MAX_DEPTH_M };
    const name = `capture-${new Date().toISOString().slice(0, 19).replaceAll(":", "-")}`;
    this.name = (await postJson("/v1/sessions", { calibration, name, mode: "live" })).session;
  }

  async send({ jpeg, depth, t_ns, T_odom_camera }) {
    const message = {
      seq: this.seq,
      t_ns,
      rgb: { encoding: "jpeg", bytes: jpeg },
      depth: { encoding: "raw16", bytes: depth },
      prior: { T_odom_camera },
    };
    this.seq += 1;
    const response = await request(sessionPath(this.name, "frames"), {
      method: "POST",
      body: pack(message),
      headers: { "Content-Type": "application/msgpack", Accept: "application/json" },
    });
    return response.json();
  }
}
