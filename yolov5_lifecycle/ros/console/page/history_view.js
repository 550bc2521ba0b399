/** Plots of rate and latency of every camera. */

import { element, KeyedViews } from "./element.js";
import { History } from "./history.js";
import { HistoryPlot } from "./history_plot.js";

export class HistoryView {
  #cameras;

  constructor() {
    const rows = element("div", { class: "plots" });
    this.#cameras = new KeyedViews(rows, (camera) => new CameraHistory(camera.name));
    this.element = element(
      "section",
      { class: "panel history", "aria-label": "History" },
      element("h2", {}, "Last minutes"),
      rows,
    );
  }

  update(node) {
    this.#cameras.update(node.cameras, (camera) => camera.name);
  }

  /** The plots show no figure as that of now. */
  lose() {
    this.#cameras.views.forEach((camera) => camera.sample(true));
  }

  /** Called once a second; `isLost`: the known values are old. */
  sample(isLost) {
    this.#cameras.views.forEach((camera) => camera.sample(isLost));
  }
}

class CameraHistory {
  #history = new History();
  #rate = new HistoryPlot("Rate", "Hz");
  #latency = new HistoryPlot("Latency", "ms");
  #camera = null;

  constructor(name) {
    const title = name ? [element("h3", {}, name)] : [];
    this.element = element("div", { class: "of-camera" }, ...title, this.#rate.element, this.#latency.element);
  }

  update(camera) {
    this.#camera = camera;
  }

  sample(isLost) {
    const { rate_hz: rateHz, latency_ms: latencyMs } = this.#camera;
    this.#history.add(isLost ? null : rateHz, isLost ? null : latencyMs);
    const { samples } = this.#history;
    this.#rate.update(samples.map((sample) => sample.rateHz));
    this.#latency.update(samples.map((sample) => sample.latencyMs));
  }
}
