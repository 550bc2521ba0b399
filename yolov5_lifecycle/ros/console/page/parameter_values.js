/** Values of parameters: what differs, as text for people, and as a file for --params-file. */

const HEAD = "/**:\n  ros__parameters:\n";

/** Whether a parameter differs from its default, as a hidden one does. An override does wherever it is set. */
export function isChanged({ name, value, is_shown: isShown, default: usual }) {
  return !isShown || (value !== null && (isOverride(name) || !isSame(value, usual)));
}

/** Whether the parameter is that of one camera, such as `front.max_rate`: without a value, the node's applies. */
export function isOverride(name) {
  return name.includes(".");
}

/** Whether two values of parameters are equal. */
export function isSame(a, b) {
  return JSON.stringify(a) === JSON.stringify(b);
}

/** A value as text. */
export function shownValue(value) {
  if (value === null) {
    return "not set";
  }
  if (Array.isArray(value)) {
    return value.length > 0 ? value.join(", ") : "empty";
  }
  return value === "" ? "empty" : String(value);
}

/** The text of a file with every parameter that differs from its default. */
export function yamlText(parameters) {
  const changed = parameters.filter(isChanged);
  if (changed.length === 0) {
    return "# Every parameter has its default.\n";
  }
  return HEAD + changed.map(line).join("");
}

function line({ name, type, value, is_shown: isShown }) {
  return isShown ? `    ${name}: ${written(type, value)}\n` : `    # ${name}: not shown by the console\n`;
}

function written(type, value) {
  if (type === "string_array") {
    return `[${value.map(quoted).join(", ")}]`;
  }
  if (type === "string") {
    return quoted(value);
  }
  return type === "double" ? double(value) : String(value);
}

/** ROS tells a double from an integer by the point; YAML 1.1 needs one before an exponent, too. */
function double(value) {
  const text = String(value);
  if (/^-?\d+$/.test(text)) {
    return `${text}.0`;
  }
  return text.replace(/^(-?\d+)e/, "$1.0e");
}

/** A string in double quotes; what YAML does not allow in a file is escaped. */
function quoted(text) {
  return JSON.stringify(text).replace(
    /[\u007f-\u009f\u2028\u2029\ufeff\ufffe\uffff]/g,
    (character) => `\\u${character.charCodeAt(0).toString(16).padStart(4, "0")}`,
  );
}
