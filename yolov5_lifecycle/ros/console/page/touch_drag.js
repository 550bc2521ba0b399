/** Tells a horizontal drag with one finger from a gesture that scrolls or zooms the page, and from a mere touch. */

const SLOP_PX = 12;
/** How many times farther to the side than up or down a drag has gone. */
const SLOPE = 2;
const IDLE = "";
const UNDECIDED = "undecided";
const DRAG = "drag";
const OTHER = "other";

export class TouchDrag {
  #listener;
  #state = IDLE;
  #start = null;

  /** `listener` has `begin()`, then either `commit()` after a drag or `cancel()` after anything else. */
  constructor(slider, listener) {
    this.#listener = listener;
    slider.addEventListener("touchstart", (event) => this.#touch(event), { passive: true });
    slider.addEventListener("touchmove", (event) => this.#move(event), { passive: true });
    slider.addEventListener("touchend", (event) => this.#lift(event));
    slider.addEventListener("touchcancel", () => this.#end(false));
  }

  /** Whether the slider must not follow the finger that is down. */
  get isIgnored() {
    return this.#state === UNDECIDED || this.#state === OTHER;
  }

  #touch({ touches }) {
    if (this.#state === IDLE && touches.length === 1) {
      [this.#start] = touches;
      this.#state = UNDECIDED;
      this.#listener.begin();
    } else {
      this.#abandon();
    }
  }

  #move({ touches }) {
    if (touches.length > 1) {
      this.#abandon();
    } else if (this.#state === UNDECIDED) {
      const right = Math.abs(touches[0].clientX - this.#start.clientX);
      const down = Math.abs(touches[0].clientY - this.#start.clientY);
      if (Math.max(right, down) >= SLOP_PX) {
        this.#state = right >= SLOPE * down ? DRAG : OTHER;
      }
    }
  }

  #lift(event) {
    if (event.cancelable) {
      event.preventDefault(); // a browser would repeat a tap as a click of a mouse
    }
    if (event.targetTouches.length === 0) {
      this.#end(this.#state === DRAG);
    }
  }

  /** A second finger means a gesture of the browser's. */
  #abandon() {
    if (this.#state === DRAG) {
      this.#listener.cancel();
    }
    this.#state = OTHER;
  }

  #end(isDrag) {
    const isBegun = this.#state !== IDLE;
    this.#state = IDLE;
    if (isDrag) {
      this.#listener.commit();
    } else if (isBegun) {
      this.#listener.cancel();
    }
  }
}
