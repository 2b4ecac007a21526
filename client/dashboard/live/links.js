// Links to the live screens of feeds.

import { element } from "../base/element.js";
import { hasWords, language, words } from "../base/messages.js";
import { listFeeds } from "./feeds.js";

const LOOK_MS = 500;
const PERIOD_MS = 5000;

/** @param {string} id @returns {string} the address of its screen */
export const addressOf = (id) => `live.html#/${id}`;

/** @param {import("./feeds.js").Feed} feed @returns {string} */
const nameOf = (feed) => feed.label ?? words("live.unnamed", { id: feed.id.slice(0, 8) });

/** @param {import("./feeds.js").Feed} feed @returns {HTMLElement} a link to its screen, and its state */
export function feedLink(feed) {
  const link = element("a", { class: "feed", text: nameOf(feed) });
  link.href = addressOf(feed.id);
  const place = `live.state_${feed.state}`;
  const state = element("span", { class: "quiet", text: hasWords(place) ? words(place) : feed.state });
  return element("li", {}, link, document.createTextNode(" "), state);
}

/**
 * Anew only where something changed, so that the focus stays.
 * @param {HTMLElement} list
 * @param {import("./feeds.js").Feed[]} feeds
 */
export function showFeeds(list, feeds) {
  const key = JSON.stringify([language(), ...feeds.map(({ id, label, state }) => [id, label, state])]);
  if (list.dataset.of !== key) list.replaceChildren(...feeds.map(feedLink));
  list.dataset.of = key;
}

/**
 * Keep a list of the open feeds up to date while it can be seen.
 * @param {HTMLElement} list
 * @param {() => boolean} isSeen
 */
export function listOpenFeeds(list, isSeen) {
  let nextMs = 0;
  setInterval(async () => {
    if (!isSeen() || document.hidden) nextMs = 0;
    else if (performance.now() >= nextMs) {
      nextMs = performance.now() + PERIOD_MS;
      showFeeds(list, await listFeeds().catch(() => [])); // what is wrong is said elsewhere
    }
  }, LOOK_MS);
}
