/** The page: one view for each detector that the console knows; one of them is shown. */

import { Connection } from "./connection.js";
import { element, KeyedViews, setText } from "./element.js";
import { NodeView } from "./node_view.js";

const SAMPLE_MS = 1000;

class Page {
  #connection = new Connection();
  #views = new Map();
  #isViewOnly = false;
  /** Names that the console has announced; the detectors themselves arrive one by one. */
  #announced = [];
  #shown;
  #revealed = "";
  #tabs = new KeyedViews(byId("nodes"), (view) => new Tab(view));

  start() {
    this.#connection.addEventListener("open", () => this.#showConnection(true));
    this.#connection.addEventListener("lost", () => this.#showConnection(false));
    this.#connection.addEventListener("message", (event) => this.#take(event.detail));
    window.addEventListener("hashchange", () => this.#show());
    document.addEventListener("visibilitychange", () => this.#show());
    setInterval(() => this.#views.forEach((view) => view.sample()), SAMPLE_MS);
    this.#connection.start();
  }

  #take(message) {
    if (message.type === "welcome") {
      this.#welcome(message);
    } else if (message.type === "node") {
      this.#viewOf(message.node).update(message.node);
    } else if (message.type === "gone") {
      const view = this.#viewOf(message.node);
      view.update(message.node);
      view.setGone();
    }
    this.#show();
  }

  /** After this, every detector in `nodes` is sent; others have left meanwhile. */
  #welcome({ view_only: isViewOnly, nodes }) {
    this.#isViewOnly = isViewOnly;
    this.#announced = nodes;
    byId("view-only").hidden = !isViewOnly;
    this.#views.forEach((view) => nodes.includes(view.name) || view.setGone());
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

  /** The address decides which detector is shown: the images of another one could wake it. */
  #show() {
    const names = [...this.#views.keys()].sort();
    const shown = wantedName() || (this.#shown ?? this.#announced[0] ?? names[0]);
    const isHere = this.#views.has(shown);
    const isMissing = shown !== undefined && !isHere && !this.#announced.includes(shown);
    this.#shown = isHere ? shown : undefined;
    for (const [name, view] of this.#views) {
      view.isCurrent = name === shown;
      view.show(view.isCurrent, view.isCurrent && !document.hidden);
    }
    byId("empty").hidden = names.length > 0 || this.#announced.length > 0;
    byId("missing").hidden = !isMissing || names.length === 0;
    setText(byId("missing"), isMissing ? `No detector ${shown} yet, which this address names. Choose another above.` : "");
    this.#tabs.update(names.map((name) => this.#views.get(name)), (view) => view.name);
    document.title = shown === undefined ? "Detector console" : `${shown} - Detector console`;
    this.#revealTab(JSON.stringify([this.#shown, names]));
  }

  /** Scroll the tab of the shown detector into the bar, once another is shown or a new one has moved it. */
  #revealTab(arrangement) {
    if (this.#revealed !== arrangement) {
      this.#revealed = arrangement;
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
    const lost = "The connection to the console is lost, so the values shown are old. Reconnecting automatically.";
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
    this.element.ariaCurrent = view.isCurrent ? "page" : null;
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
