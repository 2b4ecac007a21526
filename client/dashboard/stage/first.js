// The first picture of a link to a scene, asked for before the page's modules have come: it is on the stage until they show
// their own, which says what it is worth. It has a socket of its own, for the browser's connections are busy with modules.
"use strict";
(() => {
  const [, scene, query] = /^#\/scene\/([0-9a-f]{32})(?:\?(.*))?$/.exec(location.hash) ?? [];
  if (!scene) return;
  const asked = new URLSearchParams(query);
  const layer = asked.get("layer") ?? "rgb";
  if (layer === "recorded") return; // no picture of the stream's
  /** A picture of which nothing is said does not stay longer than one without a sign of the service (screen.js). */
  const COUNTS_MS = 5000;
  const view = { id: 1, scene, t: Number(asked.get("t")) || 0, layer, format: "jpeg" };
  const pose = asked.get("pose");
  if (pose === "right") view.eye = "right";
  else if (pose) view.pose = pose;
  const [near, far] = (asked.get("range") ?? "").split(",").map(Number);
  if (far && layer === "depth") Object.assign(view, { near_mm: near, far_mm: far });
  const socket = new WebSocket(new URL("/stream", location.href.replace(/^http/, "ws")));
  socket.binaryType = "arraybuffer";
  const key = sessionStorage.getItem("intrasplat-key");
  const isComplete = () => document.readyState !== "loading";
  const isOver = () => isComplete() && document.getElementById("first") === null; // early.js
  const show = async ({ data }) => {
    socket.close();
    if (typeof data === "string") return; // what is wrong is for the modules to say
    const image = await createImageBitmap(new Blob([new Uint8Array(data, 4 + new DataView(data).getUint32(0))]));
    if (!isComplete()) await new Promise((go) => document.addEventListener("readystatechange", go, { once: true }));
    const canvas = document.getElementById("first");
    if (!canvas || (canvas.dataset.scene ?? scene) !== scene) return; // they were faster, or have another scene in view
    canvas.dataset.scene = scene;
    Object.assign(canvas, { width: image.width, height: image.height, hidden: false });
    canvas.getContext("2d").drawImage(image, 0, 0);
    image.close();
    setTimeout(() => canvas.remove(), COUNTS_MS);
  };
  socket.addEventListener("message", show);
  addEventListener("first-over", () => socket.readyState === WebSocket.OPEN && socket.close());
  socket.addEventListener("open", () => {
    if (isOver()) return socket.close();
    if (key) socket.send(JSON.stringify({ authorize: key }));
    socket.send(JSON.stringify(view));
  });
})();
