// A scene's report in plain words. Values that a report does not hold are left out.

const number = (value, digits, unit) => (Number.isFinite(value) ? `${value.toFixed(digits)} ${unit}`.trim() : null);
const share = (value) => (Number.isFinite(value) ? `${Math.round(value * 100)} %` : null);

function quality(report) {
  const model = number(report.psnr_tissue_db, 2, "dB");
  if (model === null) return "Not measured: no frames were held out.";
  const copies = [report.baseline_blend_db, report.baseline_flow_db].filter(Number.isFinite);
  if (copies.length === 0) return `${model} on frames it never saw.`;
  const best = Math.max(...copies);
  const verdict = report.psnr_tissue_db > best ? "better" : "no better";
  return `${model} on frames it never saw; ${verdict} than copying neighbouring frames (${best.toFixed(2)} dB).`;
}

function rows(report) {
  return [
    ["Likeness", quality(report)],
    ["Tissue covered", share(report.coverage)],
    ["Depth against stereo", number(report.depth_agreement_mm, 2, "mm (median difference)")],
    ["Size", Number.isFinite(report.gaussians) ? `${report.gaussians.toLocaleString()} Gaussians` : null],
    ["Training", number(report.seconds?.t_train_s, 1, "s")],
  ].filter(([, text]) => text !== null);
}

function list(title, texts, className) {
  const heading = document.createElement("dt");
  heading.textContent = title;
  const body = document.createElement("dd");
  const items = document.createElement("ul");
  items.className = className;
  for (const text of texts) {
    const item = document.createElement("li");
    item.textContent = text;
    items.append(item);
  }
  body.append(items);
  return [heading, body];
}

export function showReport(target, id, report) {
  const lines = document.createElement("dl");
  for (const [title, text] of rows(report)) {
    const heading = document.createElement("dt");
    heading.textContent = title;
    const body = document.createElement("dd");
    body.textContent = text;
    lines.append(heading, body);
  }
  const warnings = report.warnings ?? [];
  if (warnings.length > 0) lines.append(...list("Warnings", warnings, "warning"));
  const assumptions = report.assumptions ?? [];
  if (assumptions.length > 0) lines.append(...list("Assumed", assumptions, ""));
  const download = document.createElement("a");
  download.href = `/scenes/${id}/export?format=ply&t=0`;
  download.textContent = "Gaussians of the first frame (.ply)";
  target.replaceChildren(lines, download);
}
