/** Rate and latency of one camera over the last minutes, a sample a second. */

export const KEPT_S = 300;

export class History {
  #samples = [];

  get samples() {
    return this.#samples;
  }

  /** Numbers, or null where there is none: a gap in the plot. */
  add(rateHz, latencyMs) {
    this.#samples.push({ rateHz, latencyMs });
    if (this.#samples.length > KEPT_S) {
      this.#samples.shift();
    }
  }
}

/** The smallest of 1, 2, 5, 10, 20, 50 ... that is at least `value`. */
export function roundedUp(value) {
  if (!(value > 0)) {
    return 1;
  }
  const power = 10 ** Math.floor(Math.log10(value));
  return [1, 2, 5, 10].map((factor) => factor * power).find((limit) => limit >= value * (1 - 1e-9));
}

/** Runs of neighbouring samples that have a number, as lists of [age in samples, value]. */
export function runs(values) {
  const found = [];
  let run = [];
  for (const [index, value] of values.entries()) {
    if (Number.isFinite(value)) {
      run.push([values.length - 1 - index, value]);
    } else if (run.length > 0) {
      found.push(run);
      run = [];
    }
  }
  return run.length > 0 ? [...found, run] : found;
}
