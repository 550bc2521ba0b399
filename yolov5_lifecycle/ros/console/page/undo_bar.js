/** The last change of this page, and a button that takes it back. */

import { element, setText } from "./element.js";
import { isSame, shownValue } from "./parameter_values.js";

/** Changes that can be undone. */
const KEPT = 200;
const MAX_SHOWN = 60;
/** How long an undone change is reported. */
const OUTCOME_MS = 10_000;

export class UndoBar {
  /** The newest last. */
  #changes = [];
  #request;
  #restored;
  #isPending = false;
  #outcome = "";
  #timer = 0;
  #text = element("p", { class: "change", role: "status" });
  #refusal = element("p", { class: "refusal", role: "alert" });
  #button = element("button", { type: "button", class: "primary", "aria-keyshortcuts": "Control+Z" }, "Undo");

  /** `request(message)` returns a promise of `{ok, reason}`; `restored(name, value)` is called afterwards. */
  constructor(request, restored) {
    this.#request = request;
    this.#restored = restored;
    this.#button.addEventListener("click", () => this.undo());
    this.#button.addEventListener("blur", () => this.#draw());
    this.element = element(
      "section",
      { class: "undo", "aria-label": "Last change", hidden: true },
      this.#text,
      this.#button,
      this.#refusal,
    );
  }

  /**
   * Remember that the parameter `name` was changed from `before` to `after`.
   *
   * Values are those of JSON; null: not set. Changes of one `gesture`, such as the drag of a slider, are one change; undefined: of none.
   */
  record({ name, before, after, gesture }) {
    const last = this.#changes.at(-1);
    const isContinued = gesture !== undefined && last?.gesture === gesture && last.name === name;
    const kept = isContinued ? this.#changes.slice(0, -1) : this.#changes;
    const change = isContinued ? { ...last, after } : { name, before, after, gesture };
    this.#changes = (isSame(change.before, after) ? kept : [...kept, change]).slice(-KEPT);
    setText(this.#refusal, "");
    this.#show();
  }

  /** Send the value before the last change; the change is kept if the node refuses it. */
  async undo() {
    const change = this.#changes.at(-1);
    if (change === undefined || this.#isPending) {
      return;
    }
    const { name, before } = change;
    this.#setPending(true);
    const { ok, reason } = await this.#request({ type: "set", values: { [name]: before } });
    this.#setPending(false);
    if (ok) {
      this.#changes = this.#changes.filter((kept) => kept !== change);
      this.#restored(name, before);
    }
    setText(this.#refusal, reason);
    this.#show(ok ? `${name} is ${inShort(before)} again.` : "");
  }

  #setPending(isPending) {
    this.#isPending = isPending;
    this.element.setAttribute("aria-busy", String(isPending));
    this.#draw();
  }

  #show(outcome = "") {
    clearTimeout(this.#timer);
    this.#outcome = outcome;
    this.#draw();
    if (outcome !== "") {
      this.#timer = setTimeout(() => this.#show(), OUTCOME_MS);
    }
  }

  #draw() {
    const last = this.#changes.at(-1);
    const count = this.#changes.length;
    // A button that has the keyboard stays: focus would be lost.
    const hasKeyboard = this.#button.matches(":focus-visible");
    this.element.hidden = last === undefined && !hasKeyboard && this.#outcome === "";
    this.#button.hidden = last === undefined && !hasKeyboard;
    this.#button.setAttribute("aria-disabled", String(this.#isPending || last === undefined));
    setText(this.#button, count > 1 ? `Undo (${count})` : "Undo");
    const change = last && `${last.name} changed from ${inShort(last.before)} to ${inShort(last.after)}.`;
    setText(this.#text, [this.#outcome, change].filter(Boolean).join(" "));
    const label = last ? `: set ${last.name} to ${inShort(last.before)}` : ": nothing to undo";
    this.#button.setAttribute("aria-label", `${this.#button.textContent}${label}`);
  }
}

function inShort(value) {
  const text = shownValue(value);
  return text.length > MAX_SHOWN ? `${text.slice(0, MAX_SHOWN)} ...` : text;
}
