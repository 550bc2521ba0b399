/** Numbers formatted for people. */

/** One decimal; "-" without a number. */
export function tenth(value) {
  return Number.isFinite(value) ? value.toFixed(1) : "-";
}

/** With groups of three digits: 12 345. */
export function grouped(count) {
  return String(count).replace(/\B(?=(\d{3})+$)/g, "\u202f");
}

/** A stamp in seconds as the time of day here. */
export function timeOfDay(stampS) {
  return new Date(1000 * stampS).toLocaleTimeString("en-GB");
}
