/** A list of strings as chips: known names, selected or not, and a field for others. */

import { element, KeyedViews, setText } from "./element.js";

export class Chips {
  #options;
  #chips;
  #value = [];
  #shown = "";
  #field;
  #note = element("span", { class: "hint" });

  constructor(options) {
    this.#options = options;
    const list = element("div", { class: "chips" });
    this.#chips = new KeyedViews(list, (chip) => this.#chip(chip.name));
    this.#field = element("input", {
      type: "text",
      autocomplete: "off",
      autocapitalize: "off",
      spellcheck: "false",
      "aria-label": options.hasClassNames ? "Another class" : "Another entry",
      placeholder: options.hasClassNames ? "another class" : "another entry",
      onkeydown: (event) => event.key === "Enter" && this.#add(),
    });
    const add = element("button", { type: "button", class: "small", onclick: () => this.#add() }, "Add");
    this.element = element("div", {}, list, this.#note, element("div", { class: "addition" }, this.#field, add));
  }

  show(value) {
    const known = this.#options.hasClassNames ? this.#options.classNames() : [];
    const shown = JSON.stringify([value, known]);
    if (shown === this.#shown) {
      return; // there may be thousands
    }
    this.#shown = shown;
    this.#value = value ?? [];
    const names = [...new Set([...known, ...this.#value])];
    const chips = names.map((name) => ({ name, isOn: this.#value.includes(name) }));
    this.#chips.update(chips, (chip) => chip.name);
    const whenEmpty = this.#options.hasClassNames ? "none selected: all classes" : "empty";
    setText(this.#note, value === null ? "not set" : this.#value.length === 0 ? whenEmpty : "");
  }

  forget() {
    this.#field.value = "";
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
