/** A detector as the console itself tells of one that is gone, for when the console is not heard either. */

import { LOST } from "./condition.js";

const UNKNOWN = { rate_hz: null, latency_ms: null, latency_p95_ms: null, message: "" };

export function asLost(node) {
  const cameras = node.cameras.map((camera) => ({ ...camera, ...UNKNOWN }));
  return { ...node, state: LOST, transitions: [], busy: "", cameras };
}
