// The live screen's address: #/ID?at= names a feed, and the moment at which its model is frozen.

const PLACE = /^#\/([0-9a-f]{32})(?:\?(.*))?$/;
const NOWHERE = ["", "#", "#/"];
const MOMENT = /^\d{4}-\d\d-\d\dT\d\d:\d\d.*(Z|[+-]\d\d:\d\d)$/i;

/** @param {number} atS UNIX time @returns {string} of RFC 3339, to the ms */
export const isoOf = (atS) => new Date(Math.round(atS * 1000)).toISOString();

/**
 * @param {string} hash
 * @returns {{id: string | null, isNone: boolean, atS: number | null, isWrong: boolean}} isNone: it names something, but no
 *   feed. atS: UNIX time; null: it is live. isWrong: at= is there and cannot be read
 */
export function feedPlaceOf(hash) {
  const [, id = null, query = ""] = PLACE.exec(hash) ?? [];
  const at = new URLSearchParams(query.replaceAll("+", "%2B")).get("at"); // + is that of a time zone
  const atMs = MOMENT.test(at ?? "") ? Date.parse(at) : NaN;
  const isNone = id === null && !NOWHERE.includes(hash);
  return { id, isNone, atS: Number.isFinite(atMs) ? atMs / 1000 : null, isWrong: at !== null && !Number.isFinite(atMs) };
}

/** @param {string} id @param {number | null} atS @returns {string} */
export const feedHashOf = (id, atS) => `#/${id}${atS === null ? "" : `?at=${isoOf(atS)}`}`;
