/** The console: the list of sessions, and the one that the address names. */

import { withAccess } from "./access.js";
import { getJson } from "./api.js";
import { byId, setText } from "./dom.js";
import { plural } from "./text.js";
import { SessionList } from "./session_list.js";
import { SessionPage } from "./session_page.js";

const LIST_EVERY_MS = 2000;

const list = new SessionList(byId("session-list"));
const page = new SessionPage();

const nameInAddress = () => decodeURIComponent(location.hash.slice(1));

function route(sessions) {
  const named = nameInAddress();
  const name = named || (sessions.find((row) => row.is_open) ?? sessions[0])?.session || "";
  const isKnown = sessions.some((row) => row.session === name);
  list.mark(name);
  if (isKnown) page.open(name);
  else page.close();
  welcome(!isKnown, named && sessions.length > 0 ? named : "");
}

function welcome(isShown, missing) {
  byId("welcome").hidden = !isShown;
  setText(byId("welcome-title"), missing ? `There is no session ${missing}` : "No session yet");
  setText(byId("welcome-command").firstElementChild, `pointslam run SEQUENCE --out DIR --gateway ${location.origin}`);
}

function showGateway(text, tone) {
  const chip = byId("gateway-state");
  setText(chip, text);
  chip.dataset.tone = tone;
}

async function refresh() {
  try {
    const { sessions } = await withAccess(() => getJson("/v1/sessions"));
    list.show(sessions);
    route(sessions);
    const { trackers, mappers } = await getJson("/readyz");
    showGateway(`${plural(trackers, "tracker")}, ${plural(mappers, "mapper")}`, "good");
  } catch (error) {
    list.fail(error.message);
    showGateway(error.status === 0 ? "no connection" : "not ready", "bad");
  }
  document.body.dataset.ready = "true";
}

async function keepRefreshing() {
  for (;;) {
    if (!document.hidden) await refresh();
    await new Promise((resume) => setTimeout(resume, LIST_EVERY_MS));
  }
}

addEventListener("hashchange", () => { if (list.rows) route(list.rows); });
keepRefreshing();
