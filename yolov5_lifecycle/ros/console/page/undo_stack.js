/** The changes that this page has made to a detector, the newest last. */

import { isSame } from "./yaml_text.js";

const KEPT = 200;

export class UndoStack {
  #changes = [];

  get last() {
    return this.#changes.at(-1);
  }

  get count() {
    return this.#changes.length;
  }

  /**
   * Remember that the parameter `name` was changed from `before` to `after`.
   *
   * Values are those of JSON; null: not set. Changes of one `gesture`, such as the drag of a slider, are one change; undefined: of none.
   */
  record({ name, before, after, gesture }) {
    const { last } = this;
    const isContinued = gesture !== undefined && last?.gesture === gesture && last.name === name;
    const change = isContinued ? { ...last, after } : { name, before, after, gesture };
    if (isContinued) {
      this.#changes.pop();
    }
    if (!isSame(change.before, after)) {
      this.#changes.push(change);
    }
    this.#changes.splice(0, this.#changes.length - KEPT);
  }

  remove(change) {
    this.#changes = this.#changes.filter((kept) => kept !== change);
  }
}
