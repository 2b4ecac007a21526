// Decodes one part of a scene's table. The last part has the powers, which the others need to undo their differences.

import { addDifferences, codingOrder, decodePart, powersOf } from "./decode.js";

let part = null;

function start({ code, count, group, shared, isLast }) {
  const began = performance.now();
  const order = codingOrder(count);
  const table = decodePart(code, order, group.length);
  const columns = (isPlain) => [...shared.keys()].filter((k) => shared[k] && (group[k] === 3) === isPlain);
  part = { table, order, group, differences: columns(false), ms: performance.now() - began };
  if (isLast) {
    addDifferences(table, order, columns(true), group, null);
    postMessage({ powers: powersOf(table, count) });
  }
}

function finish({ powers }) {
  const began = performance.now();
  addDifferences(part.table, part.order, part.differences, part.group, powers);
  const ms = part.ms + performance.now() - began;
  postMessage({ table: part.table, ms }, [part.table.buffer]);
  part = null;
}

addEventListener("message", ({ data }) => {
  try {
    if (data.code) start(data);
    else finish(data);
  } catch (error) {
    postMessage({ error: error.message });
  }
});
