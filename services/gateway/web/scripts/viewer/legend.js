/** What the colours of a layer stand for. */

import { setText } from "../dom.js";

export class Legend {
  constructor(element) {
    this.element = element;
    [this.low, this.bar, this.high] = element.children;
  }

  show(layer, range) {
    this.element.hidden = layer === "colour";
    this.bar.dataset.layer = layer;
    const [low, high] = layer === "confidence" ? ["unknown", "well known"] : range ?? ["", ""];
    setText(this.low, low);
    setText(this.high, high);
  }

  hide() {
    this.element.hidden = true;
  }
}
