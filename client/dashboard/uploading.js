// The form that sends a clip.

import { upload } from "./api.js";

const OPTION_FIELDS = ["budget_s", "layout"];

/** The multipart body the service expects: clip, or left and right, and the options as one JSON field. */
export function bodyOf(form) {
  const given = new FormData(form);
  const body = new FormData();
  const isPair = given.get("right")?.size > 0;
  for (const part of ["clip", "right", "calibration", "masks"]) {
    const file = given.get(part);
    if (file?.size > 0) body.append(part === "clip" && isPair ? "left" : part, file);
  }
  const options = {};
  for (const name of OPTION_FIELDS) if (given.get(name)) options[name] = given.get(name);
  if (options.budget_s) options.budget_s = Number(options.budget_s);
  body.append("options", JSON.stringify(options));
  return body;
}

export function startUploading(form, message, onJob) {
  const button = form.querySelector("button");
  form.addEventListener("submit", async (event) => {
    event.preventDefault();
    button.disabled = true;
    message.textContent = "sending";
    try {
      onJob(await upload(bodyOf(form), (share) => (message.textContent = `sending ${Math.round(share * 100)} %`)));
      message.textContent = "";
      form.reset();
    } catch (error) {
      message.textContent = error.message;
    } finally {
      button.disabled = false;
    }
  });
}
