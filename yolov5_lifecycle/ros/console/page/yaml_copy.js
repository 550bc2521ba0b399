/** Button that copies the values that differ from their defaults, as YAML. */

import { element, setText, uniqueId } from "./element.js";
import { yamlText } from "./yaml_text.js";

export class YamlCopy {
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

  async #copy() {
    const copied = (await copiedByClipboard(this.#text.value)) || this.#copiedBySelection();
    const what = "Every value that differs from its default, for --params-file.";
    setText(this.#said, copied ? `${what} Copied.` : `${what} This browser cannot copy it: select and copy the text.`);
  }

  /** Browsers offer the clipboard on loopback and with TLS only; this older way works everywhere. */
  #copiedBySelection() {
    this.#text.select();
    const copied = document.execCommand("copy");
    this.button.focus();
    return copied;
  }
}

async function copiedByClipboard(text) {
  try {
    await navigator.clipboard.writeText(text);
    return true;
  } catch {
    return false;
  }
}
