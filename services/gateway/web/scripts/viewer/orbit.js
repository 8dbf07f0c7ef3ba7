/** The eye of the viewer, moved by pointer, touch and keys. */

import { PerspectiveCamera, Vector3 } from "three";
import { OrbitControls } from "three/addons/controls/OrbitControls.js";
import { add, axes, turnedAxes, upward, vector } from "./poses.js";

export const FIELD_OF_VIEW_DEG = 50;
const AHEAD_M = 2; // what the eye turns about lies so far before a camera
const STEP_RAD = 0.12;
const KEYS = { ArrowLeft: [1, 0], ArrowRight: [-1, 0], ArrowUp: [0, 1], ArrowDown: [0, -1] };

export class Orbit {
  /** `moved(isUser)` hears of every change of the eye; `settled()` when the hand lets go. */
  constructor(surface, { moved, settled }) {
    this.camera = new PerspectiveCamera(FIELD_OF_VIEW_DEG, 4 / 3, 0.02, 200);
    this.surface = surface;
    this.moved = moved;
    this.settled = settled;
    this.setUp([0, -1, 0]);
  }

  /** OrbitControls take the upward direction once, when they are made. */
  setUp(up) {
    if (this.controls && this.camera.up.distanceTo(new Vector3(...up)) < 1e-6) return;
    const target = this.controls?.target.clone();
    this.controls?.dispose();
    this.camera.up.set(...up);
    this.controls = new OrbitControls(this.camera, this.surface);
    this.controls.zoomToCursor = true;
    if (target) this.controls.target.copy(target);
    this.controls.addEventListener("change", () => this.moved(this.isDragged));
    this.controls.addEventListener("start", () => { this.isDragged = true; });
    this.controls.addEventListener("end", () => { this.isDragged = false; this.settled(); });
    this.isDragged = false;
  }

  uprightFor(poses) {
    this.setUp(upward(poses));
  }

  /** The eye as T_map_camera, { position, orientation }. */
  get pose() {
    const { position, quaternion } = this.camera;
    const { x, y, z, w } = quaternion;
    return {
      position: { x: position.x, y: position.y, z: position.z },
      orientation: turnedAxes({ x, y, z, w }),
    };
  }

  /** Look through a camera; a roll is kept until somebody orbits. */
  lookThrough({ position, orientation }) {
    const { x, y, z, w } = turnedAxes(orientation);
    this.camera.position.set(...vector(position));
    this.camera.quaternion.set(x, y, z, w);
    const ahead = add(vector(position), axes(orientation).forward, AHEAD_M);
    this.controls.target.set(...ahead);
    this.camera.updateMatrixWorld();
    this.moved(false);
  }

  /** From behind and above a camera, so that it and its path are seen. */
  stepBack({ position, orientation }) {
    const { forward } = axes(orientation);
    const up = this.camera.up.toArray();
    const back = add(add(vector(position), forward, -1.1), up, 0.7);
    this.camera.position.set(...back);
    this.controls.target.set(...add(vector(position), forward, 0.8));
    this.controls.update();
    this.moved(false);
  }

  /** Arrow keys turn, plus and minus go near and far. Returns whether the key was one of them. */
  key(name) {
    const turn = KEYS[name];
    const factor = { "+": 0.87, "=": 0.87, "-": 1.15 }[name];
    if (!turn && !factor) return false;
    const offset = this.camera.position.clone().sub(this.controls.target);
    if (factor) offset.multiplyScalar(factor);
    if (turn) {
      const side = new Vector3().crossVectors(this.camera.up, offset).normalize();
      offset.applyAxisAngle(this.camera.up, turn[0] * STEP_RAD).applyAxisAngle(side, -turn[1] * STEP_RAD);
    }
    this.camera.position.copy(this.controls.target).add(offset);
    this.controls.update();
    this.moved(true);
    this.settled();
    return true;
  }

  resize(width, height) {
    this.camera.aspect = width / height;
    this.camera.updateProjectionMatrix();
  }
}
