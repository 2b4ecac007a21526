// The live screen's address: #/ID?at= names a feed, and the moment at which its model is frozen.

const PLACE = /^#\/([0-9a-f]{32})(?:\?at=([^&]+))?$/;

/** @param {string} hash @returns {{id: string | null, atS: number | null}} atS: UNIX time; null: it is live */
export function placeOf(hash) {
  const [, id = null, at = ""] = PLACE.exec(hash) ?? [];
  const atMs = Date.parse(at);
  return { id, atS: Number.isFinite(atMs) ? atMs / 1000 : null };
}

/** @param {string} id @param {number | null} atS @returns {string} */
export const hashOf = (id, atS) => `#/${id}${atS === null ? "" : `?at=${new Date(Math.round(atS * 1000)).toISOString()}`}`;
