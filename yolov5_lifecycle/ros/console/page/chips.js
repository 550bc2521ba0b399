/** A list of strings as chips: known names, selected or not, and a field for others. */

import { element, KeyedViews, plainField, setText } from "./element.js";

/** With more names, there is a field that finds them. */
const FEW = 12;
/** More unselected chips than this are shown only when they are looked for. */
const MAX_SHOWN = 200;

export class Chips {
  #options;
  #chips;
  #value = [];
  #known = [];
  #isUnset = false;
  #shown = "";
  #field;
  #filter;
  #note = element("p", { class: "hint", role: "status" });

  constructor(options) {
    this.#options = options;
    const list = element("div", { class: "chips" });
    this.#chips = new KeyedViews(list, (chip) => this.#chip(chip.name));
    this.#filter = plainField({
      type: "search",
      class: "find",
      "aria-label": "Find a class",
      placeholder: "find a class",
      hidden: true,
      oninput: () => this.#draw(),
    });
    const kind = options.hasClassNames ? "class" : "entry";
    this.#field = plainField({
      "aria-label": `Another ${kind}`,
      placeholder: `another ${kind}`,
      onkeydown: (event) => event.key === "Enter" && this.#add(),
    });
    const add = element("button", { type: "button", class: "small", onclick: () => this.#add() }, "Add");
    const addition = element("div", { class: "addition" }, this.#field, add);
    this.element = element("div", {}, this.#filter, this.#note, list, addition);
  }

  show(value) {
    const known = this.#options.hasClassNames ? this.#options.classNames() : [];
    const shown = JSON.stringify([value, known]);
    if (shown !== this.#shown) {
      // There may be thousands.
      this.#shown = shown;
      this.#value = value ?? [];
      this.#isUnset = value === null;
      this.#known = known;
      this.#draw();
    }
  }

  forget() {
    this.#field.value = "";
  }

  #draw() {
    const words = this.#filter.value.trim().toLowerCase();
    const names = [...new Set([...this.#known, ...this.#value])];
    const selected = new Set(this.#value);
    const found = names.filter((name) => name.toLowerCase().includes(words));
    const shown = found.filter((name, index) => index < MAX_SHOWN || selected.has(name));
    this.#filter.hidden = names.length <= FEW && words === "";
    const chips = shown.map((name) => ({ name, isOn: selected.has(name) }));
    this.#chips.update(chips, (chip) => chip.name);
    setText(this.#note, this.#summary(names.length, found.length, shown.length));
  }

  #summary(count, foundCount, shownCount) {
    const { length } = this.#value;
    const whenEmpty = this.#options.hasClassNames ? "none selected: all classes" : "empty";
    const some = count > FEW ? `${length} of ${count} selected` : "";
    const selection = this.#isUnset ? "not set" : length === 0 ? whenEmpty : some;
    const found = foundCount < count ? `${foundCount} of ${count} found` : "";
    const hidden = shownCount < foundCount ? `${foundCount - shownCount} more: find them by name` : "";
    return [selection, found, hidden].filter(Boolean).join("; ");
  }

  #chip(name) {
    const toggle = () => {
      const others = this.#value.filter((entry) => entry !== name);
      this.#options.changed(others.length < this.#value.length ? others : [...this.#value, name]);
    };
    const button = element("button", { type: "button", class: "chip", "data-name": name, onclick: toggle }, name);
    return { element: button, update: ({ isOn }) => button.setAttribute("aria-pressed", String(isOn)) };
  }

  #add() {
    const name = this.#field.value.trim();
    if (name !== "" && !this.#value.includes(name)) {
      this.#options.changed([...this.#value, name]);
    }
    this.#field.value = "";
  }
}
