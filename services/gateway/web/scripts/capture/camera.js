/** The device's camera: a picture as JPEG, and the pinhole that its field of view says. */

const WIDTH_PX = 640;
const JPEG_QUALITY = 0.85;

export class Camera {
  constructor(video) {
    this.video = video;
    this.canvas = document.createElement("canvas");
  }

  /** Ask for the camera; throws an Error that says why there is none. */
  async start() {
    if (!navigator.mediaDevices) {
      throw new Error("Browsers give the camera to pages of this machine or over HTTPS only.");
    }
    try {
      this.stream = await navigator.mediaDevices.getUserMedia({
        audio: false,
        video: { facingMode: "environment", width: { ideal: WIDTH_PX } },
      });
    } catch (error) {
      const isRefused = error.name === "NotAllowedError";
      throw new Error(isRefused ? "The camera was not allowed." : "There is no camera on this device.");
    }
    this.video.srcObject = this.stream;
    await this.video.play();
  }

  stop() {
    for (const track of this.stream?.getTracks() ?? []) track.stop();
    this.video.srcObject = null;
  }

  /** What it sees now: { jpeg, intrinsics } for a horizontal field of view in degrees. */
  async picture(fieldOfViewDeg) {
    const { videoWidth, videoHeight } = this.video;
    const width = Math.min(WIDTH_PX, videoWidth);
    const height = Math.round((width * videoHeight) / videoWidth);
    this.canvas.width = width;
    this.canvas.height = height;
    this.canvas.getContext("2d").drawImage(this.video, 0, 0, width, height);
    const blob = await new Promise((done) => this.canvas.toBlob(done, "image/jpeg", JPEG_QUALITY));
    const focal = width / 2 / Math.tan((fieldOfViewDeg * Math.PI) / 360);
    return {
      jpeg: new Uint8Array(await blob.arrayBuffer()),
      intrinsics: { fx: focal, fy: focal, cx: (width - 1) / 2, cy: (height - 1) / 2, width, height },
    };
  }
}
