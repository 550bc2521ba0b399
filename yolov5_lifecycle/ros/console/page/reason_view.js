/** The diagnostics' own summary: why there is no output, or that all is well. */

import { conditionCalled, summaryOf } from "./condition.js";
import { element, setText } from "./element.js";

export class ReasonView {
  #symbol = element("span", { class: "symbol", "aria-hidden": "true" });
  #level = element("span", { class: "level" });
  #text = element("span", { class: "text" });
  #problem = element("p", { class: "problem" });
  #message = "";

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
    const summary = summaryOf(node);
    this.#message = summary.text;
    this.#show(summary, summary.text);
    this.#problem.hidden = summary.problem === "";
    setText(this.#problem, `Last problem: ${summary.problem}`);
  }

  lose() {
    this.#show(conditionCalled("lost"), `Not known now. Last message: ${this.#message}`);
  }

  #show({ name, symbol, word }, text) {
    this.element.dataset.condition = name;
    setText(this.#symbol, symbol);
    setText(this.#level, word);
    setText(this.#text, text);
  }
}
