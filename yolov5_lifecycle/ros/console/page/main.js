/** The page: one view for each detector that the console knows; one of them is shown. */

import { Connection } from "./connection.js";
import { element, KeyedViews, setText } from "./element.js";
import { NodeView } from "./node_view.js";

const SAMPLE_MS = 1000;
const FIELDS = 'input[type="text"], input[type="search"], textarea';

class Page {
  #connection = new Connection();
  #views = new Map();
  #isViewOnly = false;
  #shown;
  #revealed;
  #tabs = new KeyedViews(byId("nodes"), (view) => new Tab(view));

  start() {
    this.#connection.addEventListener("open", () => this.#showConnection(true));
    this.#connection.addEventListener("lost", () => this.#showConnection(false));
    this.#connection.addEventListener("message", (event) => this.#take(event.detail));
    window.addEventListener("hashchange", () => this.#show());
    document.addEventListener("visibilitychange", () => this.#show());
    document.addEventListener("keydown", (event) => this.#press(event));
    setInterval(() => this.#views.forEach((view) => view.sample()), SAMPLE_MS);
    this.#connection.start();
  }

  #take(message) {
    if (message.type === "welcome") {
      this.#welcome(message.view_only);
    } else if (message.type === "node") {
      this.#viewOf(message.node).update(message.node);
    } else if (message.type === "gone") {
      this.#views.get(message.name)?.setGone();
    }
    this.#show();
  }

  /** After this, every detector is sent again; a missing one has left meanwhile. */
  #welcome(isViewOnly) {
    this.#isViewOnly = isViewOnly;
    byId("view-only").hidden = !isViewOnly;
    this.#views.forEach((view) => view.setGone());
  }

  #viewOf(node) {
    let view = this.#views.get(node.name);
    if (view === undefined || view.isViewOnly !== this.#isViewOnly) {
      view?.release();
      view = new NodeView(node.name, this.#connection, this.#isViewOnly);
      this.#views.set(node.name, view);
      byId("main").append(view.element);
    }
    return view;
  }

  /** Ctrl-Z takes the last change back, except in a field, where it takes typing back. */
  #press(event) {
    const isUndo = (event.ctrlKey || event.metaKey) && !event.shiftKey && !event.altKey && event.key === "z";
    if (isUndo && !event.target.closest(FIELDS)) {
      event.preventDefault();
      this.#views.get(this.#shown)?.undo();
    }
  }

  /** The address decides which detector is shown: the images of another one could wake it. */
  #show() {
    const names = [...this.#views.keys()].sort();
    const wanted = wantedName();
    const shown = wanted === "" ? (this.#shown ?? names[0]) : wanted;
    const isMissing = shown !== undefined && !names.includes(shown);
    this.#shown = isMissing ? undefined : shown;
    for (const [name, view] of this.#views) {
      view.isCurrent = name === shown;
      view.show(view.isCurrent, view.isCurrent && !document.hidden);
    }
    byId("empty").hidden = names.length > 0;
    byId("missing").hidden = !isMissing || names.length === 0;
    setText(byId("missing"), isMissing ? `No detector ${shown} yet, which this address names. Choose another above.` : "");
    this.#tabs.update(names.map((name) => this.#views.get(name)), (view) => view.name);
    document.title = shown === undefined ? "Detector console" : `${shown} - Detector console`;
    this.#revealTab();
  }

  /** Scroll the tab of the shown detector into the bar, once it has changed. */
  #revealTab() {
    if (this.#revealed !== this.#shown) {
      this.#revealed = this.#shown;
      byId("nodes").querySelector("[aria-current]")?.scrollIntoView({ block: "nearest", inline: "center" });
    }
  }

  #showConnection(isOpen) {
    document.body.classList.toggle("lost", !isOpen);
    if (!isOpen) {
      this.#views.forEach((view) => view.lose());
      this.#show();
    }
    byId("connection").dataset.state = isOpen ? "open" : "lost";
    setText(byId("connection"), isOpen ? "connected" : "connection lost");
    byId("lost").hidden = isOpen;
    const lost = "The connection to the console is lost: the values shown are old. Reconnecting automatically.";
    setText(byId("lost"), isOpen ? "" : lost);
  }
}

class Tab {
  #symbol = element("span", { class: "symbol", "aria-hidden": "true" });
  #word = element("span", { class: "word" });

  constructor(view) {
    const name = element("span", {}, view.name);
    this.element = element("a", { href: `#${encodeURIComponent(view.name)}` }, this.#symbol, name, " ", this.#word);
  }

  update(view) {
    this.element.toggleAttribute("aria-current", view.isCurrent);
    if (view.isCurrent) {
      this.element.setAttribute("aria-current", "page");
    }
    const { name, symbol, word } = view.condition;
    this.element.dataset.condition = name;
    setText(this.#symbol, symbol);
    setText(this.#word, word);
  }
}

/** The detector that the address names, "" if it names none. */
function wantedName() {
  try {
    return decodeURIComponent(location.hash.slice(1));
  } catch {
    return "";
  }
}

function byId(id) {
  return document.getElementById(id);
}

new Page().start();
