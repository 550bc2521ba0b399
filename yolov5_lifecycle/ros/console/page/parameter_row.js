/** One parameter: its widget, what a pending change waits for, and why a change was refused. */

import { element, setText, uniqueId } from "./element.js";
import { isChanged, isOverride, isSame, shownValue } from "./parameter_values.js";
import { widgetFor, widgetKind } from "./parameter_widgets.js";

const SETTLED_MS = 2000;
const BETWEEN_MS = 120;
const WAITING = {
  reload: "loading the new model; the old one keeps detecting",
  resubscribe: "recreating the subscription",
};

export class ParameterRow {
  #parameter = null;
  /** What it was when the page was opened, if it was set and shown. */
  #first;
  #context;
  #widget = null;
  #kind = "";
  #isSending = false;
  #next = null;
  /** Accepted by the node but perhaps not yet reported: `{value, untilMs}`. */
  #accepted = null;
  #label;
  #place = element("div", { class: "widget" });
  #waiting = element("span", { class: "spinner", role: "status" });
  #refusal = element("p", { class: "refusal", role: "alert" });
  #reset = element("button", { type: "button", class: "small reset", hidden: true }, "Default");
  #back = element("button", { type: "button", class: "small back", hidden: true }, "Back");
  #meaning;

  constructor(parameter, context) {
    this.#first = parameter.value;
    this.#context = context;
    const [label, meaning] = [uniqueId("label"), uniqueId("meaning")];
    this.#label = element("span", { class: "name", id: label }, parameter.name);
    this.#meaning = element("p", { class: "hint", id: meaning });
    const usual = isOverride(parameter.name) ? "the value of the node" : "its default";
    this.#reset.setAttribute("aria-label", `Set ${parameter.name} to ${usual}`);
    this.#reset.addEventListener("click", () => this.#send(this.#usual));
    this.#back.setAttribute("aria-label", `Set ${parameter.name} to what it was when the page was opened`);
    this.#back.addEventListener("click", () => this.#send(this.#first));
    this.element = element(
      "div",
      { class: "parameter", role: "group", "aria-labelledby": label, "data-parameter": parameter.name },
      element("div", { class: "title" }, this.#label, this.#waiting, this.#back, this.#reset),
      this.#place,
      this.#refusal,
      this.#meaning,
    );
  }

  /** The default; of an override for a camera, that it is not set. */
  get #usual() {
    return isOverride(this.#parameter.name) ? null : this.#parameter.default;
  }

  get isChanged() {
    return this.element.classList.contains("changed");
  }

  update(parameter) {
    this.#parameter = parameter;
    setText(this.#meaning, parameter.description);
    this.#meaning.title = parameter.constraints;
    const isFixed = this.#context.isViewOnly || parameter.change === "read_only";
    const kind = widgetKind(parameter, isFixed);
    if (kind !== this.#kind) {
      this.#kind = kind;
      this.#widget = widgetFor(parameter, {
        isFixed,
        classNames: this.#context.classNames,
        labelId: this.#label.id,
        meaningId: this.#meaning.id,
        changed: (value) => this.#send(value),
        refused: (reason) => setText(this.#refusal, reason),
      });
      this.#place.replaceChildren(this.#widget.element);
    }
    this.element.classList.toggle("changed", isChanged(parameter));
    const canSet = parameter.is_shown && !isFixed;
    this.#offer(this.#reset, canSet && isChanged(parameter), this.#usual);
    const isOther = [parameter.value, this.#usual].every((value) => !isSame(value, this.#first));
    this.#offer(this.#back, canSet && this.#first !== null && isOther, this.#first);
    this.#show();
  }

  /** Show the `button` that sets `value`, or hide it. */
  #offer(button, isUseful, value) {
    // A button that has the keyboard stays until it is left: focus would be lost.
    button.hidden = !isUseful && document.activeElement !== button;
    button.title = isUseful ? `${button.textContent}: ${shownValue(value)}` : "";
  }

  applyFilter(words) {
    const text = `${this.#parameter.name} ${this.#parameter.description}`.toLowerCase();
    this.element.hidden = !text.includes(words);
    return !this.element.hidden;
  }

  /** One request at a time; of values set meanwhile, only the last is sent. */
  async #send(value) {
    this.#next = { value };
    if (this.#isSending) {
      this.#show(); // the next change builds on it
      return;
    }
    this.#isSending = true;
    setText(this.#refusal, "");
    while (this.#next !== null) {
      const wanted = this.#next;
      this.#next = null;
      await this.#request(wanted);
    }
    this.#isSending = false;
    this.#setWaiting(false);
    this.#show();
    // The node may have converted it and already reported the result.
    setTimeout(() => this.#show(), SETTLED_MS + 1);
  }

  async #request({ value }) {
    this.#setWaiting(true);
    this.#accepted = { value, untilMs: Infinity };
    this.#show();
    const [{ ok, reason }] = await Promise.all([this.#context.set(this.#parameter.name, value), pause(BETWEEN_MS)]);
    setText(this.#refusal, reason);
    this.#accepted = ok ? { value, untilMs: performance.now() + SETTLED_MS } : null;
    if (!ok) {
      this.#widget.forget?.();
    }
  }

  #setWaiting(isWaiting) {
    this.element.setAttribute("aria-busy", String(isWaiting));
    this.element.classList.toggle("busy", isWaiting);
    setText(this.#waiting, isWaiting ? (WAITING[this.#parameter.change] ?? "setting") : "");
  }

  #show() {
    const { value } = this.#parameter;
    // Until then a report may be older than what the node has accepted.
    if (this.#accepted && performance.now() > this.#accepted.untilMs) {
      this.#accepted = this.#isSending ? this.#accepted : null;
    }
    this.#widget.show((this.#next ?? this.#accepted ?? { value }).value);
  }
}

function pause(durationMs) {
  return new Promise((resolve) => setTimeout(resolve, durationMs));
}
