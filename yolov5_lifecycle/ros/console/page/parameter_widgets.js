/** The widget that shows and edits one value, chosen by the type and limits of the parameter. */

import { Chips } from "./chips.js";
import { element, plainField, setText } from "./element.js";
import { shownValue } from "./parameter_values.js";

/** Changes when a parameter needs another widget. */
export function widgetKind({ type, range, choices, is_shown: isShown }, isFixed) {
  return JSON.stringify([type, range, choices, isShown, isFixed]);
}

/**
 * `{element, show(value), forget()}` for a parameter; `forget`, which not all have, drops what was typed.
 *
 * `options`: `changed(value)` is called with each value to set, `refused(reason)` for invalid input.
 */
export function widgetFor(parameter, options) {
  if (!parameter.is_shown) {
    return new HiddenValue();
  }
  if (options.isFixed) {
    return new FixedValue();
  }
  const { type, range, choices } = parameter;
  if (type === "bool") {
    return new Switch(options);
  }
  if (type === "string_array") {
    return new Chips({ ...options, hasClassNames: /(^|\.)classes$/.test(parameter.name) });
  }
  if (choices) {
    return new Choice(choices, options);
  }
  if (range) {
    return new Slider(parameter, options);
  }
  return new TextField(type, options);
}

function labelled({ labelId, meaningId }) {
  return { "aria-labelledby": labelId, "aria-describedby": meaningId };
}

class FixedValue {
  element = element("output", { class: "fixed" });

  show(value) {
    setText(this.element, shownValue(value));
  }
}

/** In place of a value that the page does not have: whatever it is, it is not empty. */
class HiddenValue {
  element = element(
    "output",
    { class: "fixed hidden-value" },
    "not shown: too long for this page, or not of this type. It cannot be edited here; use ros2 param.",
  );

  show() {}
}

class Switch {
  #box;

  constructor(options) {
    const changed = () => options.changed(this.#box.checked);
    this.#box = element("input", { type: "checkbox", role: "switch", ...labelled(options), onchange: changed });
    this.element = element("label", { class: "switch" }, this.#box, element("span", { "aria-hidden": "true" }));
  }

  show(value) {
    this.#box.checked = value === true;
  }
}

class Choice {
  constructor(choices, options) {
    this.element = element(
      "select",
      { ...labelled(options), onchange: () => options.changed(this.element.value) },
      ...choices.map((choice) => element("option", { value: choice }, choice)),
    );
  }

  show(value) {
    if (this.element.value !== value) {
      this.element.value = value;
    }
  }
}

/** A field with text that is set with Enter, or when it is left; Escape brings the old text back. */
class TextField {
  #type;
  #shown = null;
  #isEdited = false;

  constructor(type, options, attributes = {}) {
    this.#type = type;
    this.element = plainField({
      inputmode: type === "string" ? "text" : "decimal",
      ...labelled(options),
      ...attributes,
      oninput: () => (this.#isEdited = true),
      onchange: () => this.#change(options),
      onblur: () => this.forget(),
      onkeydown: (event) => event.key === "Escape" && this.forget(),
    });
  }

  show(value) {
    this.#shown = value;
    if (!this.#isEdited) {
      const text = value === null ? "" : String(value);
      this.element.value = this.element.value === text ? this.element.value : text;
      this.element.placeholder = value === null ? "not set" : value === "" ? "empty" : "";
    }
  }

  forget() {
    this.#isEdited = false;
    this.show(this.#shown);
  }

  #change(options) {
    this.#isEdited = false;
    const text = this.element.value.trim();
    const value = this.#type === "string" ? text : Number(text);
    if (this.#type !== "string" && (text === "" || !Number.isFinite(value))) {
      options.refused(`'${text}' is not a number`);
      this.forget();
    } else {
      options.changed(value);
    }
  }
}

/** A slider for the eye and a field for the exact number. */
class Slider {
  #field;
  #slider;
  #from;
  #isLive;
  #changed;
  #value = null;
  #isDragged = false;

  constructor({ type, range, change }, options) {
    const step = stepOf(type, range);
    this.#from = range.from;
    this.#isLive = change === "live";
    this.#changed = options.changed;
    this.#field = new TextField(type, options, { class: "number" });
    this.#slider = element("input", {
      type: "range",
      min: Math.floor(range.from / step) * step,
      max: range.to,
      step,
      ...labelled(options),
      oninput: () => this.#move(),
      onchange: () => this.#commit(),
      onpointercancel: () => this.#cancel(),
    });
    this.element = element("div", { class: "slider" }, this.#slider, this.#field.element);
  }

  show(value) {
    if (!this.#isDragged) {
      this.#value = value;
      this.#slider.value = value ?? this.#slider.min;
      this.#field.show(value);
    }
  }

  forget() {
    this.#isDragged = false;
    this.#field.forget();
  }

  get #valueNow() {
    return Math.max(this.#from, Number(this.#slider.value));
  }

  #move() {
    this.#isDragged = true;
    this.#field.show(this.#valueNow);
    if (this.#isLive) {
      this.#changed(this.#valueNow);
    }
  }

  #commit() {
    const wasDragged = this.#isDragged;
    this.#isDragged = false;
    if (wasDragged && !this.#isLive) {
      this.#changed(this.#valueNow);
    }
  }

  /** Back to the value before the drag: the finger scrolls the page. */
  #cancel() {
    const wasDragged = this.#isDragged;
    this.#isDragged = false;
    this.show(this.#value);
    if (wasDragged && this.#isLive) {
      this.#changed(this.#value);
    }
  }
}

/** The parameter's own, or about a hundredth of the range, at most 1. */
function stepOf(type, { from, to, step }) {
  if (step > 0) {
    return step;
  }
  return type === "integer" ? 1 : Math.min(1, 10 ** Math.round(Math.log10((to - from) / 100)));
}
