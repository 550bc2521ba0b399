/** The cameras of a detector: live annotated image, rate, latency, why there is no output, a button to keep images. */

import { conditionOf, LOST } from "./condition.js";
import { socketAddress } from "./connection.js";
import { element, KeyedViews, setText, tenth } from "./element.js";

const SILENT_AFTER_S = 3;
const STAMP_BYTES = 8;
const FIRST_PAUSE_MS = 500;
const MAX_PAUSE_MS = 5000;

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
  #pause = element("button", { type: "button", class: "small", "aria-pressed": "false" }, "Pause");
  #image;
  #isPaused = false;
  #mayReceive = false;
  #heardMs = performance.now();
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
        element("div", { class: "caption" }, element("h3", {}, title), this.#figures, this.#pause),
        this.#message,
      ),
    );
  }

  update(camera) {
    this.#setLost(camera.state === LOST);
    setText(this.#figures, figuresOf(camera));
    setText(this.#message, camera.message);
    this.#message.dataset.condition = conditionOf(camera, camera.state).name;
    this.#message.hidden = camera.message === "";
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
    const silentS = Math.floor((performance.now() - this.#heardMs) / 1000);
    if (silentS >= SILENT_AFTER_S && !this.#isLost) {
      const ever = this.#canvas.dataset.stampS !== undefined;
      this.#showSilence(this.#isPaused ? "paused" : ever ? `no image for ${silentS} s` : "no image yet");
    }
  }

  /** The last image of a lost detector stays, but as an old one. */
  #setLost(isLost) {
    if (isLost) {
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
    this.#heardMs = performance.now();
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

/** The newest annotated image of a camera, drawn as fast as this browser takes them. */
class ImageView {
  #socket = null;
  #timer = 0;
  #pauseMs = FIRST_PAUSE_MS;
  #address;
  #shown;

  /** `shown()` is called after each image. */
  constructor(canvas, node, camera, shown) {
    this.canvas = canvas;
    this.#address = socketAddress(`/image?${new URLSearchParams({ node, camera })}`);
    this.#shown = shown;
  }

  start() {
    if (this.#socket === null && this.#timer === 0) {
      this.#connect();
    }
  }

  stop() {
    clearTimeout(this.#timer);
    this.#timer = 0;
    const socket = this.#socket;
    this.#socket = null;
    socket?.close();
  }

  #connect() {
    this.#timer = 0;
    const socket = new WebSocket(this.#address);
    socket.binaryType = "arraybuffer";
    this.#socket = socket;
    socket.addEventListener("message", (event) => this.#draw(socket, event.data));
    socket.addEventListener("close", () => this.#lose(socket));
  }

  #lose(socket) {
    if (socket === this.#socket) {
      this.#socket = null;
      this.#timer = setTimeout(() => this.#connect(), this.#pauseMs);
      this.#pauseMs = Math.min(2 * this.#pauseMs, MAX_PAUSE_MS);
    }
  }

  async #draw(socket, data) {
    const stampS = new DataView(data).getFloat64(0, true);
    const image = await decoded(data.slice(STAMP_BYTES));
    if (socket !== this.#socket) {
      return;
    }
    if (image !== null) {
      this.#paint(image);
      this.canvas.dataset.stampS = stampS;
      this.#pauseMs = FIRST_PAUSE_MS;
      this.#shown();
    }
    if (socket.readyState === WebSocket.OPEN) {
      socket.send("taken");
    }
  }

  #paint(image) {
    const { canvas } = this;
    if (canvas.width !== image.width || canvas.height !== image.height) {
      canvas.width = image.width;
      canvas.height = image.height;
    }
    canvas.getContext("2d").drawImage(image, 0, 0);
    image.close();
  }
}

async function decoded(jpeg) {
  try {
    return await createImageBitmap(new Blob([jpeg], { type: "image/jpeg" }));
  } catch {
    return null;
  }
}

/** A button with which a person has the next image of each camera kept, and what the detector answers. */
class CollectButton {
  #request;
  #isPending = false;
  #button = element("button", { type: "button", onclick: () => this.#collect() });
  #result = element("span", { class: "result", role: "status" });
  #refusal = element("p", { class: "refusal", role: "alert" });

  constructor(request) {
    this.#request = request;
    this.element = element("div", { class: "collect", hidden: true }, this.#button, this.#result, this.#refusal);
  }

  update({ state, cameras }) {
    this.element.hidden = state === LOST;
    setText(this.#button, cameras.length > 1 ? "Keep these images" : "Keep this image");
  }

  async #collect() {
    if (this.#isPending) {
      return;
    }
    this.#setPending(true);
    this.#show("", "");
    const { reason, result = "" } = await this.#request({ type: "collect" });
    this.#setPending(false);
    this.#show(result, reason);
  }

  #setPending(isPending) {
    this.#isPending = isPending;
    this.#button.setAttribute("aria-disabled", String(isPending));
  }

  #show(result, refusal) {
    setText(this.#result, result);
    setText(this.#refusal, refusal);
  }
}
