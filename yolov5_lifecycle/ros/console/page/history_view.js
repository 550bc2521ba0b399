/** Plots of rate and latency of every camera over the last minutes, a sample a second. */

import { LOST } from "./condition.js";
import { element, KeyedViews, panel, setText, svgElement, tenth } from "./element.js";

const KEPT_S = 300;
const MINUTE_S = 60;
const WIDTH = 300;
const HEIGHT = 60;

export class HistoryView {
  #cameras;

  constructor() {
    const rows = element("div", { class: "plots" });
    this.#cameras = new KeyedViews(rows, (camera) => new CameraHistory(camera.name));
    this.element = panel("history", "History", "Last minutes", rows);
  }

  update(node) {
    this.#cameras.update(node.cameras, (camera) => camera.name);
    if (node.state === LOST) {
      this.sample(); // at once: a plot must not show an old figure as that of now
    }
  }

  /** Called once a second. */
  sample() {
    this.#cameras.views.forEach((camera) => camera.sample());
  }
}

class CameraHistory {
  #rate = new Plot("Rate", "Hz");
  #latency = new Plot("Latency", "ms");
  #camera = null;

  constructor(name) {
    const title = name ? [element("h3", {}, name)] : [];
    this.element = element("div", { class: "of-camera" }, ...title, this.#rate.element, this.#latency.element);
  }

  update(camera) {
    this.#camera = camera;
  }

  sample() {
    this.#rate.add(this.#camera.rate_hz);
    this.#latency.add(this.#camera.latency_ms);
  }
}

/** A small line plot of one figure. */
class Plot {
  #values = [];
  #lines = svgElement("g", { class: "lines" });
  #limit = element("span", { class: "limit" });
  #last = element("strong", {});
  #svg;
  #name;
  #unit;

  constructor(name, unit) {
    this.#name = name;
    this.#unit = unit;
    this.#svg = svgElement(
      "svg",
      { viewBox: `0 0 ${WIDTH} ${HEIGHT}`, preserveAspectRatio: "none", role: "img" },
      ...minutes(),
      this.#lines,
    );
    const ends = [element("span", {}, `${KEPT_S / MINUTE_S} min ago`), element("span", {}, "now")];
    this.element = element(
      "div",
      { class: "plot" },
      element("p", {}, `${name} `, this.#last, this.#limit),
      this.#svg,
      element("p", { class: "axis", "aria-hidden": "true" }, ...ends),
    );
    this.#draw();
  }

  /** The value of now; null where there is none: a gap. */
  add(value) {
    this.#values = [...this.#values, value].slice(-KEPT_S);
    this.#draw();
  }

  #draw() {
    const known = this.#values.filter(Number.isFinite);
    const limit = roundedUp(Math.max(...known, 0));
    const last = tenth(this.#values.at(-1));
    setText(this.#last, `${last} ${this.#unit}`);
    setText(this.#limit, `scale to ${limit} ${this.#unit}`);
    this.#svg.setAttribute("aria-label", this.#summary(known, last));
    const drawn = runs(this.#values).map((run) => svgElement("polyline", { points: points(run, limit) }));
    this.#lines.replaceChildren(...drawn);
  }

  #summary(known, last) {
    if (known.length === 0) {
      return `${this.#name}: nothing yet`;
    }
    const range = `${tenth(Math.min(...known))} to ${tenth(Math.max(...known))} ${this.#unit}`;
    return `${this.#name}: ${last} ${this.#unit} now, ${range} in the last minutes`;
  }
}

/** The smallest of 1, 2, 5, 10, 20, 50 ... that is at least `value`. */
export function roundedUp(value) {
  if (!(value > 0)) {
    return 1;
  }
  const power = 10 ** Math.floor(Math.log10(value));
  return [1, 2, 5, 10].map((factor) => factor * power).find((limit) => limit >= value * (1 - 1e-9));
}

/** Runs of neighbouring values that are numbers, as lists of [age in seconds, value]. */
export function runs(values) {
  const found = [[]];
  for (const [index, value] of values.entries()) {
    if (Number.isFinite(value)) {
      found.at(-1).push([values.length - 1 - index, value]);
    } else {
      found.push([]);
    }
  }
  return found.filter((run) => run.length > 0);
}

function minutes() {
  const ages = Array.from({ length: KEPT_S / MINUTE_S - 1 }, (_, index) => (index + 1) * MINUTE_S);
  return ages.map((age) => svgElement("line", { class: "minute", x1: across(age), x2: across(age), y1: 0, y2: HEIGHT }));
}

function across(age) {
  return WIDTH * (1 - age / (KEPT_S - 1));
}

function points(run, limit) {
  // One sample alone is a short line.
  const drawn = run.length === 1 ? [...run, [run[0][0] - 1, run[0][1]]] : run;
  const down = (value) => (HEIGHT * (1 - value / limit)).toFixed(1);
  return drawn.map(([age, value]) => `${across(age).toFixed(1)},${down(value)}`).join(" ");
}
