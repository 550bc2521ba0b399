/** The newest annotated image of a camera, drawn as fast as this browser takes them. */

import { socketAddress } from "./connection.js";

const STAMP_BYTES = 8;
const FIRST_PAUSE_MS = 500;
const MAX_PAUSE_MS = 5000;

export class ImageView {
  /** Images drawn since `takeCount` was called. */
  #drawn = 0;
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

  get isReceiving() {
    return this.#socket !== null || this.#timer !== 0;
  }

  start() {
    if (!this.isReceiving) {
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

  /** How many images were drawn since the last call. */
  takeCount() {
    const count = this.#drawn;
    this.#drawn = 0;
    return count;
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
      this.#drawn += 1;
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
