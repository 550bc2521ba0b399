/** The outcome of every frame: received is the sum of the rest. */

import { element, setText } from "./element.js";
import { grouped } from "./figures.js";

const MEANINGS = {
  received: "images since the process started",
  detected: "detections were published",
  stale: "replaced by a newer frame while waiting",
  rejected: "unreadable",
  failed: "inference failed or hung",
  inactive: "arrived while the node was not detecting",
  skipped: "dropped by max_rate",
  flushed: "waiting when detection stopped",
  pending: "waiting or in progress",
};

export class FrameBalance {
  #body = element("tbody");
  #head = element("tr");
  #cells = new Map();
  #shape = "";

  constructor() {
    const table = element("table", {}, element("thead", {}, this.#head), this.#body);
    this.element = element(
      "section",
      { class: "panel balance", "aria-label": "Frame balance" },
      element("h2", {}, "Frames"),
      element("div", { class: "scroll", tabindex: "0", role: "group", "aria-label": "Frames of each camera" }, table),
    );
  }

  update({ cameras }) {
    const kinds = [...new Set(cameras.flatMap((camera) => Object.keys(camera.balance)))];
    const shape = JSON.stringify([cameras.map((camera) => camera.name), kinds]);
    if (shape !== this.#shape) {
      this.#shape = shape;
      this.#build(cameras, kinds);
    }
    for (const camera of cameras) {
      for (const kind of kinds) {
        setText(this.#cells.get(`${camera.name}.${kind}`), grouped(camera.balance[kind] ?? 0));
      }
    }
  }

  #build(cameras, kinds) {
    const titles = cameras.map((camera) => element("th", { scope: "col", class: "number" }, camera.name || "frames"));
    this.#head.replaceChildren(
      element("th", { scope: "col" }, "outcome"),
      ...titles,
      element("th", { scope: "col", class: "meaning" }, "meaning"),
    );
    this.#cells.clear();
    this.#body.replaceChildren(...kinds.map((kind) => this.#row(kind, cameras)));
  }

  #row(kind, cameras) {
    const numbers = cameras.map((camera) => {
      const cell = element("td", { class: "number", "data-kind": kind });
      this.#cells.set(`${camera.name}.${kind}`, cell);
      return cell;
    });
    const meaning = element("td", { class: "meaning" }, MEANINGS[kind] ?? "");
    return element("tr", { class: kind }, element("th", { scope: "row" }, kind), ...numbers, meaning);
  }
}
