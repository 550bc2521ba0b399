/** Recent lines of the node's log, newest first. */

import { element, setText } from "./element.js";
import { timeOfDay } from "./figures.js";

export class LogView {
  #list = element("ol", { class: "lines", tabindex: "0", "aria-label": "Recent lines, newest first" });
  #none = element("p", { class: "hint" }, "No lines since the console started.");
  #shown = "";

  constructor() {
    this.element = element(
      "section",
      { class: "panel log", "aria-label": "Log" },
      element("h2", {}, "Log"),
      this.#none,
      this.#list,
    );
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
  const said = element("span", { class: "text" });
  setText(said, text);
  return element(
    "li",
    { "data-level": String(level).toLowerCase() },
    element("time", {}, timeOfDay(stampS)),
    element("span", { class: "level" }, String(level)),
    said,
  );
}
