/** A preview of the map (PLY of 3D Gaussians without harmonics) as coloured points. */

import { BufferAttribute, BufferGeometry, Points, PointsMaterial } from "three";

const CONSTANT = 0.28209479177387814; // the harmonic of degree 0
const SIZE_M = 0.02;

/** { object, dispose } of a preview's bytes. */
export function pointsOf(bytes) {
  const { columns, start, count } = header(bytes);
  const rows = new DataView(bytes, start);
  const stride = 4 * columns.length;
  const read = (i, name) => rows.getFloat32(i * stride + 4 * columns.indexOf(name), true);
  const positions = new Float32Array(3 * count);
  const colours = new Float32Array(3 * count);
  for (let i = 0; i < count; i += 1) {
    ["x", "y", "z"].forEach((name, axis) => { positions[3 * i + axis] = read(i, name); });
    for (let band = 0; band < 3; band += 1) {
      colours[3 * i + band] = linear(0.5 + CONSTANT * read(i, `f_dc_${band}`));
    }
  }
  const geometry = new BufferGeometry();
  geometry.setAttribute("position", new BufferAttribute(positions, 3));
  geometry.setAttribute("color", new BufferAttribute(colours, 3));
  const material = new PointsMaterial({ size: SIZE_M, vertexColors: true });
  const dispose = () => { geometry.dispose(); material.dispose(); };
  return { object: new Points(geometry, material), dispose };
}

function header(bytes) {
  const text = new TextDecoder().decode(bytes.slice(0, 4096));
  const end = text.indexOf("end_header\n");
  if (end < 0) throw new Error("The preview is no PLY file.");
  const columns = [...text.slice(0, end).matchAll(/property float (\w+)/g)].map((found) => found[1]);
  return { columns, start: end + "end_header\n".length, count: Number(/element vertex (\d+)/.exec(text)[1]) };
}

/** Colours come as a screen shows them; three.js computes with light. */
function linear(value) {
  return Math.max(0, Math.min(1, value)) ** 2.2;
}
