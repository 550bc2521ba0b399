/** The parameters of a detector, grouped by what a change does, and as YAML. */

import { element, KeyedViews, setText, uniqueId } from "./element.js";
import { ParameterRow } from "./parameter_row.js";
import { yamlText } from "./parameter_values.js";

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
  #yaml = new YamlCopy();
  #filter = element("input", { type: "search", placeholder: "Find a parameter", "aria-label": "Find a parameter" });
  #none = element("p", { class: "hint", role: "status" });

  constructor(request, isViewOnly) {
    const set = (name, value) => request({ type: "set", values: { [name]: value } });
    this.#groups = GROUPS.map(
      ([change, title, meaning]) => new ParameterGroup({ change, title, meaning, set, isViewOnly }),
    );
    this.#filter.addEventListener("input", () => this.#applyFilter());
    this.element = element(
      "section",
      { class: "panel parameters", "aria-label": "Parameters" },
      element("div", { class: "title" }, element("h2", {}, "Parameters"), this.#yaml.button),
      this.#yaml.element,
      this.#filter,
      this.#none,
      ...this.#groups.map((group) => group.element),
    );
  }

  update(node) {
    this.#groups.forEach((group) => group.update(node));
    this.#yaml.update(node.parameters);
    this.#applyFilter();
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
