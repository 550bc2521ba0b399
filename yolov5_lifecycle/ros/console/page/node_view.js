/** Everything of one detector. */

import { CameraViews } from "./camera_view.js";
import { DiagnosticsView } from "./diagnostics_view.js";
import { element, setText } from "./element.js";
import { FrameBalance } from "./frame_balance.js";
import { HistoryView } from "./history_view.js";
import { LogView } from "./log_view.js";
import { ParameterList } from "./parameter_list.js";
import { ReasonView } from "./reason_view.js";
import { StateView } from "./state_view.js";

export class NodeView {
  isGone = false;
  isCurrent = false;
  state = "";
  #gone = element("p", { class: "notice error", role: "alert", hidden: true });
  #parts;
  #cameras;
  #history = new HistoryView();

  constructor(name, connection, isViewOnly) {
    this.name = name;
    this.isViewOnly = isViewOnly;
    const request = (message) => connection.request({ node: name, ...message });
    this.#cameras = new CameraViews(name);
    this.#parts = [
      new StateView(name, request, isViewOnly),
      new ReasonView(),
      this.#cameras,
      new ParameterList(request, isViewOnly),
      this.#history,
      new FrameBalance(),
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
    this.state = node.state;
    this.#setGone(false);
    this.#parts.forEach((part) => part.update(node));
  }

  /** The detector has left: its last values stay, as they may show why. */
  setGone() {
    this.#setGone(true);
  }

  show(isShown, mayReceive) {
    this.element.hidden = !isShown;
    this.#cameras.receive(mayReceive && !this.isGone);
  }

  /** Called once a second. */
  sample() {
    this.#history.sample(this.isGone || document.body.classList.contains("lost"));
    this.#cameras.sample();
  }

  release() {
    this.#cameras.receive(false);
    this.element.remove();
  }

  #setGone(isGone) {
    this.isGone = isGone;
    this.element.classList.toggle("gone", isGone);
    this.#gone.hidden = !isGone;
    const gone =
      `${this.name} is lost: its process has ended, or cannot be reached. The values shown are old; ` +
      "the page continues automatically when the detector is back.";
    setText(this.#gone, isGone ? gone : "");
  }
}
