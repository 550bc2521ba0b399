/** The cameras of a detector: live annotated image, rate, latency, and why there is no output. */

import { CollectButton } from "./collect_button.js";
import { conditionOf, LOST } from "./condition.js";
import { element, KeyedViews, setText } from "./element.js";
import { tenth } from "./figures.js";
import { ImageView } from "./image_view.js";

const SILENT_AFTER_S = 3;

export class CameraViews {
  #cameras;
  #collect;
  #mayReceive = false;

  constructor(node, request, isViewOnly) {
    const grid = element("div", { class: "cameras" });
    this.#cameras = new KeyedViews(grid, (camera) => new CameraView(node, camera.name));
    this.#collect = new CollectButton(request);
    const controls = isViewOnly ? [] : [this.#collect.element];
    this.element = element("section", { class: "images", "aria-label": "Cameras" }, grid, ...controls);
  }

  update(node) {
    const cameras = node.cameras.map((camera) => ({ ...camera, state: node.state }));
    this.#cameras.update(cameras, (camera) => camera.name);
    this.#collect.update(node);
    this.receive(this.#mayReceive);
  }

  /** Images are subscribed to only while they can be seen. */
  receive(mayReceive) {
    this.#mayReceive = mayReceive;
    this.#cameras.views.forEach((camera) => camera.receive(mayReceive));
  }

  sample() {
    this.#cameras.views.forEach((camera) => camera.sample());
  }
}

class CameraView {
  #canvas = element("canvas", { role: "img", width: "640", height: "480" });
  #overlay = element("p", { class: "overlay" }, "no image yet");
  #figures = element("p", { class: "figures" });
  #message = element("p", { class: "message" });
  #shownRate = element("span", { class: "shown" });
  #pause = element("button", { type: "button", class: "small", "aria-pressed": "false" }, "Pause");
  #image;
  #isPaused = false;
  #mayReceive = false;
  #silentS = 0;
  #isLost = false;

  constructor(node, camera) {
    const title = camera || "camera";
    this.#canvas.setAttribute("aria-label", `Annotated image of ${title}`);
    this.#pause.setAttribute("aria-label", `Pause the image of ${title}`);
    this.#pause.addEventListener("click", () => this.#setPaused(!this.#isPaused));
    this.#image = new ImageView(this.#canvas, node, camera, () => this.#heard());
    this.element = element(
      "figure",
      { class: "camera silent", "data-camera": camera },
      element("div", { class: "frame" }, this.#canvas, this.#overlay),
      element(
        "figcaption",
        {},
        element("div", { class: "caption" }, element("h3", {}, title), this.#figures, this.#shownRate, this.#pause),
        this.#message,
      ),
    );
  }

  update(camera) {
    this.#setLost(camera.state === LOST);
    setText(this.#figures, figuresOf(camera));
    setText(this.#message, camera.message);
    this.#message.dataset.condition = conditionOf(camera, camera.state).name;
    this.#message.hidden = camera.message === "" || camera.message === "detecting";
  }

  receive(mayReceive) {
    this.#mayReceive = mayReceive;
    if (mayReceive && !this.#isPaused) {
      this.#image.start();
    } else {
      this.#image.stop();
    }
  }

  release() {
    this.#image.stop();
  }

  /** Called once a second. */
  sample() {
    const count = this.#image.takeCount();
    this.#silentS = count > 0 ? 0 : this.#silentS + 1;
    setText(this.#shownRate, count > 0 && !this.#isLost ? `${count} shown per second` : "");
    if (this.#silentS >= SILENT_AFTER_S && !this.#isLost) {
      const ever = this.#canvas.dataset.stampS !== undefined;
      this.#showSilence(this.#isPaused ? "paused" : ever ? `no image for ${this.#silentS} s` : "no image yet");
    }
  }

  /** The last image of a lost detector stays, but as an old one. */
  #setLost(isLost) {
    if (isLost) {
      setText(this.#shownRate, "");
      this.#showSilence("lost");
    } else if (this.#isLost) {
      setText(this.#overlay, "waiting for an image");
    }
    this.#isLost = isLost;
  }

  #showSilence(text) {
    this.element.classList.add("silent");
    setText(this.#overlay, text);
  }

  #heard() {
    this.#silentS = 0;
    this.element.classList.remove("silent");
  }

  #setPaused(isPaused) {
    this.#isPaused = isPaused;
    this.#pause.setAttribute("aria-pressed", String(isPaused));
    this.receive(this.#mayReceive);
  }
}

function figuresOf({ state, rate_hz: rateHz, latency_ms: latencyMs, latency_p95_ms: p95Ms }) {
  if (state === LOST) {
    return LOST;
  }
  const isDetecting = state === "active" && Number.isFinite(rateHz);
  return isDetecting ? `${tenth(rateHz)} Hz · ${tenth(latencyMs)} ms, p95 ${tenth(p95Ms)} ms` : "not detecting";
}
