// Where the texts of measurements go: within the picture, and none over another or over a point. No elements.

const BETWEEN_PX = 2;

/** @typedef {{x: number, y: number, width: number, height: number}} Box */

/**
 * How to move each text: first into the picture, then up or down by whole lines, to the nearest free place.
 * @param {Box[]} boxes of the texts
 * @param {{left: number, top: number, right: number, bottom: number}} picture
 * @param {Box[]} [points] that stay free, where there is space
 * @returns {[number, number][]} right and down, px
 */
export function spread(boxes, picture, points = []) {
  /** @type {Box[]} */
  const taken = [];
  return boxes.map((box) => {
    const x = within(box.x, picture.left, picture.right - box.width);
    const line = box.height + BETWEEN_PX;
    const lines = Array.from({ length: 2 * (taken.length + points.length) + 1 }, (_, i) => Math.ceil(i / 2) * (i % 2 ? -1 : 1));
    const places = lines.map((each) => {
      const y = within(box.y + each * line, picture.top, picture.bottom - box.height);
      return { x, y, width: box.width, height: box.height };
    });
    const isFree = (each, others) => !others.some((other) => isOver(each, other));
    const free = places.filter((each) => isFree(each, taken));
    const place = free.find((each) => isFree(each, points)) ?? free[0] ?? places[0];
    taken.push(place);
    return [place.x - box.x, place.y - box.y];
  });
}

const within = (value, low, high) => Math.max(low, Math.min(value, high));

const isOver = (a, b) =>
  a.x < b.x + b.width + BETWEEN_PX && b.x < a.x + a.width + BETWEEN_PX && a.y < b.y + b.height && b.y < a.y + a.height;
