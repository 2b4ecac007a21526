// What the overlay shows of measurements, drawn into a picture that is saved.

import { placeInPicture } from "./pointer.js";

const TO_PATH = {
  polyline: (shape) => `M${shape.getAttribute("points").replaceAll(" ", "L")}`,
  polygon: (shape) => `${TO_PATH.polyline(shape)}Z`,
  path: (shape) => shape.getAttribute("d"),
};

/**
 * Draw lines, points and texts as they are on the screen; not the cross of the keys.
 * @param {CanvasRenderingContext2D} context
 * @param {{svg: SVGSVGElement, canvas: HTMLElement, camera: import("../stage/stream.js").Camera}} shown
 * @param {{left: number, width: number}} place of the picture in the context, px
 */
export function burnMeasurements(context, { svg, canvas, camera }, { left, width }) {
  const corner = svg.getBoundingClientRect();
  const { u, v, scale } = placeInPicture(canvas, camera, corner.left, corner.top);
  const pxOfPicture = width / camera.width;
  const px = pxOfPicture / scale;
  context.save();
  context.beginPath();
  context.rect(left, 0, width, pxOfPicture * camera.height);
  context.clip();
  context.setTransform(px, 0, 0, px, left + pxOfPicture * u, pxOfPicture * v);
  for (const each of svg.querySelectorAll(":scope > :not([data-mark=cross])")) {
    const style = getComputedStyle(each);
    Object.assign(context, { strokeStyle: style.stroke, lineWidth: parseFloat(style.strokeWidth), fillStyle: style.fill });
    if (each.tagName === "text") write(context, each, style);
    else trace(context, new Path2D(TO_PATH[each.tagName](each)), style);
  }
  context.restore();
}

function trace(context, path, style) {
  if (style.fill !== "none") {
    context.globalAlpha = Number(style.fillOpacity);
    context.fill(path);
    context.globalAlpha = 1;
  }
  context.stroke(path);
}

function write(context, text, style) {
  Object.assign(context, { font: `${style.fontSize} ${style.fontFamily}`, textAlign: "center", lineJoin: "round" });
  const [x, y] = ["x", "y"].map((name) => Number(text.getAttribute(name)));
  context.strokeText(text.textContent, x, y);
  context.fillText(text.textContent, x, y);
}
