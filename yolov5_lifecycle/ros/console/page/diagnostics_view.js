/** Every value of the diagnostics, for whoever needs more than the summary. */

import { element, KeyedViews, setText } from "./element.js";
import { LEVELS } from "./reason_view.js";

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
    this.#statuses.update(node.diagnostics, (status) => status.name);
  }
}

class StatusView {
  #title = element("span", { class: "subject" });
  #level = element("span", { class: "level" });
  #message = element("p");
  #rows = element("dl");
  #values;

  constructor() {
    this.#values = new KeyedViews(this.#rows, () => new ValueView());
    this.element = element(
      "details",
      { class: "status" },
      element("summary", {}, this.#title, " ", this.#level),
      this.#message,
      this.#rows,
    );
  }

  update(status) {
    setText(this.#title, status.name);
    setText(this.#level, LEVELS[status.level] ?? "stale");
    this.#level.dataset.level = LEVELS[status.level] ?? "stale";
    setText(this.#message, status.message);
    this.#values.update(Object.entries(status.values), ([key]) => key);
  }
}

class ValueView {
  #key = element("dt");
  #value = element("dd");

  constructor() {
    this.element = element("div", {}, this.#key, this.#value);
  }

  update([key, value]) {
    setText(this.#key, key);
    setText(this.#value, value === "" ? "-" : value);
  }
}
