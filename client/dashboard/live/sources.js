// What may be typed as the source of a feed: an address in the network, or a file or device of the service's machine.
// intrasplat/live/spec.py has the same rules.

const SCHEMES = "(rtsps?|https?|tcp|udp)";
const ADDRESS = new RegExp(`^${SCHEMES}://(?:([^/?#]*)@)?(?:\\[[\\da-f:.]+\\]|[^/?#:@[\\]]+)(?::(\\d*))?(?:[/?][^#]*)?#?$`, "i");
const ADDRESS_BEGUN = new RegExp(`^${SCHEMES}://[^/?#:]`, "i");
const URL_TEXT = /^[!-~]{1,2000}$/;
const MAX_PORT = 65535;
const PATH = /^((file|v4l2):\/\/)?\/./i;
const WITH_SCHEME = /^[a-z0-9]+:\/\//i;

export const EXAMPLES = { url: "rtsp://192.0.2.10:554/stereo", file: "/data/stereo.mp4" };

/** @typedef {"url"|"file"} From */

/** @param {From} from @param {string} text @returns {string} the place of words that say what to change; empty: nothing */
export function faultOf(from, text) {
  const isPath = PATH.test(text);
  const isBegun = ADDRESS_BEGUN.test(text);
  if (from === "file") {
    if (isPath) return "";
    return isBegun ? "live.source_is_url" : "live.source_no_path";
  }
  if (isPath || (!WITH_SCHEME.test(text) && text.includes("/"))) return "live.source_is_path";
  if (!isBegun) return "live.source_no_url";
  const [, scheme, user, port] = (URL_TEXT.test(text) && ADDRESS.exec(text)) || [];
  if (scheme === undefined || Number(port) > MAX_PORT) return "live.source_unfit";
  if (user && !/^rtsps?$/i.test(scheme)) return "live.source_user";
  return !Number(port) && /^(tcp|udp)$/i.test(scheme) ? "live.source_port" : "";
}
