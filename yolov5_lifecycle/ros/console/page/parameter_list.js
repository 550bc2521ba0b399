/** The parameters of a detector, grouped by what a change does. */

import { CameraOverride } from "./camera_override.js";
import { element, KeyedViews, setText } from "./element.js";
import { ParameterRow } from "./parameter_row.js";
import { YamlCopy } from "./yaml_copy.js";

const GROUPS = [
  ["live", "Live", "takes effect with the next frame"],
  ["reload", "Reload", "loads the new model while the running one keeps detecting"],
  ["resubscribe", "Resubscribe", "recreates the image subscription"],
  ["configure", "Configure", "fixed by configure: clean up first"],
  ["read only", "Read only", "needs a restart of the node"],
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
    const own = node.parameters.filter((parameter) => groupOf(parameter) === this.#change);
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

function groupOf(parameter) {
  if (parameter.read_only) {
    return "read only";
  }
  return GROUPS.some(([change]) => change === parameter.change) ? parameter.change : "live";
}
