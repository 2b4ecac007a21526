// Sends the pictures of a capture device of this browser to a feed: both eyes in one picture, as JPEG over a WebSocket.
// At most two are on their way, so a slow line skips pictures and delays none.

import { currentKey } from "../base/key.js";
import { Pace } from "../stage/rate.js";

const PERIOD_MS = 1000 / 15;
const MAX_UNANSWERED = 2;
const PIECE_BYTES = 60 * 1024;
/** Of a picture: its time, s (float64), and its length (uint32). */
const HEADER_BYTES = 12;
const QUALITY = 0.9;
const RECONNECT_MS = 1000;
/** What a device is asked for; it gives what it has. */
const WISHED = { width: { ideal: 3840 }, height: { ideal: 1080 }, frameRate: { ideal: 30 } };

/** @param {string} [deviceId] @returns {Promise<MediaStream>} throws as getUserMedia */
export function openCapture(deviceId) {
  const video = deviceId ? { ...WISHED, deviceId: { exact: deviceId } } : WISHED;
  return navigator.mediaDevices.getUserMedia({ video, audio: false });
}

/** @returns {boolean} whether this browser lets a page use a capture device: not without HTTPS, but for this machine */
export const canCapture = () => navigator.mediaDevices?.getUserMedia !== undefined;

export class Push {
  /**
   * @param {string} feedId
   * @param {MediaStream} media
   * @param {() => void} onEnd the device has ended, or the service takes no more
   */
  constructor(feedId, media, onEnd) {
    Object.assign(this, { feedId, media, onEnd, isOver: false, isBusy: false, unanswered: 0, pace: new Pace() });
    this.video = Object.assign(document.createElement("video"), { srcObject: media, muted: true, playsInline: true });
    this.canvas = document.createElement("canvas");
    for (const track of media.getVideoTracks()) track.addEventListener("ended", () => this.end());
    this.video.play().catch(() => this.end());
    this.timer = setInterval(() => this.#send(), PERIOD_MS);
    this.#connect();
  }

  end() {
    if (this.isOver) return;
    this.isOver = true;
    clearInterval(this.timer);
    this.socket.close();
    for (const track of this.media.getTracks()) track.stop();
    this.onEnd();
  }

  #connect() {
    const url = new URL(`/feeds/${this.feedId}/pictures`, location.href.replace(/^http/, "ws"));
    const socket = (this.socket = new WebSocket(url));
    const key = currentKey();
    this.unanswered = 0;
    socket.addEventListener("open", () => key && socket.send(JSON.stringify({ authorize: key })));
    socket.addEventListener("message", ({ data }) => this.#take(JSON.parse(data)));
    socket.addEventListener("close", () => setTimeout(() => !this.isOver && this.#connect(), RECONNECT_MS));
  }

  #take(message) {
    if (message.taken !== undefined) {
      this.unanswered = Math.max(0, this.unanswered - 1);
      this.pace.note();
    } else if (message.status === 404 || message.status === 409) this.end();
  }

  async #send() {
    const { socket, video, canvas } = this;
    if (this.isBusy || this.unanswered >= MAX_UNANSWERED) return;
    if (socket.readyState !== WebSocket.OPEN || !video.videoWidth) return;
    this.isBusy = true;
    const atS = performance.now() / 1000;
    if (canvas.width !== video.videoWidth || canvas.height !== video.videoHeight) {
      [canvas.width, canvas.height] = [video.videoWidth, video.videoHeight];
    }
    canvas.getContext("2d").drawImage(video, 0, 0);
    const blob = await new Promise((resolve) => canvas.toBlob(resolve, "image/jpeg", QUALITY));
    const bytes = blob && (await blob.arrayBuffer());
    this.isBusy = false;
    if (!bytes || socket.readyState !== WebSocket.OPEN) return;
    const message = new Uint8Array(HEADER_BYTES + bytes.byteLength);
    const header = new DataView(message.buffer);
    header.setFloat64(0, atS, true);
    header.setUint32(8, bytes.byteLength, true);
    message.set(new Uint8Array(bytes), HEADER_BYTES);
    for (let at = 0; at < message.length; at += PIECE_BYTES) socket.send(message.subarray(at, at + PIECE_BYTES));
    this.unanswered += 1;
  }
}
