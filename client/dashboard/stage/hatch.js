// Masked parts of a recorded frame as a hatch.

/** The hatch of what nobody saw (intrasplat/view/unseen.py). */
const GREYS = ["rgb(40 40 40)", "rgb(74 74 74)"];
const STRIPES_A_PICTURE = 96;

export class Hatch {
  constructor() {
    this.canvas = document.createElement("canvas");
    this.stripes = null;
  }

  /** @param {ImageBitmap} mask opaque where the hatch is to be @returns {HTMLCanvasElement} */
  over(mask) {
    const { canvas } = this;
    if (canvas.width !== mask.width || canvas.height !== mask.height) {
      Object.assign(canvas, { width: mask.width, height: mask.height });
      this.stripes = null;
    }
    const context = canvas.getContext("2d");
    this.stripes ??= stripesOn(context, Math.max(2, Math.round(mask.width / STRIPES_A_PICTURE)));
    context.globalCompositeOperation = "copy";
    context.drawImage(mask, 0, 0);
    context.globalCompositeOperation = "source-in";
    context.fillStyle = this.stripes;
    context.fillRect(0, 0, mask.width, mask.height);
    return canvas;
  }
}

/** Diagonal stripes, px wide along a row. @param {CanvasRenderingContext2D} context @param {number} px */
function stripesOn(context, px) {
  const tile = document.createElement("canvas");
  tile.width = tile.height = 2 * px;
  const drawing = tile.getContext("2d");
  for (let y = 0; y < 2 * px; y++) {
    for (let x = 0; x < 2 * px; x++) {
      drawing.fillStyle = GREYS[Math.floor((x + y) / px) % 2];
      drawing.fillRect(x, y, 1, 1);
    }
  }
  return context.createPattern(tile, "repeat");
}
