// Finds the optical flow between pictures, one after the other.

import { flowInCells } from "./flow.js";

addEventListener("message", ({ data: { pictures, width, height } }) => {
  const { w, h, flow } = flowInCells(pictures, width, height);
  postMessage({ w, h, flow }, [flow.buffer]);
});
