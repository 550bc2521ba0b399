/** The lifecycle state with the possible transitions as buttons, and the summary of the diagnostics. */

import { summaryOf } from "./condition.js";
import { element, KeyedViews, panel, setText } from "./element.js";

const SYMBOLS = { unconfigured: "○", inactive: "◐", active: "●", finalized: "■", lost: "✕" };
const CONFIRMED = { shutdown: "Ends the process of the detector. Only its supervisor or a person can start it again." };

export class StateView {
  #state = element("strong", { class: "state" });
  #busy = element("span", { class: "spinner", role: "status" });
  #refusal = element("p", { class: "refusal", role: "alert" });
  #confirmation = element("div", { class: "confirmation", role: "group" });
  #buttons;
  #request;
  #pending = "";

  constructor(name, request, isViewOnly) {
    this.#request = request;
    const buttons = element("div", { class: "buttons", role: "group", "aria-label": "Transitions" });
    this.#buttons = new KeyedViews(buttons, (label) => this.#button(label));
    this.element = panel(
      "head",
      "State",
      name,
      this.#state,
      ...(isViewOnly ? [] : [buttons]),
      this.#busy,
      this.#confirmation,
      this.#refusal,
    );
  }

  update(node) {
    this.#showState(node.state);
    this.#buttons.update(node.transitions, (label) => label);
  }

  #showState(state) {
    if (this.#state.dataset.state !== state) {
      this.#confirmation.replaceChildren(); // it was about another state
    }
    this.#state.dataset.state = state;
    this.#state.dataset.symbol = SYMBOLS[state] ?? "◌";
    setText(this.#state, state);
  }

  /** `label`: the transition that is requested, "" for none. */
  #setPending(label) {
    this.#pending = label;
    setText(this.#busy, label && `${label} ...`);
    this.element.setAttribute("aria-busy", String(label !== ""));
    this.element.classList.toggle("busy", label !== "");
  }

  #button(label) {
    const press = () => (label in CONFIRMED ? this.#confirm(label) : this.#start(label));
    const attributes = { type: "button", "data-transition": label, onclick: press };
    if (label in CONFIRMED) {
      attributes.class = "danger";
    } else if (label === "activate" || label === "configure") {
      attributes.class = "primary";
    }
    return { element: element("button", attributes, label), update: () => {} };
  }

  #confirm(label) {
    const close = () => this.#confirmation.replaceChildren();
    const yes = element(
      "button",
      { type: "button", class: "danger", onclick: () => (close(), this.#start(label)) },
      `Yes, ${label}`,
    );
    const no = element("button", { type: "button", onclick: close }, "Cancel");
    this.#confirmation.replaceChildren(element("p", {}, CONFIRMED[label]), yes, no);
    no.focus();
  }

  async #start(label) {
    if (this.#pending) {
      return;
    }
    this.#setPending(label);
    setText(this.#refusal, "");
    const { reason } = await this.#request({ type: "transition", label });
    this.#setPending("");
    setText(this.#refusal, reason);
  }
}

/** The diagnostics' own summary: why there is no output, or that all is well. */
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
