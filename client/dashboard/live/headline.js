// The one word on top: what the screen shows, and how far that is from now.

/**
 * kind: names icon, colour and frame. place: of the words. values: for the words.
 * @typedef {{kind: "live"|"behind"|"frozen"|"back"|"lost"|"paused"|"empty"|"connecting"|"ended", place: string,
 *   values: Record<string, string | number>}} Headline
 */
/**
 * What is known. feed: as it was reported last; null before that. isGone: it has ended. mode: of the model's view.
 * answerAgeS: since the service answered anything. pictureAgeS: of the live picture; null: there is none.
 * isPictureRepeated: the newest answer brought the picture before once more. hasPictureFailed: the newest answer was
 * none. modelAgeS: of what the model shows while it follows; null: nothing yet.
 * @typedef {{feed: import("./feeds.js").Feed | null, isGone: boolean, mode: "live"|"frozen"|"back", answerAgeS: number,
 *   pictureAgeS: number | null, isPictureRepeated: boolean, hasPictureFailed: boolean, modelAgeS: number | null,
 *   frozenAt: string, backS: number}} Known
 */

export const LOST_AFTER_S = 1;
/** A model that is older than this is said to be behind. */
export const BEHIND_S = 2;
/** Pictures of a source that may stay out before it is called lost. */
const MISSED = 2.5;
const KINDS = { connecting: "connecting", stalled: "lost", paused: "paused", no_tissue: "empty", ended: "ended" };

const said = (kind, place, values = {}) => ({ kind, place, values });
const seconds = (ageS) => Math.max(1, Math.round(ageS));

/** Of the endoscope's picture alone. @param {Known} known @returns {Headline} */
export function headlineOfPicture(known) {
  const { feed, isGone, answerAgeS, pictureAgeS } = known;
  if (isGone) return said("ended", "live.word_ended");
  if (answerAgeS > LOST_AFTER_S) return said("lost", "live.word_service_lost");
  if (feed === null) return said("connecting", "live.word_connecting");
  if (feed.state in KINDS) return said(KINDS[feed.state], `live.word_${feed.state}`);
  if (known.hasPictureFailed) return said("lost", "live.word_no_picture");
  if (pictureAgeS === null) return said("connecting", "live.word_connecting");
  if (pictureAgeS <= Math.max(LOST_AFTER_S, feed.received_fps > 0 ? MISSED / feed.received_fps : 0)) {
    return said("live", "live.word_live");
  }
  if (known.isPictureRepeated) return said("lost", "live.word_stalled");
  return said("behind", "live.word_picture_behind", { s: seconds(pictureAgeS) });
}

/** Of the whole screen. @param {Known} known @returns {Headline} */
export function headlineOf(known) {
  if (known.mode === "frozen") return said("frozen", "live.word_frozen", { time: known.frozenAt });
  if (known.mode === "back") return said("back", "live.word_back", { s: seconds(known.backS) });
  const found = headlineOfPicture(known);
  if (found.kind !== "live" || known.modelAgeS === null) return found;
  const isBehind = known.modelAgeS > BEHIND_S || (known.feed.state === "behind" && known.modelAgeS > LOST_AFTER_S);
  return isBehind ? said("behind", "live.word_behind", { s: seconds(known.modelAgeS) }) : found;
}
