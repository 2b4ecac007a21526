// The service's routes that this page uses. Errors carry the problem document's words.

export class Problem extends Error {
  constructor(status, document) {
    super([document.field, document.detail, document.remedy].filter(Boolean).join(" · "));
    this.status = status;
  }
}

async function problemOf(response) {
  const document = await response.json().catch(() => ({ detail: `the service answered ${response.status}` }));
  return new Problem(response.status, document);
}

async function request(path, options = {}) {
  const response = await fetch(path, { cache: "no-store", ...options });
  if (!response.ok) throw await problemOf(response);
  return response;
}

export const listJobs = async () => (await request("/jobs")).json();
export const cancelJob = (id) => request(`/jobs/${id}`, { method: "DELETE" });
export const deleteScene = (id) => request(`/scenes/${id}`, { method: "DELETE" });
export const getReport = async (id) => (await request(`/scenes/${id}`)).json();
export const isReady = async () => (await fetch("/readyz", { cache: "no-store" })).ok;

/** One picture: { blob, t, warning }. */
export async function render(query, signal) {
  const response = await request(`/render?${new URLSearchParams(query)}`, { signal });
  return {
    blob: await response.blob(),
    scene: response.headers.get("X-Intrasplat-Scene"),
    warning: response.headers.get("X-Intrasplat-Warning") ?? "",
  };
}

/** Send a form; onProgress gets the share sent. XMLHttpRequest, because fetch does not tell how far an upload is. */
export function upload(form, onProgress) {
  return new Promise((resolve, reject) => {
    const http = new XMLHttpRequest();
    http.open("POST", "/reconstruct");
    http.responseType = "json";
    http.upload.onprogress = (event) => event.lengthComputable && onProgress(event.loaded / event.total);
    http.onerror = () => reject(new Problem(0, { detail: "the connection was lost", remedy: "Send the clip again." }));
    http.onload = () =>
      http.status === 202 ? resolve(http.response) : reject(new Problem(http.status, http.response ?? { detail: "it failed" }));
    http.send(form);
  });
}
