/** Values that are shown and cannot be edited, and values as text. */

import { element, setText } from "./element.js";

/** A value as text. */
export function shownValue(value) {
  if (value === null) {
    return "not set";
  }
  if (Array.isArray(value)) {
    return value.length > 0 ? value.join(", ") : "empty";
  }
  return value === "" ? "empty" : String(value);
}

export class FixedValue {
  element = element("output", { class: "fixed" });

  show(value) {
    setText(this.element, shownValue(value));
  }

  forget() {}
}

/** In place of a value that the page does not have: whatever it is, it is not empty. */
export class HiddenValue {
  element = element(
    "output",
    { class: "fixed hidden-value" },
    "not shown: too long for this page, or not of this type. It cannot be edited here; use ros2 param.",
  );

  show() {}

  forget() {}
}
