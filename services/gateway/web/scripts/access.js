/** Asks for an API key where the gateway wants one. */

import { Problem, forgetKey, hasKey, setKey } from "./api.js";
import { byId, setText } from "./dom.js";

/** Run `work`; where it is refused for want of a key, ask for one and run it again. */
export async function withAccess(work) {
  for (;;) {
    try {
      return await work();
    } catch (error) {
      if (!(error instanceof Problem) || (error.status !== 401 && error.status !== 403)) throw error;
      const wasRefused = hasKey();
      forgetKey();
      await askForKey(wasRefused ? error.message : "");
    }
  }
}

function askForKey(refusal) {
  const dialog = byId("key-dialog");
  const input = byId("key");
  setText(byId("key-error"), refusal);
  input.value = "";
  dialog.showModal();
  input.focus();
  return new Promise((done) => {
    dialog.addEventListener("cancel", (event) => event.preventDefault());
    dialog.addEventListener("close", () => { setKey(input.value.trim()); done(); }, { once: true });
  });
}
