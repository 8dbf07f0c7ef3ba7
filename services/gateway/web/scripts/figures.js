/** The numbers beside the camera's image. */

import { make, setText } from "./dom.js";
import { count, fixed, length, percent } from "./text.js";

const ROWS = [
  ["Frame rate", "fps", (t) => fixed(t?.frame_rate_hz, 1)],
  ["Answer", "ms", (t) => fixed(t?.answer_ms)],
  ["Inliers", "", (t) => percent(t?.inlier_share)],
  ["Position, 1 σ", "", (t) => length(t?.pos_std_m)],
  ["Map PSNR", "dB", (_, info) => fixed(info?.psnr_db, 1)],
  ["Anchors", "", (_, info) => info ? count(info.primary_anchors + info.secondary_anchors) : "–"],
  ["Iterations", "", (_, info) => count(info?.iterations)],
  ["Loops closed", "", (_, info) => count(info?.loops)],
];

export function showFigures(list, tracking, info) {
  if (!list.children.length) {
    list.append(...ROWS.map(([name]) => make("div", {}, make("dt", {}, name), make("dd", {}, make("span"), make("small")))));
  }
  ROWS.forEach(([, unit, read], i) => {
    const [value, small] = list.children[i].querySelector("dd").children;
    setText(value, read(tracking, info));
    setText(small, value.textContent === "–" ? "" : unit);
  });
}
