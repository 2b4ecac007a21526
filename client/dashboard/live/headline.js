// The one word on top: what the screen shows, and how far that is from now.

/**
 * kind: names icon, colour and frame. place: of the words. values: for the words.
 * @typedef {{kind: "live"|"behind"|"frozen"|"back"|"lost"|"paused"|"empty"|"connecting"|"ended", place: string,
 *   values: Record<string, string | number>}} Headline
 */
/**
 * What is known. feed: as it was reported last; null before that. isGone: it has ended. mode: of the model's view.
 * answerAgeS: since the service answered anything. pictureAtS: UNIX time of the live picture, pictureAgeS: its age; null:
 * there is none. pictureProblem: in place of the newest answer. modelAgeS: of what the model shows while it follows; null:
 * nothing yet.
 * @typedef {{feed: import("./feeds.js").Feed | null, isGone: boolean, mode: "live"|"frozen"|"back", answerAgeS: number,
 *   pictureAtS: number | null, pictureAgeS: number | null, pictureProblem: {status: number} | null,
 *   modelAgeS: number | null, frozenAt: string, backS: number}} Known
 */

export const LOST_AFTER_S = 1;
/** The same where answers are only awaited: numbers come once a second, and a busy worker's pictures later. */
const SILENT_AFTER_S = 2;
/** The same where no picture is asked for, so that numbers alone come. */
const UNASKED_AFTER_S = 4;
/** Pairs that came so much later than a picture show that the picture is late, and not the source. */
const LATER_S = 0.5;
/** Times of pictures are rounded by up to this. */
const ROUNDED_S = 0.002;
/** In place of a status: the service did not answer. */
const NO_ANSWER = 0;
/** A picture that the service does not give is behind until then: the report that says why is under way. */
const NO_PICTURE_AFTER_S = 4;
/** A model that is older than this is said to be behind. */
export const BEHIND_S = 2;
/** Pictures of a source that may stay out before it is called lost. */
const MISSED = 2.5;
const KINDS = { connecting: "connecting", stalled: "lost", paused: "paused", no_tissue: "empty", ended: "ended" };
/** What is said of a feed that stalls, by the code of its reason; else the signal is lost. */
const STALLED = {
  size_changed: "unusable", packing_changed: "unusable", packing_unknown: "unusable", picture_limit: "unusable",
  times_jumped: "unusable", undecodable: "unusable", no_video: "unusable",
  decoder_ended: "fault", decoder_memory: "fault", fault: "fault",
  too_slow: "too_slow",
  no_scene: "no_model", calibration: "no_model",
};
/** States in which no picture is shown or asked for. */
export const HIDDEN_STATES = ["no_tissue"];
/** Reasons that may be the model's alone: the picture comes in. */
const OF_MODEL = ["no_scene", "calibration", "fault"];

/**
 * Whether pictures have come in since the feed said that none can be shown.
 * @param {import("./feeds.js").Feed} feed
 * @param {number | null} pictureAtS
 */
export const isBack = ({ state, last_frame_at_s }, pictureAtS) =>
  state === "stalled" && pictureAtS !== null && last_frame_at_s !== null && pictureAtS > last_frame_at_s + ROUNDED_S;

const said = (kind, place, values = {}) => ({ kind, place, values });
const seconds = (ageS) => Math.max(1, Math.round(ageS));

/** Of the endoscope's picture alone. @param {Known} known @returns {Headline} */
export function headlineOfPicture({ feed, isGone, answerAgeS, pictureAtS, pictureAgeS, pictureProblem }) {
  if (isGone) return said("ended", "live.word_ended");
  const isRefused = pictureProblem?.status === NO_ANSWER;
  const silentAfterS = feed && HIDDEN_STATES.includes(feed.state) ? UNASKED_AFTER_S : SILENT_AFTER_S;
  if (answerAgeS > (isRefused ? LOST_AFTER_S : silentAfterS)) return said("lost", "live.word_service_lost");
  if (feed === null) return said("connecting", "live.word_connecting");
  const why = STALLED[feed.reason] ?? "stalled";
  const isModelsAlone = feed.state === "stalled" && OF_MODEL.includes(feed.reason) && pictureAtS !== null;
  const isSeen = isModelsAlone || isBack(feed, pictureAtS);
  if (feed.state in KINDS && !isSeen) return said(KINDS[feed.state], `live.word_${feed.state === "stalled" ? why : feed.state}`);
  if (pictureAtS === null) return said("connecting", "live.word_connecting");
  const missedS = feed.received_fps > 0 ? MISSED / feed.received_fps : 0;
  if (pictureAgeS <= Math.max(LOST_AFTER_S, missedS)) return said("live", "live.word_live");
  const isLate = feed.last_frame_at_s !== null && feed.last_frame_at_s > pictureAtS + LATER_S;
  const isSoon = isLate && pictureAgeS <= NO_PICTURE_AFTER_S;
  if (pictureProblem !== null && !isRefused && !isSoon) return said("lost", "live.word_no_picture");
  if (!isLate) return said("lost", `live.word_${why === "no_model" ? "stalled" : why}`);
  return said("behind", "live.word_picture_behind", { s: seconds(pictureAgeS) });
}

/** Of the whole screen. @param {Known} known @returns {Headline} */
export function headlineOf(known) {
  if (known.mode === "frozen") return said("frozen", "live.word_frozen", { time: known.frozenAt });
  if (known.mode === "back") return said("back", "live.word_back", { s: seconds(known.backS) });
  const found = headlineOfPicture(known);
  if (found.kind !== "live") return found;
  if (known.feed.state === "stalled" && OF_MODEL.includes(known.feed.reason)) return said("behind", "live.word_no_model");
  if (known.modelAgeS === null) return found;
  const isBehind = known.modelAgeS > BEHIND_S || (known.feed.state === "behind" && known.modelAgeS > LOST_AFTER_S);
  return isBehind ? said("behind", "live.word_behind", { s: seconds(known.modelAgeS) }) : found;
}
