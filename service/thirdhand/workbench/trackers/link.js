"use strict";
// A page's link to `thirdhand hands`: hands and orders to the cell, its status and the objects on its bench back.
// The websocket is in link_worker.js.
class Link {
  static RETRY_MS = 1000;

  // shown: called with no argument when anything changed; answered: with the answer to an order, true if it was
  // done, and the order
  constructor(shown, answered) {
    Object.assign(this, {shown, answered, status: {}, objects: [], problem: "", refusal: ""});
    Object.assign(this, {sent: 0, dropped: 0, clock_ms: null}); // messages of hands, and the clock's error bound
    this.worker = new Worker(`link_worker.js${location.search}`);
    this.worker.onmessage = ({data: {opened, closed, unsent, text, ...changed}}) => {
      if (text) this.receive(JSON.parse(text));
      else if (opened) this.begin();
      else if (closed) this.retry(closed);
      else if (unsent) answered(`${unsent} was NOT sent: the page is not connected`, false);
      else Object.assign(this, changed);
    };
    this.worker.onerror = () => {
      this.problem = "a part of this page did not arrive: load the page again";
      this.shown();
    };
    this.connect();
  }
  connect() {
    const scheme = location.protocol === "https:" ? "wss" : "ws";
    const token = new URLSearchParams(location.search).get("token") ?? "";
    [this.refusal, this.clock_ms] = ["", null];
    this.problem ||= "connecting";
    this.worker.postMessage({connect: `${scheme}://${location.host}/hands?token=${encodeURIComponent(token)}`});
  }
  begin() {
    this.problem = "";
    this.shown();
  }
  retry({code, reason}) {
    // The server closes with 4000 + a status of HTTP and its reason. Only silence (408) is worth another try.
    const isRefused = code >= 4000 && code !== 4408;
    this.refusal = isRefused ? reason : "";
    this.problem = reason || "`thirdhand hands` has ended, or the network is down";
    [this.status, this.clock_ms] = [{}, null];
    if (!isRefused) setTimeout(() => this.connect(), Link.RETRY_MS);
    this.shown();
  }
  receive({status, objects, order, answer, done}) {
    if (status) {
      [this.status, this.objects] = [status, objects];
      this.shown();
    } else this.answered(answer, done, order);
  }
  get isReady() { return this.clock_ms !== null; }

  // Hands as link_worker.js sends them, at a time of performance.now() [ms].
  send(hands, {epoch = 0, time_ms, ahead_ms = 0}) {
    if (this.isReady && (hands.left || hands.right))
      this.worker.postMessage({hands, epoch, time_ms: performance.timeOrigin + time_ms, ahead_ms});
  }
  order(name) { this.worker.postMessage({order: name}); }
  // Mode and what to show of it: {mode, headline, why, remedy}
  get summary() {
    const {mode, title, because, remedy, age_s} = this.status;
    if (this.problem) return {mode: "", headline: "not connected", why: this.problem, remedy: ""};
    if (!mode || age_s > 2) return {mode: "", headline: "the daemon does not answer", why: "", remedy: ""};
    return {mode, headline: title ? `${mode}: ${title}` : mode, why: because, remedy: remedy && `What to do: ${remedy}`};
  }
}
