// The live screen's address: #/ID?at= names a feed, and the moment at which its model is frozen.

const PLACE = /^#\/([0-9a-f]{32})(?:\?(.*))?$/;
const MOMENT = /^\d{4}-\d\d-\d\dT\d\d:\d\d.*(Z|[+-]\d\d:\d\d)$/i;

/** @param {number} atS UNIX time @returns {string} of RFC 3339, to the ms */
export const isoOf = (atS) => new Date(Math.round(atS * 1000)).toISOString();

/**
 * @param {string} hash
 * @returns {{id: string | null, atS: number | null, isWrong: boolean}} atS: UNIX time; null: it is live. isWrong: at= is there and
 *   cannot be read
 */
export function feedPlaceOf(hash) {
  const [, id = null, query = ""] = PLACE.exec(hash) ?? [];
  const at = new URLSearchParams(query.replaceAll("+", "%2B")).get("at"); // + is that of a time zone
  const atMs = MOMENT.test(at ?? "") ? Date.parse(at) : NaN;
  return { id, atS: Number.isFinite(atMs) ? atMs / 1000 : null, isWrong: at !== null && !Number.isFinite(atMs) };
}

/** @param {string} id @param {number | null} atS @returns {string} */
export const feedHashOf = (id, atS) => `#/${id}${atS === null ? "" : `?at=${isoOf(atS)}`}`;
