// What may be typed as the source of a feed: an address in the network, or a file or device of the service's machine.

const ADDRESS = /^(rtsps?|https?|tcp|udp):\/\/([^/\s@]+@)?(\[[^\]\s]+\]|[^/\s:@?#]+)(:\d+)?([/?]\S*)?$/i;
const PATH = /^((file|v4l2):\/\/)?\/./i;
const WITH_SCHEME = /^[a-z0-9]+:\/\//i;

/** @typedef {"url"|"file"} From */

/** @param {From} from @param {string} text @returns {string} the place of words that say what to change; empty: nothing */
export function faultOf(from, text) {
  const isPath = PATH.test(text);
  if (from === "file") {
    if (isPath) return "";
    return ADDRESS.test(text) ? "live.source_is_url" : "live.source_no_path";
  }
  const [, scheme, user, , port] = ADDRESS.exec(text) ?? [];
  if (scheme === undefined) return isPath || !WITH_SCHEME.test(text) && text.includes("/") ? "live.source_is_path" : "live.source_no_url";
  if (user && !/^rtsps?$/i.test(scheme)) return "live.source_user";
  return port === undefined && /^(tcp|udp)$/i.test(scheme) ? "live.source_port" : "";
}

/** Whether the service refused the source itself. @param {Error & {document?: {field?: string}}} error */
export const isOfSource = (error) => ["options.source", "source"].includes(error.document?.field);
