/** What became of every frame, every value of the diagnostics, and the log. */

import { conditionOf } from "./condition.js";
import { element, KeyedViews, panel, setText } from "./element.js";

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

/** The outcome of every frame: received is the sum of the rest. */
export class FrameBalance {
  #body = element("tbody");
  #head = element("tr");
  #cells = new Map();
  #shape = "";

  constructor() {
    const table = element("table", {}, element("thead", {}, this.#head), this.#body);
    const attributes = { class: "scroll", tabindex: "0", role: "group", "aria-label": "Frames of each camera" };
    this.element = panel("balance", "Frame balance", "Frames", element("div", attributes, table));
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

/** With groups of three digits: 12 345. */
function grouped(count) {
  return String(count).replace(/\B(?=(\d{3})+$)/g, "\u202f");
}

export class DiagnosticsView {
  #statuses;

  constructor() {
    const list = element("div");
    this.#statuses = new KeyedViews(list, () => new StatusView());
    this.element = panel("diagnostics", "Diagnostics", "Diagnostics", list);
  }

  update(node) {
    const statuses = node.diagnostics.map((status) => ({ ...status, state: node.state }));
    this.#statuses.update(statuses, (status) => status.name);
  }
}

class StatusView {
  #title = element("span", { class: "subject" });
  #level = element("span", { class: "level" });
  #message = element("p");
  #rows = element("dl");
  #values;

  constructor() {
    this.#values = new KeyedViews(this.#rows, valueView);
    this.element = element(
      "details",
      { class: "status" },
      element("summary", {}, this.#title, " ", this.#level),
      this.#message,
      this.#rows,
    );
  }

  update(status) {
    const { name, symbol, word } = conditionOf(status, status.state);
    setText(this.#title, status.name);
    setText(this.#level, `${symbol} ${word}`);
    this.#level.dataset.condition = name;
    setText(this.#message, status.message);
    this.#values.update(Object.entries(status.values), ([key]) => key);
  }
}

function valueView([key]) {
  const value = element("dd");
  const update = ([, text]) => setText(value, text === "" ? "-" : text);
  return { element: element("div", {}, element("dt", {}, key), value), update };
}

/** Recent lines of the node's log, newest first. */
export class LogView {
  #list = element("ol", { class: "lines", tabindex: "0", "aria-label": "Recent lines, newest first" });
  #none = element("p", { class: "hint" }, "No lines since the console started.");
  #shown = "";

  constructor() {
    this.element = panel("log", "Log", "Log", this.#none, this.#list);
  }

  update({ log }) {
    const last = log.at(-1);
    const shown = `${log.length} ${last?.stamp_s} ${last?.text}`;
    if (shown === this.#shown) {
      return;
    }
    this.#shown = shown;
    this.#none.hidden = log.length > 0;
    this.#list.hidden = log.length === 0;
    this.#list.replaceChildren(...log.map(line).reverse());
  }
}

function line({ stamp_s: stampS, level, text }) {
  const time = new Date(1000 * stampS).toLocaleTimeString("en-GB"); // the time of day here
  return element(
    "li",
    { "data-level": level },
    element("time", {}, time),
    element("span", { class: "level" }, level),
    element("span", { class: "text" }, text),
  );
}
