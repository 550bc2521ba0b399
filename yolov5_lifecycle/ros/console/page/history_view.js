/** Plots of rate and latency of every camera. */

import { LOST } from "./condition.js";
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
    if (node.state === LOST) {
      this.sample(); // at once: a plot must not show an old figure as that of now
    }
  }

  /** Called once a second. */
  sample() {
    this.#cameras.views.forEach((camera) => camera.sample());
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

  sample() {
    const { rate_hz: rateHz, latency_ms: latencyMs } = this.#camera;
    this.#history.add(rateHz, latencyMs);
    const { samples } = this.#history;
    this.#rate.update(samples.map((sample) => sample.rateHz));
    this.#latency.update(samples.map((sample) => sample.latencyMs));
  }
}
