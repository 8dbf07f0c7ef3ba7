/** The divider between the two views of the stage. */

export class Split {
  constructor(stage, divider) {
    this.stage = stage;
    this.divider = divider;
    divider.addEventListener("pointerdown", (event) => {
      divider.setPointerCapture(event.pointerId);
      divider.onpointermove = (move) => this.moveTo(move.clientX);
    });
    divider.addEventListener("pointerup", () => { divider.onpointermove = null; });
  }

  show(isShown) {
    this.divider.hidden = !isShown;
  }

  moveTo(x) {
    const { left, width } = this.stage.getBoundingClientRect();
    const share = Math.min(0.97, Math.max(0.03, (x - left) / width));
    this.stage.style.setProperty("--split", `${100 * share}%`);
  }
}
