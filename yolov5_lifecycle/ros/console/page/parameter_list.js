/** The parameters of a detector, grouped by what a change does, with overrides of cameras and as YAML. */

import { element, KeyedViews, setText, uniqueId } from "./element.js";
import { ParameterRow } from "./parameter_row.js";
import { isOverride, isSame, isSet, yamlText } from "./parameter_values.js";

const GROUPS = [
  ["live", "Live", "takes effect with the next frame"],
  ["reload", "Reload", "loads the new model while the running one keeps detecting"],
  ["resubscribe", "Resubscribe", "recreates the subscriptions concerned"],
  ["configure", "Configure", "fixed by configure: clean up first"],
  ["read_only", "Read only", "needs a restart of the node"],
];
const OPEN = ["live"];

export class ParameterList {
  #groups;
  #override;
  #yaml = new YamlCopy();
  #filter = element("input", { type: "search", placeholder: "Find a parameter", "aria-label": "Find a parameter" });
  #none = element("p", { class: "hint", role: "status" });

  #undo;

  /** `undo`: the UndoBar of the detector. */
  constructor(request, undo, isViewOnly) {
    this.#undo = undo;
    const set = (change) => this.#set(request, change);
    this.#groups = GROUPS.map(
      ([change, title, meaning]) => new ParameterGroup({ change, title, meaning, set, isViewOnly }),
    );
    this.#override = new CameraOverride(set, isViewOnly);
    this.#filter.addEventListener("input", () => this.#applyFilter());
    this.element = element(
      "section",
      { class: "panel parameters", "aria-label": "Parameters" },
      element("div", { class: "title" }, element("h2", {}, "Parameters"), this.#yaml.button),
      this.#yaml.element,
      this.#filter,
      this.#none,
      ...this.#groups.map((group) => group.element),
      this.#override.element,
    );
  }

  update(node) {
    this.#groups.forEach((group) => group.update(node));
    this.#override.update(node.parameters);
    this.#yaml.update(node.parameters);
    this.#applyFilter();
  }

  /** Show `value` of the parameter `name`, which was set by other means, before the node reports it. */
  restore(name, value) {
    this.#groups.forEach((group) => group.restore(name, value));
  }

  /** Request a change, see UndoBar.record, and keep it to be undone. */
  async #set(request, change) {
    const answer = await request({ type: "set", values: { [change.name]: change.after } });
    if (answer.ok || answer.isUnknown) {
      this.#undo.record(change);
    }
    return answer;
  }

  #applyFilter() {
    const words = this.#filter.value.trim().toLowerCase();
    const counts = this.#groups.map((group) => group.applyFilter(words));
    setText(this.#none, words && !counts.some(Boolean) ? "No parameter matches in name or description." : "");
  }
}

class ParameterGroup {
  #change;
  #count = element("span", { class: "hint" });
  #rows;
  #node = null;
  #openBefore = null;

  constructor({ change, title, meaning, set, isViewOnly }) {
    this.#change = change;
    const list = element("div");
    const context = { isViewOnly, set, classNames: () => this.#node.class_names };
    this.#rows = new KeyedViews(list, (parameter) => new ParameterRow(parameter, context));
    this.element = element(
      "details",
      { class: "group", open: OPEN.includes(change), "data-group": change },
      element("summary", {}, element("h3", {}, title), " ", this.#count),
      element("p", { class: "hint" }, `A change ${meaning}.`),
      list,
    );
  }

  update(node) {
    this.#node = node;
    const own = node.parameters.filter((parameter) => parameter.change === this.#change);
    this.#rows.update(own, (parameter) => parameter.name);
    const changed = this.#rows.views.filter((row) => row.isChanged).length;
    setText(this.#count, `${own.length}${changed ? `, ${changed} changed` : ""}`);
  }

  restore(name, value) {
    this.#rows.viewOf(name)?.restore(value);
  }

  /** Show the rows with these words, all without any; returns how many are shown. */
  applyFilter(words) {
    const shown = this.#rows.views.filter((row) => row.applyFilter(words)).length;
    this.element.hidden = shown === 0;
    if (words !== "" && this.#openBefore === null) {
      this.#openBefore = this.element.open;
      this.element.open = true;
    } else if (words === "" && this.#openBefore !== null) {
      this.element.open = this.#openBefore;
      this.#openBefore = null;
    }
    return shown;
  }
}

/** A form that gives one camera its own value of a parameter. */
class CameraOverride {
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
    const { reason } = await this.#set(change);
    setText(this.#refusal, reason);
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

/** Button that copies the values that differ from their defaults, as YAML. */
class YamlCopy {
  #parameters = [];
  #text = element("textarea", { readonly: true, rows: "8", "aria-label": "Parameters as YAML", spellcheck: "false" });
  #said = element("p", { class: "hint", role: "status" });

  constructor() {
    const id = uniqueId("yaml");
    this.element = element("div", { class: "yaml", id, hidden: true }, this.#said, this.#text);
    const attributes = { class: "small copy", "aria-expanded": "false", "aria-controls": id };
    const press = () => this.#press();
    this.button = element("button", { type: "button", ...attributes, onclick: press }, "Copy as YAML");
  }

  update(parameters) {
    this.#parameters = parameters;
  }

  #press() {
    const isOpen = this.element.hidden;
    this.element.hidden = !isOpen;
    this.button.setAttribute("aria-expanded", String(isOpen));
    setText(this.button, isOpen ? "Close YAML" : "Copy as YAML");
    if (isOpen) {
      this.#text.value = yamlText(this.#parameters);
      this.#copy();
    }
  }

  #copy() {
    this.#text.select();
    const copied = document.execCommand("copy"); // navigator.clipboard is there on loopback and with TLS only
    this.button.focus();
    const what = "Every value that differs from its default, for --params-file.";
    setText(this.#said, copied ? `${what} Copied.` : `${what} This browser cannot copy it: select and copy the text.`);
  }
}
