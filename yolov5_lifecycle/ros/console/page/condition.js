/** How a detector, or a part of it, is doing: a colour, a symbol and a word. */

const LEVELS = ["ok", "warning", "error", "stale"];
const OF_NODE = "detection";
const DETECTING = "detecting";
/** The state of a detector of which nothing is heard; its last one is `lastState`. */
export const LOST = "lost";
const UNKNOWN = { rate_hz: null, latency_ms: null, latency_p95_ms: null, message: "" };
const STALE = "Diagnostics have stopped: the detector's process hangs, has ended, or cannot be reached.";
const SYMBOLS = { ok: "✓", note: "i", idle: "○", warning: "!", error: "✕", stale: "?", lost: "✕" };
const WORDS = { idle: "not detecting" };

/** The condition called `name`: ok, note, idle, warning, error, stale or lost. */
export function conditionCalled(name) {
  return { name, symbol: SYMBOLS[name], word: WORDS[name] ?? name };
}

/** The condition behind one status. Level OK alone is not green: an unconfigured node has it, too. */
export function conditionOf({ level, message }, state) {
  const name = state === LOST ? LOST : (LEVELS[level] ?? "stale");
  if (name !== "ok") {
    return conditionCalled(name);
  }
  const isDetecting = message === "" || message === DETECTING;
  return conditionCalled(state !== "active" ? "idle" : isDetecting ? "ok" : "note");
}

/** The condition of a detector with the `text` of its summary, and its `problem`, the last one reported. */
export function summaryOf(node) {
  const status = node.diagnostics.find(({ name }) => name === OF_NODE) ?? node.diagnostics[0];
  if (status === undefined) {
    return { ...conditionCalled(node.state === LOST ? LOST : "stale"), text: "no diagnostics received yet", problem: "" };
  }
  const found = { ...conditionOf(status, node.state), text: status.message, problem: lastProblem(status) };
  if (found.name === LOST) {
    return { ...found, text: `Not known now. Last message: ${status.message}` };
  }
  if (found.name === "stale") {
    return { ...found, text: `${STALE} Last message: ${status.message}` };
  }
  if (found.name === "idle" && status.message === DETECTING) {
    return { ...found, text: node.state }; // the diagnostics are older than the state
  }
  const quiet = node.cameras.find(({ level, message }) => level === 0 && message !== "");
  if (found.name === "ok" && quiet !== undefined) {
    return { ...found, ...conditionCalled("note"), text: `${quiet.name}: ${quiet.message}` };
  }
  return found;
}

function lastProblem({ message, values }) {
  const problem = values["last problem"] ?? "";
  return message.includes(problem) ? "" : problem;
}

/** A detector of which nothing is heard any more: nothing old looks current. */
export function asLost(node) {
  const cameras = node.cameras.map((camera) => ({ ...camera, ...UNKNOWN }));
  return { ...node, state: LOST, lastState: node.state, transitions: [], cameras };
}
