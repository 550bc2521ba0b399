/** A form that gives one camera its own value of a parameter. */

import { element, setText } from "./element.js";
import { isOverride, isSame, isSet } from "./yaml_text.js";

export class CameraOverride {
  #isViewOnly;
  #set;
  #parameters = [];
  #camera = element("select", { "aria-label": "Camera", "data-choice": "camera" });
  #name = element("select", { "aria-label": "Parameter", "data-choice": "parameter" });
  #refusal = element("p", { class: "refusal", role: "alert" });

  /** `set({name, before, after})` returns a promise of `{ok, reason}`. */
  constructor(set, isViewOnly) {
    this.#set = set;
    this.#isViewOnly = isViewOnly;
    this.#camera.addEventListener("change", () => this.#showNames());
    this.element = element(
      "form",
      { class: "override", hidden: true, "aria-label": "Override for one camera" },
      element("span", { class: "hint" }, "Override a parameter for one camera"),
      this.#camera,
      this.#name,
      element("button", { class: "small" }, "Override"),
      this.#refusal,
    );
    this.element.addEventListener("submit", (event) => {
      event.preventDefault();
      this.#add();
    });
  }

  update(parameters) {
    this.#parameters = parameters;
    const cameras = this.#valueOf("cameras") ?? [];
    this.element.hidden = this.#isViewOnly || cameras.length === 0;
    fill(this.#camera, cameras);
    this.#showNames();
  }

  /** Parameters of the node that the camera does not override yet. */
  #showNames() {
    const overridden = this.#parameters.filter(isSet).map(({ name }) => name);
    const names = this.#parameters
      .filter(({ name, per_camera: isPerCamera }) => isPerCamera && !isOverride(name))
      .map(({ name }) => name);
    fill(this.#name, names.filter((name) => !overridden.includes(`${this.#camera.value}.${name}`)));
  }

  /** Start with the value of the node; the new parameter can then be changed like any other. */
  async #add() {
    const name = this.#name.value;
    const change = { name: `${this.#camera.value}.${name}`, before: null, after: this.#valueOf(name) };
    const { ok, reason } = await this.#set(change);
    setText(this.#refusal, ok ? "" : reason || "refused without a reason");
  }

  #valueOf(wanted) {
    return this.#parameters.find(({ name }) => name === wanted)?.value;
  }
}

/** Offer `names` in `select`, and keep the choice if it is still offered. */
function fill(select, names) {
  const offered = [...select.options].map(({ value }) => value);
  if (!isSame(offered, names)) {
    const chosen = select.value;
    select.replaceChildren(...names.map((name) => element("option", { value: name, selected: name === chosen }, name)));
  }
}
