/* A device with camera and depth, as far as the capture page asks WebXR for them. */
(() => {
  const SIZE = { width: 64, height: 48 };
  const RED_OVER_BLUE = new Uint8Array(4 * 64 * 48);
  for (let i = 0; i < RED_OVER_BLUE.length; i += 4) {
    const isUpper = i >= RED_OVER_BLUE.length / 2; // GL counts rows from below
    RED_OVER_BLUE.set(isUpper ? [220, 0, 0, 255] : [0, 0, 220, 255], i);
  }
  let shown = 0;
  const view = () => ({
    camera: SIZE,
    projectionMatrix: [2, 0, 0, 0, 0, 2.5, 0, 0, 0, 0, -1, -1, 0, 0, -0.1, 0],
    transform: { position: { x: 0.01 * shown, y: 0, z: 0 }, orientation: { x: 0, y: 0, z: 0, w: 1 } },
  });
  const depth = {
    width: 16, height: 12, rawValueToMeters: 0.001,
    data: new Uint16Array(16 * 12).map((_, i) => 1000 + (i % 16)).buffer,
    normDepthBufferFromNormView: { matrix: [1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1] },
  };
  class Session extends EventTarget {
    updateRenderState() {}
    async requestReferenceSpace() { return {}; }
    requestAnimationFrame(draw) {
      setTimeout(() => {
        shown += 1;
        draw(performance.now(), {
          getViewerPose: () => ({ views: [view()] }),
          getDepthInformation: () => depth,
        });
      }, 20);
    }
    async end() { this.dispatchEvent(new Event("end")); }
  }
  window.XRWebGLLayer = class {};
  window.XRWebGLBinding = class {
    constructor(session, gl) { this.gl = gl; }
    getCameraImage() {
      const { gl } = this;
      gl.bindTexture(gl.TEXTURE_2D, gl.createTexture());
      const texture = gl.getParameter(gl.TEXTURE_BINDING_2D);
      gl.texImage2D(gl.TEXTURE_2D, 0, gl.RGBA, 64, 48, 0, gl.RGBA, gl.UNSIGNED_BYTE, RED_OVER_BLUE);
      return texture;
    }
  };
  const xr = { isSessionSupported: async () => true, requestSession: async () => new Session() };
  Object.defineProperty(navigator, "xr", { value: xr, configurable: true });
})();
