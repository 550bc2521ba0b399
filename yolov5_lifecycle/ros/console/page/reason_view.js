/** The diagnostics' own summary: why there is no output, or that all is well. */

import { summaryOf } from "./condition.js";
import { element, setText } from "./element.js";

export class ReasonView {
  #symbol = element("span", { class: "symbol", "aria-hidden": "true" });
  #level = element("span", { class: "level" });
  #text = element("span", { class: "text" });
  #problem = element("p", { class: "problem" });

  constructor() {
    const line = element("p", {}, this.#symbol, this.#level, this.#text);
    this.element = element(
      "section",
      { class: "notice reason", role: "status", "aria-label": "Summary" },
      line,
      this.#problem,
    );
  }

  update(node) {
    const { name, symbol, word, text, problem } = summaryOf(node);
    this.element.dataset.condition = name;
    setText(this.#symbol, symbol);
    setText(this.#level, word);
    setText(this.#text, text);
    this.#problem.hidden = problem === "";
    setText(this.#problem, `Last problem: ${problem}`);
  }
}
