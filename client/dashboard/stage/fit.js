// The picture fits into what drawers, tools and controls leave free; while those have stepped back it fills the stage.
// What covers the stage names in its style the edge at which it does: --covers.

const STEP_BACK = ".tools, .controls, .five";
const COVERS = `.drawer, .legend, ${STEP_BACK}`;
/** After a press on the picture it stays so long where it is: a second tap means the same place. */
const SETTLES_MS = 350;
/** Of the theatre's width or height; where less would be left for the picture, it lies behind what covers it. */
const MIN_SHARE = 0.25;

/** @param {HTMLElement} theatre @returns {{left: number, right: number, top: number, bottom: number}} covered pixels */
function coveredBy(theatre) {
  const covered = { left: 0, right: 0, top: 0, bottom: 0 };
  const hasLeft = (each) => theatre.hasAttribute("data-idle") && each.matches(STEP_BACK) && !each.querySelector(":focus-visible");
  const whole = theatre.getBoundingClientRect();
  for (const each of theatre.querySelectorAll(COVERS)) {
    const edge = getComputedStyle(each).getPropertyValue("--covers");
    const { left, right, top, bottom, width } = each.getBoundingClientRect();
    if (!(edge in covered) || width === 0 || hasLeft(each)) continue;
    const depth = { left: right - whole.left, right: whole.right - left, top: bottom - whole.top, bottom: whole.bottom - top };
    covered[edge] = Math.max(covered[edge], depth[edge]);
  }
  if (whole.width - covered.left - covered.right < MIN_SHARE * whole.width) covered.left = covered.right = 0;
  if (whole.height - covered.top - covered.bottom < MIN_SHARE * whole.height) covered.top = covered.bottom = 0;
  return covered;
}

/**
 * Keep --free-left, --free-right, --free-top and --free-bottom of the theatre true: how far from its edges the picture begins.
 * @param {HTMLElement} theatre
 * @param {HTMLElement} stage
 */
export function fitPicture(theatre, stage) {
  let settlesAt = 0;
  let timer = 0;
  const fit = () => {
    clearTimeout(timer);
    const waitMs = settlesAt - performance.now();
    if (waitMs > 0) {
      if (waitMs < Infinity) timer = setTimeout(fit, waitMs);
      return;
    }
    for (const [edge, px] of Object.entries(coveredBy(theatre))) theatre.style.setProperty(`--free-${edge}`, `${px}px`);
  };
  const settle = (ms) => {
    settlesAt = performance.now() + ms;
    fit();
  };
  stage.addEventListener("pointerdown", () => settle(Infinity), { capture: true });
  for (const end of ["pointerup", "pointercancel"]) stage.addEventListener(end, () => settle(SETTLES_MS), { capture: true });
  const sizes = new ResizeObserver(fit);
  for (const each of [theatre, ...theatre.querySelectorAll(`.middle, ${COVERS}`)]) sizes.observe(each);
  new MutationObserver(fit).observe(theatre, { attributeFilter: ["data-idle"] });
}
