/** Small tools for the page: elements, groups of choices, images from bytes. */

export const byId = (id) => document.getElementById(id);

/** A new element with attributes and children (text or elements). */
export function make(tag, attributes = {}, ...children) {
  const element = document.createElement(tag);
  for (const [name, value] of Object.entries(attributes)) {
    if (value !== undefined && value !== null) element.setAttribute(name, value);
  }
  element.append(...children.filter((child) => child !== null && child !== undefined));
  return element;
}

/** Change text only where it differs, so that readers are not told again. */
export function setText(element, text) {
  if (element.textContent !== text) element.textContent = text;
}

/** A row of choices of which one is taken: click or arrow keys. Returns { value, choose }. */
export function choices(group, initial, chosen) {
  const buttons = [...group.querySelectorAll("button")];
  const state = { value: initial };
  const show = () => {
    for (const button of buttons) {
      const isTaken = button.dataset.value === state.value;
      button.setAttribute("aria-checked", String(isTaken));
      button.tabIndex = isTaken ? 0 : -1;
    }
  };
  const choose = (value) => {
    if (buttons.find((button) => button.dataset.value === value)?.disabled) return;
    state.value = value;
    show();
    chosen(value);
  };
  for (const button of buttons) button.addEventListener("click", () => choose(button.dataset.value));
  group.addEventListener("keydown", (event) => {
    const step = { ArrowRight: 1, ArrowLeft: -1 }[event.key];
    if (!step) return;
    event.preventDefault();
    const at = buttons.findIndex((button) => button.dataset.value === state.value);
    const next = buttons[(at + step + buttons.length) % buttons.length];
    choose(next.dataset.value);
    next.focus();
  });
  show();
  return { get value() { return state.value; }, choose };
}

/** A button that stays pressed. Returns { isOn, set }. */
export function toggle(button, changed) {
  const set = (isOn) => {
    if (button.getAttribute("aria-pressed") === String(isOn)) return;
    button.setAttribute("aria-pressed", String(isOn));
    changed(isOn);
  };
  button.addEventListener("click", () => set(button.getAttribute("aria-pressed") !== "true"));
  return { get isOn() { return button.getAttribute("aria-pressed") === "true"; }, set };
}

/** Show a blob in an <img> and let go of the one before; resolves when it is shown. */
export async function showBlob(image, blob) {
  const url = URL.createObjectURL(blob);
  const before = image.src;
  image.src = url;
  try {
    await image.decode();
  } catch {
    return; // a newer one has taken its place
  } finally {
    if (before.startsWith("blob:")) URL.revokeObjectURL(before);
  }
}
