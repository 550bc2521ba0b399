/** Elements of the page. External data enters the page only as text. */

const SVG = "http://www.w3.org/2000/svg";

/** An element with attributes and children; `onclick` etc. are listeners; strings become text. */
export function element(tag, attributes = {}, ...children) {
  return filled(document.createElement(tag), attributes, children);
}

/** The same for SVG. */
export function svgElement(tag, attributes = {}, ...children) {
  return filled(document.createElementNS(SVG, tag), attributes, children);
}

function filled(made, attributes, children) {
  for (const [name, value] of Object.entries(attributes)) {
    if (typeof value === "function") {
      made.addEventListener(name.slice("on".length), value);
    } else if (value === true) {
      made.setAttribute(name, "");
    } else if (value !== false && value !== undefined) {
      made.setAttribute(name, value);
    }
  }
  made.append(...children);
  return made;
}

/** A part of the page with a heading; `kind` is its class. */
export function panel(kind, label, title, ...children) {
  return element("section", { class: `panel ${kind}`, "aria-label": label }, element("h2", {}, title), ...children);
}

/** A field for text that is no prose. */
export function plainField(attributes) {
  return element("input", { type: "text", autocomplete: "off", autocapitalize: "off", spellcheck: "false", ...attributes });
}

/** A number with one decimal; "-" without one. */
export function tenth(value) {
  return Number.isFinite(value) ? value.toFixed(1) : "-";
}

/** Change the text of `target` only if it differs: screen readers announce each change. */
export function setText(target, text) {
  if (target.textContent !== text) {
    target.textContent = text;
  }
}

/** An identifier for an element that another one refers to. */
export function uniqueId(prefix) {
  uniqueId.last = (uniqueId.last ?? 0) + 1;
  return `${prefix}-${uniqueId.last}`;
}

/** Views below `parent`, one per item, kept as long as an item has their key. */
export class KeyedViews {
  #parent;
  #make;
  #views = new Map();

  /** `make(item)` returns a view: an `element`, `update(item)` and perhaps `release()`. */
  constructor(parent, make) {
    this.#parent = parent;
    this.#make = make;
  }

  get views() {
    return [...this.#views.values()];
  }

  update(items, keyOf) {
    const keys = new Set(items.map(keyOf));
    for (const [key, view] of this.#views) {
      if (!keys.has(key)) {
        view.release?.();
        view.element.remove();
        this.#views.delete(key);
      }
    }
    let next = this.#parent.firstChild;
    for (const item of items) {
      const view = this.#madeFor(item, keyOf(item));
      view.update(item);
      if (view.element === next) {
        next = next.nextSibling;
      } else {
        this.#parent.insertBefore(view.element, next);
      }
    }
  }

  #madeFor(item, key) {
    if (!this.#views.has(key)) {
      this.#views.set(key, this.#make(item));
    }
    return this.#views.get(key);
  }
}
