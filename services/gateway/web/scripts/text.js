/** Numbers and states as people read them. */

export const DASH = "–";

export function length(metres) {
  if (metres === null || metres === undefined) return DASH;
  if (metres < 0.01) return `${(1000 * metres).toFixed(1)} mm`;
  if (metres < 1) return `${(100 * metres).toFixed(1)} cm`;
  return `${metres.toFixed(2)} m`;
}

export const fixed = (number, digits = 0) =>
  number === null || number === undefined ? DASH : number.toFixed(digits);

export const percent = (share) =>
  share === null || share === undefined ? DASH : `${Math.round(100 * share)} %`;

export function bytes(number) {
  const units = ["B", "kB", "MB", "GB"];
  let at = 0;
  for (; number >= 1000 && at < units.length - 1; at += 1) number /= 1000;
  return `${number < 10 && at ? number.toFixed(1) : Math.round(number)} ${units[at]}`;
}

export const count = (number) =>
  number === null || number === undefined ? DASH : number.toLocaleString("en");

export const plural = (number, noun) => `${number} ${noun}${number === 1 ? "" : "s"}`;

export const clock = (seconds) =>
  new Date(1000 * seconds).toLocaleTimeString([], { hour: "2-digit", minute: "2-digit", second: "2-digit" });

/** What a session's tracking amounts to: { word, tone, level }, level 0 to 4 of its quality. */
export function trackingState(tracking) {
  if (!tracking || !tracking.status) return { word: "at rest", tone: "", level: 0 };
  const isMoving = tracking.frame_rate_hz > 0;
  const level = Math.max(1, Math.min(4, Math.ceil(4 * (tracking.inlier_share ?? 0))));
  if (tracking.status === "LOST") return { word: isMoving ? "lost" : "was lost", tone: "bad", level: 0 };
  if (!isMoving) return { word: "no frames now", tone: "", level };
  if (tracking.status === "COARSE_ONLY") return { word: "coarse", tone: "warn", level };
  if (tracking.status === "NEED_FRAMES") return { word: "starting", tone: "warn", level };
  return { word: tracking.status === "RELOCALISED" ? "found again" : "tracking", tone: "good", level };
}
