/** The diagnostics' own summary: why there is no output, or that all is well. */

import { element, setText } from "./element.js";

export const LEVELS = ["ok", "warning", "error", "stale"];
const OF_NODE = "detection";
const SYMBOLS = ["✓", "!", "✕", "?"];
const STALE = "Diagnostics have stopped: the detector's process hangs, has ended, or cannot be reached.";

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
    const status = node.diagnostics.find(({ name }) => name === OF_NODE) ?? node.diagnostics[0];
    const level = status?.level ?? 3;
    const message = status === undefined ? "no diagnostics received yet" : status.message;
    const text = level === 3 && status !== undefined ? `${STALE} Last message: ${message}` : message;
    for (const [number, name] of LEVELS.entries()) {
      this.element.classList.toggle(name, number === level);
    }
    setText(this.#symbol, SYMBOLS[level]);
    setText(this.#level, LEVELS[level]);
    setText(this.#text, text);
    const problem = status?.values["last problem"] ?? "";
    this.#problem.hidden = problem === "" || message.includes(problem);
    setText(this.#problem, `Last problem: ${problem}`);
  }
}
