/** Every value of the diagnostics, for whoever needs more than the summary. */

import { conditionOf } from "./condition.js";
import { element, KeyedViews, setText } from "./element.js";

export class DiagnosticsView {
  #statuses;

  constructor() {
    const list = element("div");
    this.#statuses = new KeyedViews(list, () => new StatusView());
    this.element = element(
      "section",
      { class: "panel diagnostics", "aria-label": "Diagnostics" },
      element("h2", {}, "Diagnostics"),
      list,
    );
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
