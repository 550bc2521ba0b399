/** A small line plot of one figure over the last minutes. */

import { element, setText, svgElement } from "./element.js";
import { tenth } from "./figures.js";
import { KEPT_S, roundedUp, runs } from "./history.js";

const WIDTH = 300;
const HEIGHT = 60;
const MINUTE_S = 60;

export class HistoryPlot {
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
    this.element = element(
      "div",
      { class: "plot" },
      element("p", {}, `${name} `, this.#last, this.#limit),
      this.#svg,
      axis(),
    );
    this.update([]);
  }

  /** `values`: one a second, the newest last; null where there is none. */
  update(values) {
    const known = values.filter(Number.isFinite);
    const limit = roundedUp(Math.max(...known, 0));
    const last = tenth(values.at(-1));
    setText(this.#last, `${last} ${this.#unit}`);
    setText(this.#limit, `scale to ${limit} ${this.#unit}`);
    this.#svg.setAttribute("aria-label", this.#summary(known, last));
    const drawn = runs(values).map((run) => svgElement("polyline", { points: points(run, limit) }));
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

function axis() {
  const ago = element("span", {}, `${KEPT_S / MINUTE_S} min ago`);
  return element("p", { class: "axis", "aria-hidden": "true" }, ago, element("span", {}, "now"));
}

function minutes() {
  const ages = Array.from({ length: KEPT_S / MINUTE_S - 1 }, (_, index) => (index + 1) * MINUTE_S);
  return ages.map((age) => {
    const x = across(age);
    return svgElement("line", { class: "minute", x1: x, x2: x, y1: 0, y2: HEIGHT });
  });
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
