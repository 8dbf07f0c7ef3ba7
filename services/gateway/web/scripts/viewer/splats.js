/** The map drawn here: Gaussian splats by Spark, or points where graphics are weak. */

import { Group, Scene, WebGLRenderer } from "three";
import { pointsOf } from "./points.js";

const SETTLE_MS = 1500; // splats are sorted beside the drawing: frames go on for so long
const WEAK = /swiftshader|llvmpipe|software|basic render/i;

export class Splats {
  /** Throws where the browser has no WebGL 2. */
  constructor(canvas, camera) {
    this.renderer = new WebGLRenderer({ canvas, alpha: true, antialias: false });
    this.camera = camera;
    this.scene = new Scene();
    this.shown = new Group();
    this.scene.add(this.shown);
    this.bytes = null;
    this.until = 0;
    this.isHidden = false;
    this.asPoints = this.isWeak;
    this.frame = this.frame.bind(this);
  }

  get isWeak() {
    const gl = this.renderer.getContext();
    const names = gl.getExtension("WEBGL_debug_renderer_info");
    return WEAK.test(gl.getParameter(names ? names.UNMASKED_RENDERER_WEBGL : gl.RENDERER));
  }

  /** Show another file (PLY bytes); what was shown stays until it is ready. */
  async load(bytes) {
    this.bytes = bytes;
    await this.build();
  }

  async show({ asPoints }) {
    if (asPoints === this.asPoints) return;
    this.asPoints = asPoints;
    await this.build();
  }

  clear() {
    this.bytes = null;
    this.replace(null);
  }

  async build() {
    const { bytes, asPoints } = this;
    if (!bytes) return;
    const built = asPoints ? pointsOf(bytes) : await this.splatsOf(bytes);
    if (bytes === this.bytes && asPoints === this.asPoints) this.replace(built);
    else built.dispose();
  }

  async splatsOf(bytes) {
    const { SparkRenderer, SplatMesh } = await import("spark");
    if (!this.spark) {
      this.spark = new SparkRenderer({ renderer: this.renderer });
      this.scene.add(this.spark);
    }
    // Spark keeps what it is given.
    const mesh = new SplatMesh({ fileBytes: new Uint8Array(bytes.slice(0)), fileName: "map.ply" });
    await mesh.initialized;
    return { object: mesh, dispose: () => mesh.dispose() };
  }

  replace(built) {
    this.shown.clear();
    this.built?.dispose();
    this.built = built;
    if (built) this.shown.add(built.object);
    this.redraw();
  }

  resize(width, height) {
    this.renderer.setPixelRatio(this.isWeak ? 1 : Math.min(devicePixelRatio, 2));
    this.renderer.setSize(width, height, false);
    this.redraw();
  }

  /** Draw now and until the splats are sorted; nothing is drawn while nothing changes. */
  redraw() {
    const isAtRest = performance.now() > this.until;
    this.until = performance.now() + (this.asPoints ? 0 : SETTLE_MS);
    if (isAtRest && !this.isHidden) requestAnimationFrame(this.frame);
  }

  frame() {
    if (this.isHidden) return;
    this.renderer.render(this.scene, this.camera);
    if (performance.now() < this.until) requestAnimationFrame(this.frame);
  }
}
