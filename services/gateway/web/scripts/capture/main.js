/** This device's camera: found again and again in a map that exists, or with depth into a new one. */

import { withAccess } from "../access.js";
import { getJson, request, sessionPath } from "../api.js";
import { byId, make, setText, showBlob } from "../dom.js";
import { DASH, fixed, length, percent } from "../text.js";
import { Camera } from "./camera.js";
import { Mapping } from "./mapping.js";
import { pack } from "./msgpack.js";
import { XrCamera, reasonAgainstDepth } from "./xr_camera.js";

const PAUSE_MS = 300;
const NEW_MAP = ""; // the choice of no map that exists
const WHAT_WOULD_DO = "Maps grow from colour with depth: open this page in Chrome on an Android phone with ARCore, "
  + "or stream a depth camera with `pointslam client realsense` or `record3d`.";
const TONES = { LOCALISED: "good", COLOUR_ONLY: "good", NOT_LOCALISED: "warn", TRACKED: "good", LOST: "bad" };
const WORDS = {
  LOCALISED: "found", COLOUR_ONLY: "found by colour alone", NOT_LOCALISED: "not found",
  TRACKED: "mapping", COARSE_ONLY: "mapping, weakly", RELOCALISED: "mapping, found again", LOST: "lost: go back",
};

const camera = new Camera(byId("video"));
let depthCamera = null;
let isOn = false;

function tell(text, tone = "") {
  setText(byId("state"), text);
  byId("state").dataset.tone = tone;
}

async function listMaps() {
  const { sessions } = await withAccess(() => getJson("/v1/sessions"));
  const maps = sessions.filter((row) => row.keyframes > 0);
  const reason = await reasonAgainstDepth();
  const choices = maps.map((row) =>
    make("option", { value: row.session }, `${row.session} (${row.keyframes} keyframes)`));
  if (!reason) choices.unshift(make("option", { value: NEW_MAP }, "a new map"));
  byId("map").replaceChildren(...choices);
  byId("start").disabled = choices.length === 0;
  const none = `Depth is needed to make a map, and there is none yet to find this camera in. ${reason} ${WHAT_WOULD_DO}`;
  setText(byId("note"), choices.length ? reason && `No new map from here: ${reason} ${WHAT_WOULD_DO}` : none);
}

async function toggle() {
  if (isOn) { stop(); return; }
  if (byId("map").value === NEW_MAP) await makeMap();
  else await findCamera();
}

/** With depth: a session of its own, which the console shows too. */
async function makeMap() {
  depthCamera = new XrCamera();
  try {
    await depthCamera.start(document.querySelector("main"));
    turnOn("beginning");
    await new Mapping(depthCamera).run((reply, name, jpeg) => {
      show(reply);
      showBlob(byId("seen"), new Blob([jpeg]));
      byId("picture").dataset.state = "shown";
      byId("session-link").hidden = false;
      byId("session-link").href = `/#${encodeURIComponent(name)}`;
    });
  } catch (error) {
    setText(byId("note"), error.message);
  }
  stop();
}

async function findCamera() {
  try {
    await camera.start();
  } catch (error) {
    tell("no camera", "bad");
    setText(byId("picture-note"), error.message);
    return;
  }
  byId("picture").dataset.state = "shown";
  turnOn("looking");
  await keepLooking();
}

function turnOn(state) {
  isOn = true;
  setText(byId("start"), "Stop");
  byId("map").disabled = true;
  tell(state);
}

function stop() {
  isOn = false;
  camera.stop();
  depthCamera?.stop();
  byId("map").disabled = false;
  setText(byId("start"), "Start");
  byId("picture").dataset.state = "empty";
  tell("camera is off");
}

/** One picture at a time: the next is taken when the one before is answered. */
async function keepLooking() {
  while (isOn) {
    try {
      if (!document.hidden) show(await localize());
      setText(byId("note"), "");
    } catch (error) {
      setText(byId("note"), error.message);
    }
    await new Promise((resume) => setTimeout(resume, PAUSE_MS));
  }
}

async function localize() {
  const { jpeg, intrinsics } = await camera.picture(byId("field-of-view").valueAsNumber);
  const message = { rgb: { encoding: "jpeg", bytes: jpeg }, camera: { intrinsics } };
  const response = await request(sessionPath(byId("map").value, "localize"), {
    method: "POST",
    body: pack(message),
    headers: { "Content-Type": "application/msgpack", Accept: "application/json" },
  });
  return response.json();
}

function show(answer) {
  if (!isOn) return;
  tell(WORDS[answer.status] ?? answer.status.toLowerCase(), TONES[answer.status] ?? "warn");
  const at = answer.T_map_camera?.position;
  const rows = [
    ["Position", at ? `${fixed(at.x, 2)}, ${fixed(at.y, 2)}, ${fixed(at.z, 2)} m` : DASH],
    ["Position, 1 σ", length(answer.pos_std_m)],
    ["Inliers", at ? `${answer.inliers} (${percent(answer.inlier_share)})` : DASH],
    ["Answer", `${fixed(answer.timings_ms?.gateway)} ms`],
    ["Why not", answer.reason || DASH],
  ];
  byId("answer").dataset.status = answer.status;
  byId("answer").replaceChildren(...rows.map(([name, value]) =>
    make("div", {}, make("dt", {}, name), make("dd", {}, value))));
}

byId("start").addEventListener("click", toggle);
listMaps().catch((error) => { tell("not ready", "bad"); setText(byId("note"), error.message); })
  .finally(() => { document.body.dataset.ready = "true"; });
