"use strict";
// A page's websocket to `thirdhand hands`: hands and orders to the cell, its status back.
// browser_hands.py and hand_message.py are the other side.
class Link {
  static PING_MS = 200; // interval of pings
  static PINGS = 50; // the clock is taken from the quickest of the last 10 s
  static MAX_BUFFERED_BYTES = 240; // with two messages unsent the socket is behind, and hands are dropped,
  static MAX_UNANSWERED = 3; // as with more pings without an answer: what is sent then waits in the network
  static RETRY_MS = 1000;

  // shown: called with no argument when anything changed; answered: with the answer to an order, and if it was done
  constructor(shown, answered) {
    Object.assign(this, {shown, answered, status: {}, problem: "connecting", refusal: "", number: 0, sent: 0, dropped: 0});
    this.message = new DataView(new ArrayBuffer(120));
    this.connect();
    setInterval(() => this.ping(), Link.PING_MS);
  }
  connect() {
    const scheme = location.protocol === "https:" ? "wss" : "ws";
    const token = new URLSearchParams(location.search).get("token") ?? "";
    const socket = this.socket = new WebSocket(`${scheme}://${location.host}/hands?token=${encodeURIComponent(token)}`);
    [this.pings, this.unanswered] = [[], 0];
    this.refusal = "";
    socket.binaryType = "arraybuffer";
    socket.onopen = () => { this.problem = ""; this.ping(); this.shown(); };
    socket.onmessage = event => typeof event.data === "string" ? this.told(JSON.parse(event.data)) : this.pong(event.data);
    socket.onclose = event => {
      // The server closes with 4000 + a status of HTTP and its reason. Only silence (408) is worth another try.
      const isRefused = event.code >= 4000 && event.code !== 4408;
      this.refusal = isRefused ? event.reason : "";
      this.problem = event.reason || "`thirdhand hands` has ended, or the network is down";
      this.status = {};
      if (!isRefused) setTimeout(() => this.connect(), Link.RETRY_MS);
      this.shown();
    };
  }
  told(data) {
    if (data.status) {
      this.status = data.status;
      this.shown();
    } else this.answered(data.answer, data.done);
  }
  ping() {
    if (this.socket.readyState !== WebSocket.OPEN) return;
    const view = new DataView(new ArrayBuffer(16));
    view.setUint32(0, 0x474e4950, true);
    view.setFloat64(8, performance.now(), true);
    this.socket.send(view.buffer);
    this.unanswered++;
  }
  pong(bytes) {
    const view = new DataView(bytes), now = performance.now(), sent = view.getFloat64(8, true);
    this.pings.push({trip_ms: now - sent, offset_ms: view.getFloat64(16, true) - (sent + now) / 2});
    if (this.pings.length > Link.PINGS) this.pings.shift();
    this.unanswered = 0;
    this.clock = this.pings.reduce((best, one) => one.trip_ms < best.trip_ms ? one : best);
  }
  get isReady() { return this.socket.readyState === WebSocket.OPEN && this.pings.length > 0; }

  // Hands by side, {position, orientation, tip, pinch} in metres and x y z w, at a time of performance.now() [ms],
  // predicted for `ahead_ms` later. A hand that is missing is not seen.
  send(hands, {epoch = 0, time_ms, ahead_ms = 0}) {
    const sides = ["left", "right"], view = this.message;
    const seen = sides.reduce((bits, side, i) => bits | (hands[side] ? 1 << i : 0), 0);
    if (!seen || !this.isReady) return;
    const number = this.number;
    this.number = (number + 1) & 0xffff; // also of a message that is dropped, so that the server counts it
    const isBehind = this.unanswered > Link.MAX_UNANSWERED || this.socket.bufferedAmount > Link.MAX_BUFFERED_BYTES;
    if (isBehind) { this.dropped++; return; }
    view.setUint32(0, 0x53444e48, true);
    view.setUint8(4, seen);
    view.setUint8(5, epoch);
    view.setUint16(6, number, true);
    view.setFloat64(8, time_ms + this.clock.offset_ms, true);
    view.setFloat64(16, ahead_ms, true);
    sides.forEach((side, i) => {
      const {position = [0, 0, 0], orientation = [0, 0, 0, 1], tip = [0, 0, 0], pinch = 0} = hands[side] ?? {};
      [...position, ...orientation, ...tip, pinch, 0].forEach((value, k) => view.setFloat32(24 + 48 * i + 4 * k, value, true));
    });
    this.socket.send(view.buffer);
    this.sent++;
  }
  order(name) {
    if (this.socket.readyState === WebSocket.OPEN) this.socket.send(name);
    else this.answered(`${name} was NOT sent: ${this.problem}`, false);
  }
  // Mode and what to show of it: {mode, headline, why, remedy}
  get summary() {
    const {mode, title, because, remedy, age_s} = this.status;
    if (this.problem) return {mode: "", headline: "not connected", why: this.problem, remedy: ""};
    if (!mode || age_s > 2) return {mode: "", headline: "the daemon does not answer", why: "", remedy: ""};
    return {mode, headline: title ? `${mode}: ${title}` : mode, why: because, remedy: remedy && `What to do: ${remedy}`};
  }
}
