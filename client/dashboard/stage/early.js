// When the picture of first.js goes: as the page shows its own, or has anything else in view than that scene.

/** @param {import("./viewer.js").Viewer} viewer */
export function endFirst(viewer) {
  const canvas = document.getElementById("first");
  let isOpened = false;
  const end = () => {
    canvas.remove();
    dispatchEvent(new Event("first-over"));
  };
  viewer.addEventListener("shown", end, { once: true });
  viewer.addEventListener("gone", () => {
    canvas.dataset.scene ??= viewer.scene;
    if (isOpened || canvas.dataset.scene !== viewer.scene) end(); // another scene, or none, or this one is refused
    isOpened = true;
  });
}
