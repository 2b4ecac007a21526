// Sends a clip with the generated client, waits for its scene, and saves a picture: node use.js URL CLIP PICTURE

import { readFile, writeFile } from "node:fs/promises";

import { client } from "./api/client.gen";
import { appendToUpload, createUpload, getJob, getScene, listScenes, reconstruct, render } from "./api/sdk.gen";

async function main(): Promise<void> {
  const [url, clip, picture] = process.argv.slice(2) as [string, string, string];
  const tus = { "tus-resumable": "1.0.0" };
  client.setConfig({ baseUrl: url, throwOnError: true });

  const bytes = new Uint8Array(await readFile(clip));
  const encoded = (text: string) => Buffer.from(text).toString("base64");
  const created = await createUpload({
    headers: {
      ...tus,
      "upload-length": bytes.length,
      "upload-metadata": `part ${encoded("clip")},suffix ${encoded(".mp4")}`,
    },
  });
  const upload_id = created.response!.headers.get("location")!.split("/").at(-1)!;
  await appendToUpload({ path: { upload_id }, headers: { ...tus, "upload-offset": 0 }, body: new Blob([bytes]) });

  const sent = await reconstruct({
    body: { clip: upload_id, label: "from TypeScript", metadata: { ris: "0815" }, options: { budget_s: 20 } },
    throwOnError: true,
  });
  let job = sent.data;
  while (job.state !== "done") {
    if (job.state === "failed" || job.state === "cancelled") throw new Error(job.error?.problem ?? job.state);
    await new Promise((resolve) => setTimeout(resolve, 50));
    job = (await getJob({ path: { job_id: job.id }, throwOnError: true })).data;
  }
  const found = await listScenes({ query: { metadata: ["ris=0815"] }, throwOnError: true });
  const report = await getScene({ path: { scene_id: found.data[0]!.id }, throwOnError: true });
  const view = await render({ query: { scene: job.id, t: 0.5 }, parseAs: "blob", throwOnError: true });
  await writeFile(picture, new Uint8Array(await (view.data as Blob).arrayBuffer()));
  console.log(JSON.stringify({ id: job.id, label: job.label, db: report.data.psnr_tissue_db }));
}

void main();
