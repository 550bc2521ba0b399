/** Every value of the diagnostics, and the log. */

import { conditionOf } from "./condition.js";
import { element, KeyedViews, panel, setText } from "./element.js";

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
