/**
 * Cameras as the API spells them, T_map_camera with OpenCV axes (x right, y down, z forward), and
 * as three.js has them (x right, y up, z backward): half a turn about x between the two.
 */

/** A camera's orientation in the other convention, { x, y, z, w }; the same step both ways. */
export const turnedAxes = ({ x, y, z, w }) => ({ x: w, y: z, z: -y, w: -x });

/** Columns of the rotation: the camera's right, down and forward in the map, each [x, y, z]. */
export function axes({ x, y, z, w }) {
  return {
    right: [1 - 2 * (y * y + z * z), 2 * (x * y + z * w), 2 * (x * z - y * w)],
    down: [2 * (x * y - z * w), 1 - 2 * (x * x + z * z), 2 * (y * z + x * w)],
    forward: [2 * (x * z + y * w), 2 * (y * z - x * w), 1 - 2 * (x * x + y * y)],
  };
}

export const vector = ({ x, y, z }) => [x, y, z];
export const add = (a, b, factor = 1) => a.map((value, i) => value + factor * b[i]);
export const dot = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
export const norm = (a) => Math.hypot(...a);

const SNAP = Math.cos((25 * Math.PI) / 180);

/**
 * Which way is up in the map, [x, y, z]: people hold cameras upright on the mean. An axis of the
 * map that is near is taken instead.
 */
export function upward(poses) {
  const mean = poses.reduce((sum, pose) => add(sum, axes(pose.orientation).down, -1), [0, 0, 0]);
  const size = norm(mean);
  if (size === 0) return [0, -1, 0];
  const up = mean.map((value) => value / size);
  const at = up.findIndex((value) => Math.abs(value) > SNAP);
  return at < 0 ? up : up.map((value, i) => (i === at ? Math.sign(value) : 0));
}
