/** Everything of one detector. */

import { CameraViews } from "./camera_view.js";
import { asLost, conditionCalled, LOST, summaryOf } from "./condition.js";
import { DiagnosticsView, LogView } from "./diagnostics_view.js";
import { element, setText } from "./element.js";
import { HistoryView } from "./history_view.js";
import { ParameterList } from "./parameter_list.js";
import { ReasonView, StateView } from "./state_view.js";

export class NodeView {
  isGone = false;
  isCurrent = false;
  #node = null;
  #condition = conditionCalled("stale");
  #gone = element("p", { class: "notice error", role: "alert", hidden: true });
  #parts;
  #cameras;
  #history = new HistoryView();

  constructor(name, connection, isViewOnly) {
    this.name = name;
    this.isViewOnly = isViewOnly;
    const request = (message) => connection.request({ node: name, ...message });
    this.#cameras = new CameraViews(name, request, isViewOnly);
    this.#parts = [
      new StateView(name, request, isViewOnly),
      new ReasonView(),
      this.#cameras,
      new ParameterList(request, isViewOnly),
      this.#history,
      new DiagnosticsView(),
      new LogView(),
    ];
    this.element = element(
      "article",
      { class: "node", "data-node": name, "aria-label": name },
      this.#gone,
      element("div", { class: "parts" }, ...this.#parts.map((part) => part.element)),
    );
  }

  update(node) {
    this.#setGone(false);
    this.#take(node);
  }

  /** `{name, symbol, word}` for the tab; the word is that of the state if it alone explains the condition. */
  get condition() {
    return this.#condition.name === "idle" ? { ...this.#condition, word: this.#node.state } : this.#condition;
  }

  /** The detector has left: its last values stay, as they may show why. */
  setGone() {
    this.lose();
    this.#setGone(true);
  }

  /** Nothing is heard of the detector until `update`: what is shown is not current. */
  lose() {
    if (this.#node.state !== LOST) {
      this.#take(asLost(this.#node));
    }
  }

  show(isShown, mayReceive) {
    this.element.hidden = !isShown;
    this.#cameras.receive(mayReceive && !this.isGone);
  }

  /** Called once a second. */
  sample() {
    this.#history.sample();
    this.#cameras.sample();
  }

  release() {
    this.#cameras.receive(false);
    this.element.remove();
  }

  #take(node) {
    this.#node = node;
    this.#condition = summaryOf(node);
    this.element.classList.toggle("old", node.state === LOST);
    this.#parts.forEach((part) => part.update(node));
  }

  #setGone(isGone) {
    this.isGone = isGone;
    this.#gone.hidden = !isGone;
    const last = isGone ? `Its last state was ${this.#node.lastState}. ` : "";
    const gone =
      `${this.name} is lost, because its process has ended or cannot be reached. ${last}The values shown are old; ` +
      "the page continues automatically when the detector is back.";
    setText(this.#gone, isGone ? gone : "");
  }
}
