/**
 * Colour with depth where the browser has them: WebXR with raw camera access and depth sensing
 * (Chrome on Android with ARCore). Depth is of the view and comes smaller than colour; each pixel
 * of colour takes the nearest reading.
 */

import { turnedAxes } from "../viewer/poses.js";

const WIDTH_PX = 480;
const JPEG_QUALITY = 0.85;
const FEATURES = ["depth-sensing", "camera-access"];
const UNITS_PER_M = 1000;
const MAX_UNITS = 65534;

/** Why this browser gives no depth; "" where it does. */
export async function reasonAgainstDepth() {
  if (!isSecureContext) return "Browsers give depth to pages of this machine or over HTTPS only.";
  if (!navigator.xr) return "This browser has no WebXR.";
  const hasAr = await navigator.xr.isSessionSupported("immersive-ar").catch(() => false);
  return hasAr ? "" : "This device has no augmented reality, by which browsers give depth.";
}

export class XrCamera {
  /** Ask for camera and depth; throws an Error that says why there is none. `overlay` stays seen. */
  async start(overlay) {
    try {
      this.session = await navigator.xr.requestSession("immersive-ar", {
        requiredFeatures: FEATURES,
        optionalFeatures: ["dom-overlay"],
        domOverlay: { root: overlay },
        depthSensing: {
          usagePreference: ["cpu-optimized"],
          dataFormatPreference: ["luminance-alpha", "float32"],
        },
      });
    } catch (error) {
      const isRefused = error.name === "NotAllowedError";
      throw new Error(isRefused ? "Camera and depth were not allowed." : "This device gives no depth.");
    }
    this.session.addEventListener("end", () => { this.session = null; });
    this.gl = document.createElement("canvas").getContext("webgl2", { xrCompatible: true });
    this.binding = new XRWebGLBinding(this.session, this.gl);
    this.session.updateRenderState({ baseLayer: new XRWebGLLayer(this.session, this.gl) });
    this.space = await this.session.requestReferenceSpace("local");
  }

  stop() {
    this.session?.end();
    this.session = null;
  }

  /** The next image with depth: { jpeg, depth, intrinsics, t_ns, T_odom_camera }; null at the end. */
  async next() {
    while (this.session) {
      const seen = await this.nextSeen();
      if (seen) return { ...seen, jpeg: await jpegOf(seen.pixels) };
    }
    return null;
  }

  nextSeen() {
    return new Promise((done, fail) => {
      this.session.addEventListener("end", () => done(null), { once: true });
      this.session.requestAnimationFrame((time, frame) => {
        try { done(this.see(time, frame)); } catch (error) { fail(error); }
      });
    });
  }

  /** What is valid in its animation frame alone; null where camera or depth have not begun. */
  see(time, frame) {
    const view = frame.getViewerPose(this.space)?.views.find((candidate) => candidate.camera);
    const depth = view && frame.getDepthInformation(view);
    if (!depth) return null;
    const pixels = this.pixels(view.camera);
    const { position, orientation } = view.transform;
    const { x, y, z } = position;
    return {
      pixels,
      depth: depthOf(depth, pixels.width, pixels.height),
      intrinsics: pinhole(view.projectionMatrix, pixels.width, pixels.height),
      t_ns: BigInt(Math.round(time * 1e6)),
      T_odom_camera: { position: { x, y, z }, orientation: turnedAxes(orientation) },
    };
  }

  /** The camera's image, its first row at the top. */
  pixels(camera) {
    const { gl } = this;
    const width = Math.min(WIDTH_PX, camera.width);
    const height = Math.round((width * camera.height) / camera.width);
    const [source, target] = [gl.createFramebuffer(), gl.createFramebuffer()];
    const small = gl.createRenderbuffer();
    gl.bindRenderbuffer(gl.RENDERBUFFER, small);
    gl.renderbufferStorage(gl.RENDERBUFFER, gl.RGBA8, width, height);
    gl.bindFramebuffer(gl.READ_FRAMEBUFFER, source);
    const image = this.binding.getCameraImage(camera);
    gl.framebufferTexture2D(gl.READ_FRAMEBUFFER, gl.COLOR_ATTACHMENT0, gl.TEXTURE_2D, image, 0);
    gl.bindFramebuffer(gl.DRAW_FRAMEBUFFER, target);
    gl.framebufferRenderbuffer(gl.DRAW_FRAMEBUFFER, gl.COLOR_ATTACHMENT0, gl.RENDERBUFFER, small);
    // GL counts rows from below.
    gl.blitFramebuffer(0, 0, camera.width, camera.height, 0, height, width, 0, gl.COLOR_BUFFER_BIT, gl.LINEAR);
    gl.bindFramebuffer(gl.READ_FRAMEBUFFER, target);
    const data = new Uint8ClampedArray(4 * width * height);
    gl.readPixels(0, 0, width, height, gl.RGBA, gl.UNSIGNED_BYTE, data);
    gl.deleteRenderbuffer(small);
    for (const buffer of [source, target]) gl.deleteFramebuffer(buffer);
    return new ImageData(data, width, height);
  }
}

async function jpegOf(pixels) {
  const canvas = new OffscreenCanvas(pixels.width, pixels.height);
  canvas.getContext("2d").putImageData(pixels, 0, 0);
  const blob = await canvas.convertToBlob({ type: "image/jpeg", quality: JPEG_QUALITY });
  return new Uint8Array(await blob.arrayBuffer());
}

/** The pinhole of a GL projection matrix (column after column), pixels with centres at integers. */
export function pinhole(matrix, width, height) {
  return {
    fx: (matrix[0] * width) / 2,
    fy: (matrix[5] * height) / 2,
    cx: ((1 - matrix[8]) * width) / 2 - 0.5,
    cy: ((1 + matrix[9]) * height) / 2 - 0.5,
    width,
    height,
  };
}

/** Depth for every pixel of an image of the same view, uint16 millimetres, little endian. */
export function depthOf(depth, width, height) {
  const isFloat = depth.data.byteLength >= 4 * depth.width * depth.height;
  const raw = isFloat ? new Float32Array(depth.data) : new Uint16Array(depth.data);
  const m = depth.normDepthBufferFromNormView.matrix;
  const scale = depth.rawValueToMeters * UNITS_PER_M;
  const units = new Uint16Array(width * height);
  for (let row = 0; row < height; row += 1) {
    const v = (row + 0.5) / height;
    for (let column = 0; column < width; column += 1) {
      const u = (column + 0.5) / width;
      const x = Math.floor((m[0] * u + m[4] * v + m[12]) * depth.width);
      const y = Math.floor((m[1] * u + m[5] * v + m[13]) * depth.height);
      const isInside = x >= 0 && y >= 0 && x < depth.width && y < depth.height;
      const value = isInside ? raw[y * depth.width + x] * scale : 0;
      units[row * width + column] = value > 0 && value <= MAX_UNITS ? Math.round(value) : 0;
    }
  }
  return new Uint8Array(units.buffer);
}
