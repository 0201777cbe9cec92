// A page opened as a file gets no worker from the browser, and the search of the theme asks for one: what a worker
// would run then runs in a frame that is not seen. The theme reads its index from a script (see site.py).
"use strict";
if (location.protocol === "file:") {
  window.Worker = class extends EventTarget {
    constructor(url) {
      super();
      this.asked = [];
      const frame = document.createElement("iframe");
      frame.hidden = true;
      document.body.append(frame);
      const inside = frame.contentWindow, script = frame.contentDocument.createElement("script");
      // What is posted there goes to whoever listens here.
      inside.postMessage = (data) => this.dispatchEvent(new MessageEvent("message", { data }));
      script.src = String(url);
      script.addEventListener("load", () => {
        this.inside = inside;
        for (const data of this.asked) this.postMessage(data);
      });
      script.addEventListener("error", (event) => this.dispatchEvent(new ErrorEvent("error", event)));
      frame.contentDocument.body.append(script);
    }

    postMessage(data) {
      if (this.inside) this.inside.dispatchEvent(new MessageEvent("message", { data }));
      else this.asked.push(data);
    }

    terminate() {}
  };
}
