/** A button with which a person has the next image of each camera kept, and what the detector answers. */

import { LOST } from "./condition.js";
import { element, setText } from "./element.js";

/** How long a success is reported. */
const RESULT_MS = 10_000;

export class CollectButton {
  #request;
  #isPending = false;
  #timer = 0;
  #button = element("button", { type: "button", onclick: () => this.#collect() });
  #result = element("span", { class: "result", role: "status" });
  #refusal = element("p", { class: "refusal", role: "alert" });

  constructor(request) {
    this.#request = request;
    this.element = element("div", { class: "collect", hidden: true }, this.#button, this.#result, this.#refusal);
  }

  /** Detectors of earlier versions have neither the parameter nor the service. */
  update({ state, cameras, parameters }) {
    this.element.hidden = state === LOST || !parameters.some(({ name }) => name === "collect_dir");
    setText(this.#button, cameras.length > 1 ? "Keep these images" : "Keep this image");
  }

  async #collect() {
    if (this.#isPending) {
      return;
    }
    this.#setPending(true);
    this.#show("", "");
    const { ok, reason, result } = await this.#request({ type: "collect" });
    this.#setPending(false);
    this.#show(ok ? result || "done" : "", ok ? "" : reason);
  }

  #setPending(isPending) {
    this.#isPending = isPending;
    this.#button.setAttribute("aria-disabled", String(isPending));
  }

  #show(result, refusal) {
    clearTimeout(this.#timer);
    setText(this.#result, result);
    setText(this.#refusal, refusal);
    if (result !== "") {
      this.#timer = setTimeout(() => setText(this.#result, ""), RESULT_MS);
    }
  }
}
