// Search in pages that were opened from a folder. A browser starts no worker from a file:// address, and
// the theme searches in one; here the worker's script runs in a hidden frame instead, in the same thread.
// The word "iframe-worker" in this file's name keeps the theme's offline plugin from loading such a script
// from another host.
(() => {
  if (location.protocol !== "file:") return;

  const importing = (document, url) =>
    new Promise((done, failed) => {
      const script = document.createElement("script");
      script.src = url;
      script.onload = done;
      script.onerror = failed;
      document.body.append(script);
    });

  window.Worker = class extends EventTarget {
    constructor(url) {
      super();
      this.frame = document.createElement("iframe");
      this.frame.hidden = true;
      document.body.append(this.frame);
      const inside = this.frame.contentWindow;
      inside.document.open();
      inside.document.write("<!doctype html><title>search</title><body></body>");
      inside.document.close();
      inside.postMessage = (data) => this.answer(data);
      inside.importScripts = (...urls) =>
        urls.reduce((before, next) => before.then(() => importing(inside.document, next)), Promise.resolve());
      this.loaded = importing(inside.document, url);
    }

    answer(data) {
      const event = new MessageEvent("message", { data });
      this.dispatchEvent(event);
      if (this.onmessage) this.onmessage(event);
    }

    postMessage(data) {
      this.loaded.then(() => {
        this.frame.contentWindow.dispatchEvent(new MessageEvent("message", { data }));
      });
    }

    terminate() {
      this.frame.remove();
    }
  };
})();
