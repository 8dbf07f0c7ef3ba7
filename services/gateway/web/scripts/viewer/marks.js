/** The path, the keyframes and the live camera, drawn over the views as lines. */

import { add, axes, dot, norm, vector } from "./poses.js";

const NEAR_M = 0.05;
const CLEAR_M = 0.3; // what is nearer to the eye would fill the view
const FRUSTUM_M = 0.12;

export class Marks {
  constructor(canvas) {
    this.canvas = canvas;
    this.context = canvas.getContext("2d");
    this.clear();
  }

  clear() {
    this.runs = [];
    this.keyframes = [];
    this.live = null;
  }

  /** Add where the camera is now to its path. */
  addPose(pose) {
    this.live = pose;
    if (this.runs.length === 0) this.runs.push([]);
    const run = this.runs.at(-1);
    const here = vector(pose.position);
    if (run.length === 0 || norm(add(here, run.at(-1), -1)) > 0.005) run.push(here);
  }

  /** The camera was lost: its path goes on elsewhere. */
  breakPath() {
    if (this.runs.at(-1)?.length) this.runs.push([]);
  }

  /** Draw for an eye { position, orientation } with a vertical field of view in radians. */
  draw(eye, fieldOfView) {
    const { canvas, context } = this;
    const ratio = Math.min(devicePixelRatio, 2);
    const [width, height] = [canvas.clientWidth, canvas.clientHeight];
    if (canvas.width !== Math.round(width * ratio) || canvas.height !== Math.round(height * ratio)) {
      canvas.width = Math.round(width * ratio);
      canvas.height = Math.round(height * ratio);
    }
    context.setTransform(ratio, 0, 0, ratio, 0, 0);
    context.clearRect(0, 0, width, height);
    if (!eye) return;
    this.projection = { eye: vector(eye.position), ...axes(eye.orientation), width, height,
      focal: height / 2 / Math.tan(fieldOfView / 2) };
    const accent = getComputedStyle(canvas).getPropertyValue("--accent");
    context.lineJoin = "round";
    this.stroke("rgb(255 255 255 / 0.45)", 1, () => this.keyframes.forEach((pose) => this.frustum(pose, FRUSTUM_M)));
    this.stroke("rgb(0 0 0 / 0.35)", 4, () => this.runs.forEach((run) => this.polyline(run)));
    this.stroke(accent, 2, () => this.runs.forEach((run) => this.polyline(run)));
    if (this.live) this.stroke(accent, 2.5, () => this.frustum(this.live, 1.6 * FRUSTUM_M));
  }

  stroke(colour, width, trace) {
    this.context.strokeStyle = colour;
    this.context.lineWidth = width;
    this.context.beginPath();
    trace();
    this.context.stroke();
  }

  polyline(points) {
    for (let i = 1; i < points.length; i += 1) this.segment(points[i - 1], points[i]);
  }

  frustum({ position, orientation }, size) {
    const { right, down, forward } = axes(orientation);
    const tip = vector(position);
    const corners = [[-1, -1], [1, -1], [1, 1], [-1, 1]].map(([x, y]) =>
      add(add(add(tip, forward, size), right, 0.6 * x * size), down, 0.45 * y * size));
    corners.forEach((corner, i) => {
      this.segment(tip, corner);
      this.segment(corner, corners[(i + 1) % 4]);
    });
  }

  segment(a, b) {
    const { eye } = this.projection;
    if (Math.min(norm(add(a, eye, -1)), norm(add(b, eye, -1))) < CLEAR_M) return;
    let [from, to] = [this.seen(a), this.seen(b)];
    if (from[2] < NEAR_M && to[2] < NEAR_M) return;
    if (from[2] < NEAR_M) from = cut(from, to);
    if (to[2] < NEAR_M) to = cut(to, from);
    this.context.moveTo(...this.pixel(from));
    this.context.lineTo(...this.pixel(to));
  }

  /** A point of the map in the eye's frame. */
  seen(point) {
    const { eye, right, down, forward } = this.projection;
    const ray = add(point, eye, -1);
    return [dot(ray, right), dot(ray, down), dot(ray, forward)];
  }

  pixel([x, y, z]) {
    const { focal, width, height } = this.projection;
    return [width / 2 + (focal * x) / z, height / 2 + (focal * y) / z];
  }
}

/** Where a segment from a point behind the eye comes before it. */
function cut(behind, ahead) {
  const share = (NEAR_M - behind[2]) / (ahead[2] - behind[2]);
  return add(behind, add(ahead, behind, -1), share);
}
